"""Event-rate maximum (the focus measure of Lin et al., CVPR 2022, searched exhaustively).

The same measure as EGS without the golden search, so that the search's own mistakes can be told from the measure's:
counts per millisecond, a Gaussian of 3 ms, the highest bin, a parabola. It is right where flow makes the events and
sits on one of two peaks where it does not. It needs the complete stack.
"""

from __future__ import annotations

import numpy as np

from elpd.baselines.rates import polarity_rates, smooth, vertex
from elpd.baselines.stack import Estimate, FocusStack, no_answer

BIN_US = 1_000
SMOOTHING_BINS = 3.0


def estimate(stack: FocusStack) -> Estimate:
    """Return the time of the highest event rate."""
    rates = polarity_rates(stack, BIN_US)
    if not rates.both.any():
        return no_answer("no events in the region")
    curve = smooth(rates.both, SMOOTHING_BINS)
    peak = int(np.argmax(curve))
    return Estimate(rates.time_at(vertex(curve, peak)), float(stack.end_us), {"peak_per_ms": float(curve[peak])})
