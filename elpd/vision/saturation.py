"""Whether the read-out is full: a rate that stands still at its highest says so, where the sensor does not.

Independent events scatter: their counts in equal bins have a variance equal to their mean, and whatever a scene does
adds to it. A sensor, rate controller or link that is full delivers the same count in every bin. So a stretch of bins at
the top whose variance is a tenth of their mean is no scene's doing: by chance it comes once in ten million.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

BIN_US = 1_000
STRETCH = 16
LEAST_COUNT = 50.0
"""Fewer events a bin are no read-out's limit."""

MOST_FANO = 0.1
"""Variance over mean: the probability of less, of 16 independent counts, is 10⁻⁷."""

TOP = 0.9
"""Share of the highest rate at which a stretch is at the top."""


class RateWatch:
    """Counts the events of a whole sensor, bin by bin, from the first that it hears."""

    def __init__(self) -> None:
        self._begin_us: int | None = None
        self._counts = np.zeros(256, np.int64)
        self._bins = 0

    def add(self, t_us: NDArray[np.int64]) -> None:
        """Take the times of events, about in order."""
        if t_us.size == 0:
            return
        if self._begin_us is None:
            self._begin_us = int(t_us[0])
        which = np.maximum((t_us - self._begin_us) // BIN_US, 0)
        last = int(which.max())
        if last > 1 << 20:
            return  # a quarter of an hour, or a clock that jumped: nothing that a sweep is made of
        if last >= self._counts.size:
            self._counts = np.concatenate([self._counts, np.zeros(max(last, self._counts.size), np.int64)])
        counts = np.bincount(which)
        self._counts[: counts.size] += counts
        self._bins = max(self._bins, last)  # the last bin is not complete

    def plateau_mev_s(self) -> float | None:
        """Return the rate at which the read-out is full, in events per microsecond; ``None`` if it is not."""
        counts = self._counts[: self._bins].astype(np.float64)
        if counts.size < STRETCH:
            return None
        stretches = np.lib.stride_tricks.sliding_window_view(counts, STRETCH)
        mean, variance = stretches.mean(axis=1), stretches.var(axis=1, ddof=1)
        full = (mean >= LEAST_COUNT) & (mean >= TOP * counts.max()) & (variance <= MOST_FANO * mean)
        return float(mean[full].max()) / BIN_US if full.any() else None
