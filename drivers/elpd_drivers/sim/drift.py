"""Focus that moves by itself: warmth, a knock, somebody who puts another subject there.

A line of ramps over time, in um of focus travel from where focus was drawn. Nobody who focuses can know it; what shows
is the picture that loses its sharpness.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.units import NS_PER_MS, NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_KNOTS = 4096
"""Ramps of long ago are forgotten."""


class Drift:
    """Where focus is, from where it was drawn.

    Parameters
    ----------
    begin_ns
        When it begins.
    um_per_s
        How fast it goes by itself.
    """

    def __init__(self, begin_ns: int, um_per_s: float = 0.0) -> None:
        self._begin_ns = begin_ns
        self._um_per_s = um_per_s
        self._times_ns: list[float] = [float(begin_ns)]
        self._um: list[float] = [0.0]

    def shift(self, at_ns: int, by_um: float, over_ms: float) -> None:
        """Go *by_um* further, evenly from *at_ns* (not before the last shift's end) for *over_ms*."""
        begin_ns = max(float(at_ns), self._times_ns[-1])
        self._times_ns += [begin_ns, begin_ns + over_ms * NS_PER_MS]
        self._um += [self._um[-1], self._um[-1] + by_um]
        del self._times_ns[:-MOST_KNOTS], self._um[:-MOST_KNOTS]

    def um(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return it at some instants."""
        times = np.asarray(times_ns, np.float64)
        steady = self._um_per_s * (times - self._begin_ns) / NS_PER_S
        return np.asarray(steady + np.interp(times, self._times_ns, self._um), np.float64)
