"""Has the picture lost sharpness since it was focused? The events of a lens at rest say so.

The Event Laplacian Product with the sharp picture is the rate at which sharpness changes, whatever changes it, so its
sum over a lens at rest is the sharpness lost since: by drift, by a knock, or because another subject stands there,
whose picture has nothing to do with the one that was focused. The sharp picture and how much matters are known from the
sweep itself (``elpd.vision.sharpest``).

There is a limit to it that no weighing moves: a change of blur that brings few pixels to their threshold sends few
events, and noise hides them. What is smaller than about two depths of focus is mostly not heard.

Over minutes noise would sum to more than that. So only changes are counted that noise would not make: those that stand
``SIGMAS`` above the random walk of the time that they took, which may be a tenth of a second or several. What is slower
than that is not heard; a schedule or a temperature is for it. Pixels that fire by themselves are told by their
neighbours and left out.

Listening now and then misses what happens in between: only changes that were heard count.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.vision.resting import HOT_EVENTS, hot_pixels

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.events.decoder import EventArrays
    from elpd.records import Roi

SIGMAS = 6.0
"""Noise alone does this once in 5·10⁸ looks: with seven lengths of time, ten times a second, once in 80 days."""

BIN_S = 0.1
"""Events are summed over so long before they are judged."""

LEAST_BIN = 0.9
"""Events come a bin's length at a time, give or take a little; a little short is better than twice as long."""

SPANS = (1, 2, 4, 8, 16, 32, 64)
"""Over how many bins a change may take place."""

AFTERGLOW_S = 0.3
"""So long after the lens has come to rest, pixels may still answer to what was before."""

STIR_SIGMAS = 4.0
"""A scene in which one bin changes the sharpness by more than this is not quiet; by chance once in an hour."""

MOST_WAITING = 1 << 20
"""Events that may wait for the end of a bin; a scene that sends more is not quiet anyway, and bins end sooner."""


class Evidence:
    """Sharpness lost since the last focus, over one region.

    Parameters
    ----------
    weights, roi
        What an ON event takes from sharpness in each pixel, (height, width) of the region, and where that is.
    allowance
        The sum over events that counts as lost; see ``elpd.vision.sharpest``.
    """

    def __init__(self, weights: NDArray[np.float64], roi: Roi, allowance: float) -> None:
        self._roi = roi
        self._weights = weights
        self._allowance = allowance
        self._waiting: list[tuple[NDArray[Any], NDArray[Any]]] = []
        self._waiting_events = 0
        self._hot = np.zeros(self._weights.shape, np.bool_)
        self._bins: deque[tuple[float, float]] = deque(maxlen=SPANS[-1])
        self._lost = 0.0
        self._bin_begun_s: float | None = None
        self._stirred_s: float | None = None
        self._begun_s: float | None = None
        self._now_s = 0.0

    @property
    def loss(self) -> float:
        """How much sharpness was certainly lost, in allowances."""
        return self._lost / self._allowance

    @property
    def quiet_s(self) -> float:
        """For how long the scene has been quiet."""
        since = self._begun_s if self._stirred_s is None else self._stirred_s
        return 0.0 if since is None else self._now_s - since

    def hear(self, events: EventArrays, now_s: float) -> None:
        """Take a packet's events, heard at *now_s*."""
        self._now_s = now_s
        if self._begun_s is None:
            self._begun_s = now_s
        if now_s - self._begun_s < AFTERGLOW_S:
            return
        if self._bin_begun_s is None:
            self._bin_begun_s = now_s
        roi = self._roi
        # Unsigned, what lies before the region wraps to far beyond it.
        x, y = events.x - np.uint16(roi.x), events.y - np.uint16(roi.y)
        inside = (x < roi.width) & (y < roi.height)
        self._waiting.append((y[inside].astype(np.int64) * roi.width + x[inside], 2.0 * events.p[inside] - 1.0))
        self._waiting_events += self._waiting[-1][0].size
        if now_s - self._bin_begun_s >= LEAST_BIN * BIN_S or self._waiting_events > MOST_WAITING:
            self._close_bin()

    def _close_bin(self) -> None:
        pixel = np.concatenate([one for one, _ in self._waiting])
        sign = np.concatenate([one for _, one in self._waiting])
        self._waiting, self._waiting_events, self._bin_begun_s = [], 0, self._now_s
        if _any_often(pixel):
            count = np.bincount(pixel, minlength=self._weights.size).reshape(self._weights.shape)
            self._hot |= hot_pixels(count)
        weight = np.where(self._hot.ravel()[pixel], 0.0, self._weights.ravel()[pixel])
        lost, variance = float(weight @ sign), float(weight @ weight)
        if lost**2 > STIR_SIGMAS**2 * variance:
            self._stirred_s = self._now_s
        self._bins.append((lost, variance))
        self._judge()

    def _judge(self) -> None:
        """Count the change over the shortest time in which it is one, if there is any."""
        newest_first = np.array(self._bins)[::-1]
        sums = newest_first.cumsum(axis=0)
        for span in SPANS:
            if span > len(sums):
                return
            lost, variance = sums[span - 1]
            if lost**2 > SIGMAS**2 * variance:
                self._lost = max(0.0, self._lost + float(lost))
                self._bins.clear()
                return


def _any_often(pixel: NDArray[Any]) -> bool:
    """Say whether any pixel fired more often than one that is not hot may; of a scene at rest none does."""
    fewest = int(HOT_EVENTS) + 1
    if pixel.size < fewest:
        return False
    in_order = np.sort(pixel)
    return bool((in_order[fewest - 1 :] == in_order[: 1 - fewest]).any())
