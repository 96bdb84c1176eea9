"""What is left of events after whole periods of a lamp that flickers.

A lamp takes every pixel up and down again, and after a period the pixel's level is where the scene has it. So the
events of a period are replaced by their *net*: so many of one polarity as the level has changed. The net events are
what a sensor under steady light would have sent, dated to the middle of the period, and everything that reads events
can read them. The lamp even does a service: it dithers the comparators, whose dead zone shrinks with its depth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class NetEvents(NamedTuple):
    """Events of one polarity each, all of one time."""

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]


class WholePeriods:
    """Turns events into net events.

    Parameters
    ----------
    heard:
        (height, width) of the sensor: pixels to listen to.
    begin_us:
        Where the first period begins; earlier events are passed over.
    """

    def __init__(self, heard: NDArray[np.bool_], begin_us: int) -> None:
        self._heard = heard
        self._begin_us = begin_us
        self._pieces: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]] = []

    def add(self, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], on: NDArray[np.uint8]) -> None:
        """Take events in the sensor's coordinates. They are copied."""
        keep = self._heard[y, x] & (t_us >= self._begin_us)
        pixel = y[keep].astype(np.int64) * self._heard.shape[1] + x[keep]
        self._pieces.append((t_us[keep], pixel, on[keep]))

    def close(self, begin_us: int, end_us: int) -> NetEvents:
        """Return the net events of everything before *end_us*, dated to the middle of ``begin_us .. end_us``."""
        pieces = self._pieces or [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.uint8))]
        t_us, pixel, on = (np.concatenate(column) for column in zip(*pieces, strict=True))
        now = t_us < end_us
        self._pieces = [(t_us[~now], pixel[~now], on[~now])]
        return self._net(pixel[now], on[now], (begin_us + end_us) // 2)

    def _net(self, pixel: NDArray[np.int64], on: NDArray[np.uint8], t_us: int) -> NetEvents:
        net = np.bincount(pixel, weights=2.0 * on - 1.0, minlength=self._heard.size).astype(np.int64)
        changed = np.flatnonzero(net)
        where = np.repeat(changed, np.abs(net[changed]))
        width = self._heard.shape[1]
        return NetEvents(
            np.full(where.size, t_us, np.int64),
            (where % width).astype(np.uint16),
            (where // width).astype(np.uint16),
            (net[where] > 0).astype(np.uint8),
        )
