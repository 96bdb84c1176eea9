"""PBF: polarity-based focus (Bao et al., Optics Express 2023, doi 10.1364/OE.489717), reconstructed.

**The published text gives the idea but not the formula, and no code is public; the evaluation function here is ours.**
A pixel that brightens at t0-τ darkens at t0+τ, so the ON rate before focus mirrors the OFF rate after it and the other
way round. For each centre c = s/2 of the grid, half bins included,

    D(s) = Σ |P_i - g·N_j| / Σ (P_i + g·N_j)   over i + j = s,

is least at the centre of symmetry; a parabola through D refines it. Two things that a fair peer needs and a plain
version lacks: the gain g = ΣP/ΣN takes out unequal ON and OFF thresholds, and each polarity's noise floor, its lowest
smoothed rate, is subtracted first (without them the plain version is off by 15-50 ms, ``algorithms.md`` §3).

Known to work on anything whose blur is symmetric about focus, strobe light included; late by half the threshold
hysteresis, and wrong where scene motion makes the events. It needs both sides of focus.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.baselines.rates import polarity_rates, smooth, vertex
from elpd.baselines.stack import Estimate, FocusStack, no_answer
from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

BIN_US = 2_000
SMOOTHING_BINS = 2.0
FLOOR_BINS = 5.0


def estimate(stack: FocusStack) -> Estimate:
    """Return the centre of symmetry of the two polarity rates, searched in the middle half of the stack."""
    rates = polarity_rates(stack, BIN_US)
    on, off = _above_floor(rates.on), _above_floor(rates.off)
    if not (on.any() and off.any()):
        return no_answer("one polarity never rises above its noise floor")
    gain = float(on.sum() / off.sum())
    bins = on.size
    asymmetry = np.ones(2 * bins - 1, dtype=np.float64)
    mirror_asymmetry(on, np.ascontiguousarray(gain * off), asymmetry)
    low, high = bins // 2, 2 * bins - 1 - bins // 2
    if high - low < 3:
        return no_answer("the stack is too short to have a middle half", bins=bins)
    best = low + int(np.argmin(asymmetry[low:high]))
    focus_us = rates.time_at(0.5 * vertex(asymmetry, best))
    return Estimate(focus_us, float(stack.end_us), {"gain": gain, "asymmetry": float(asymmetry[best])})


def _above_floor(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return smoothed counts less their noise floor, never below zero."""
    floor = float(smooth(counts, FLOOR_BINS).min())
    return np.ascontiguousarray(np.maximum(smooth(counts, SMOOTHING_BINS) - floor, 0.0))


@kernel("void(float64[::1], float64[::1], float64[::1])")
def mirror_asymmetry(on: NDArray[np.float64], off: NDArray[np.float64], asymmetry: NDArray[np.float64]) -> None:
    """Write D(s) for every sum of indices ``s`` into *asymmetry* (2n-1,); 1 where nothing overlaps.

    *on* and *off* are (n,) rates, *off* already multiplied by the gain.
    """
    bins = on.size
    for s in range(2 * bins - 1):
        difference = 0.0
        total = 0.0
        for i in range(max(0, s - bins + 1), min(s, bins - 1) + 1):
            difference += abs(on[i] - off[s - i])
            total += on[i] + off[s - i]
        asymmetry[s] = difference / total if total > 0.0 else 1.0
