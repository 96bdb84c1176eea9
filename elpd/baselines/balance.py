"""ON/OFF balance after Ge et al., Opt. Lasers Eng. 2023, 107247 (autofocus microscopy with an event camera).

Small bright objects brighten until focus and darken after it (dark ones the other way round): the polarities change
over at focus. **The original's formula was not at hand; this is our reading of it, made as strong as we could.** With
the OFF rate scaled by g = ΣP/ΣN the running sum of P - g·N starts and ends at zero, and focus is its extremum: the
point where the balance tips, found from all events at once instead of from the noise of a single bin's difference.

Known to work on sparse bright or dark objects. A texture as bright as dark tips too, but less: blurring raises the mean
of a logarithm, so a picture that sharpens gets darker on the whole. Whatever else makes events of one polarity, a lamp
that comes on in mid-sweep, carries the extremum away with it. It needs the complete stack.
"""

from __future__ import annotations

import numpy as np

from elpd.baselines.rates import polarity_rates, vertex
from elpd.baselines.stack import Estimate, FocusStack, no_answer

BIN_US = 1_000


def estimate(stack: FocusStack) -> Estimate:
    """Return the time at which the polarities change over."""
    rates = polarity_rates(stack, BIN_US)
    if not (rates.on.any() and rates.off.any()):
        return no_answer("only one polarity in the region")
    gain = float(rates.on.sum() / rates.off.sum())
    running = np.cumsum(rates.on - gain * rates.off)
    tipping = int(np.argmax(np.abs(running)))
    tilt = float(abs(running[tipping]) / rates.on.sum())
    # A running sum is read at the end of its bin, half a bin after the bin's middle.
    focus_us = rates.time_at(vertex(np.abs(running), tipping) + 0.5)
    return Estimate(focus_us, float(stack.end_us), {"gain": gain, "tilt": tilt})
