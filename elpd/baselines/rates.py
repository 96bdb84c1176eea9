"""Event rates on a fixed grid: what EGS's relatives, PBF, ON/OFF balance and ESVA have in common.

Counts per bin are exact. Smoothing is a normalised Gaussian that re-weights at the ends, so that a constant rate stays
constant there. A maximum or minimum on a grid is refined by the parabola through it and its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.baselines.stack import FocusStack


@dataclass(frozen=True, slots=True)
class PolarityRates:
    """ON and OFF counts (bins,) of equal bins; bin *i* covers ``begin_us + i·bin_us`` up to the next, end excluded."""

    on: NDArray[np.float64]
    off: NDArray[np.float64]
    begin_us: int
    bin_us: int

    @property
    def both(self) -> NDArray[np.float64]:
        """All events per bin."""
        return self.on + self.off

    def time_at(self, index: float) -> float:
        """Return the time at a (fractional) bin index; whole indices are the middles of bins."""
        return self.begin_us + (index + 0.5) * self.bin_us


def polarity_rates(stack: FocusStack, bin_us: int) -> PolarityRates:
    """Count the region's events per *bin_us*. A last bin that the record does not fill is left out."""
    bins = max(stack.duration_us // bin_us, 1)
    inside = stack.inside_roi() & (stack.t_us >= stack.begin_us)
    index = (stack.t_us[inside] - stack.begin_us) // bin_us
    kept = index < bins
    index, on = index[kept], stack.on[inside][kept] > 0
    return PolarityRates(
        np.bincount(index[on], minlength=bins).astype(np.float64),
        np.bincount(index[~on], minlength=bins).astype(np.float64),
        stack.begin_us,
        bin_us,
    )


def smooth(values: NDArray[np.float64], sigma_bins: float) -> NDArray[np.float64]:
    """Return *values* smoothed by a Gaussian of *sigma_bins*, weights renormalised at the ends."""
    reach = min(max(int(np.ceil(4.0 * sigma_bins)), 1), max(values.size - 1, 1))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_bins) ** 2)
    middle = slice(reach, reach + values.size)
    weight = np.convolve(np.ones(values.size), kernel)[middle]
    return np.asarray(np.convolve(values, kernel)[middle] / weight, dtype=np.float64)


def vertex(values: NDArray[np.float64], index: int) -> float:
    """Return the fractional index of the extremum at *index*, by the parabola through it and its neighbours."""
    if not 0 < index < values.size - 1:
        return float(index)
    left, middle, right = (float(one) for one in values[index - 1 : index + 2])
    bend = left - 2.0 * middle + right
    if bend == 0.0:
        return float(index)
    return index + float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))
