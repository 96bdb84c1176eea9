"""Has the picture lost sharpness since it was focused? The events of a lens at rest say so.

The Event Laplacian Product is the rate at which sharpness changes, whatever changes it, so its sum over a lens at rest
is the sharpness gained or lost since: by drift, by a knock, or because another subject stands there, whose picture has
nothing to do with the one that was focused. How much matters is known from the sweep itself: what the same sum was over
the last depths of focus before it. Noise makes a random walk of the sum; its variance is the sum of the squared
weights, so a loss counts once it stands ``SIGMAS`` above that. Pixels that fire by themselves are found by their
neighbours and left out.

Listening now and then misses what happens in between: only changes that were heard count.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.vision.resting import hot_pixels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.events.decoder import EventArrays
    from elpd.records import ElpSample, Roi
    from elpd.vision.reference import Reference

SIGMAS = 6.0
"""By chance once in 10⁹ looks; a thousand times more often if the noise is a thousand looks long: once in ten days."""

BIN_S = 0.1
"""Events are summed over so long before they are judged."""

STIR_SHARE = 0.1
STIR_SIGMAS = 4.0
"""A scene is not quiet while one bin changes its sharpness by this share of what counts as lost, beyond noise."""

MOST_WAITING = 1 << 20
"""Events that may wait for the end of a bin; a scene that sends more is not quiet anyway, and bins end sooner."""


class Evidence:
    """Sharpness since the last focus, over one region.

    Parameters
    ----------
    reference, roi
        The weights that the cycle judged by, and where.
    allowance
        The sum of ELP that counts as lost; see ``allowance_of``.
    """

    def __init__(self, reference: Reference, roi: Roi, allowance: float) -> None:
        rows, columns = slice(roi.y, roi.y + roi.height), slice(roi.x, roi.x + roi.width)
        self._roi = roi
        self._weights = reference.weights[rows, columns].astype(np.float64)
        self._allowance = allowance
        self._net = np.zeros(self._weights.shape, np.int64)
        self._count = np.zeros(self._weights.shape, np.int64)
        self._waiting: list[tuple[NDArray[Any], NDArray[Any]]] = []
        self._waiting_events = 0
        self._bin_begun_s: float | None = None
        self._high = self._total = 0.0
        self._energy = self._energy_at_high = 0.0
        self._stirred_s: float | None = None
        self._begun_s: float | None = None
        self._now_s = 0.0

    @property
    def loss(self) -> float:
        """How much was lost since the sharpest, in allowances."""
        return (self._high - self._total) / self._allowance

    @property
    def certain(self) -> bool:
        """Whether noise alone would not show so much."""
        return self._high - self._total > SIGMAS * float(np.sqrt(max(0.0, self._energy - self._energy_at_high)))

    @property
    def quiet_s(self) -> float:
        """For how long the scene has been quiet."""
        since = self._begun_s if self._stirred_s is None else self._stirred_s
        return 0.0 if since is None else self._now_s - since

    def hear(self, events: EventArrays, now_s: float) -> None:
        """Take a packet's events."""
        self._now_s = now_s
        if self._begun_s is None:
            self._begun_s = now_s
        if self._bin_begun_s is None:
            self._bin_begun_s = now_s
        roi = self._roi
        x, y = events.x.astype(np.int64) - roi.x, events.y.astype(np.int64) - roi.y
        inside = (x >= 0) & (x < roi.width) & (y >= 0) & (y < roi.height)
        self._waiting.append(((y * roi.width + x)[inside], 2.0 * events.p[inside] - 1.0))
        self._waiting_events += int(inside.sum())
        if now_s - self._bin_begun_s >= BIN_S or self._waiting_events > MOST_WAITING:
            self._close_bin()

    def _close_bin(self) -> None:
        pixel = np.concatenate([one for one, _ in self._waiting])
        sign = np.concatenate([one for _, one in self._waiting])
        self._waiting, self._waiting_events, self._bin_begun_s = [], 0, None
        size, shape = self._net.size, self._net.shape
        count = np.bincount(pixel, minlength=size).reshape(shape)
        net = np.rint(np.bincount(pixel, weights=sign, minlength=size)).astype(np.int64).reshape(shape)
        self._count += count
        self._net += net
        weights = np.where(hot_pixels(self._count), 0.0, self._weights)
        stirred = abs(float((weights * net).sum()))
        if stirred > STIR_SHARE * self._allowance and stirred**2 > STIR_SIGMAS**2 * float((weights**2 * count).sum()):
            self._stirred_s = self._now_s
        self._total = -float((weights * self._net).sum())
        self._energy = float((weights**2 * self._count).sum())
        if self._total >= self._high:
            self._high, self._energy_at_high = self._total, self._energy


def allowance_of(passage: Sequence[ElpSample], depth_of_focus_um: float, depths: float) -> float | None:
    """Return the sum of ELP over the last *depths* of focus before the sharpest place of a sweep.

    Where the sweep began nearer, the way beyond is taken; ``None`` where neither was seen.
    """
    known = [(sample.position_um, sample.elp) for sample in passage if np.isfinite(sample.position_um)]
    if len(known) < 3:
        return None
    place = np.array([um for um, _ in known])
    total = np.cumsum([elp for _, elp in known])
    peak = int(np.argmax(total))
    far = np.abs(place - place[peak]) >= depths * depth_of_focus_um
    losses = []
    before, beyond = np.flatnonzero(far[:peak]), np.flatnonzero(far[peak:])
    if before.size:
        losses.append(float(total[peak] - total[before[-1]]))
    if beyond.size:
        losses.append(float(total[peak] - total[peak + beyond[0]]))
    return losses[0] if losses and losses[0] > 0 else None
