"""Too many events for this computer: whole slices are left out, the oldest first, and it is said how much.

What waits in the camera's ring is old by the time its turn comes, and a decision made of it stops the lens late. So
when more waits than a sweep can afford, and it does not get less, packets are let go unread until what comes next is
fresh. Dropping whole slices keeps sums fair: within what was heard nothing is missing, so ELP and its noise shrink
together. Time stays exact: of a slice that is let go the words that say the time are handed on, and windows know how
much of them was not looked at. To everybody else it is loss like any other: the packet says what it lacks, confidence
falls with it, and beyond ``safety.LOSS_LIMIT`` the cycle gives up.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.counting import EventCounter
from elpd.records import Encoding

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import CameraPacket, Roi

MOST_WAITING_US = 10_000
"""At 4 mm/s the lens goes 40 um in this time, as far as a sweep goes past focus before it is certain of it."""

MOST_PACKETS = 64
"""The same for a camera that does not say what its packets are complete until: they come each 150 us at the most."""

PATIENCE = 8
"""Packets over which the backlog may be seen to shrink: a computer that stood still for a moment (a command that took
long, another program) makes up for it in a few milliseconds, and loses nothing."""

DESPAIR = 10.0
"""So many times what may wait is let go in any case: the scene is no longer the one in which it happened."""

SLICES = 4096


class Shedding:
    """Lets slices of a sweep go while too much waits.

    Parameters
    ----------
    roi
        Events inside *roi* are counted as lost.

    Attributes
    ----------
    shed_us
        How much of the time so far was not looked at.
    """

    def __init__(self, roi: Roi) -> None:
        self._counter = EventCounter(roi)
        self._slices: deque[tuple[int, int]] = deque(maxlen=SLICES)
        self._until_us: int | None = None
        self._behind = self._gap = False
        self._waited: deque[float] = deque(maxlen=PATIENCE)
        self.shed_us = 0

    def take(self, packet: CameraPacket) -> CameraPacket:
        """Return a packet as it is, or, while too much waits behind it, without its events."""
        begin_us, self._until_us = self._until_us, packet.complete_until_us
        end_us = packet.complete_until_us
        slice_us = end_us - begin_us if begin_us is not None and end_us is not None else None
        first = begin_us is None and end_us is not None  # how long its slice is nobody knows
        self._behind = not first and self._too_much(packet.backlog, slice_us)
        if not self._behind:
            after_gap, self._gap = self._gap, False
            return replace(packet, gap_before=True) if after_gap else packet
        self._gap = True
        if slice_us is not None and begin_us is not None and end_us is not None:
            self.shed_us += slice_us
            if self._slices and self._slices[-1][1] == begin_us:
                begin_us, _ = self._slices.pop()
            self._slices.append((begin_us, end_us))
        return replace(
            packet,
            data=_only_time(packet.data, packet.encoding),
            gap_before=True,
            lost_events=packet.lost_events + self._counter.count(packet),
        )

    def within(self, begin_us: int, end_us: int) -> int:
        """Return how much of an interval was not looked at, in us; the newest thousands of slices are remembered."""
        return sum(max(0, min(end, end_us) - max(begin, begin_us)) for begin, end in self._slices)

    def _too_much(self, backlog: int, slice_us: int | None) -> bool:
        waiting = backlog * slice_us / MOST_WAITING_US if slice_us else backlog / MOST_PACKETS
        shrinks = len(self._waited) < PATIENCE or waiting < self._waited[0]
        self._waited.append(waiting)
        if self._behind:  # down to half: few long gaps are easier to judge around than many short ones
            return waiting > 0.5
        return waiting > DESPAIR or (waiting > 1.0 and not shrinks)


def _only_time(words: NDArray[Any], encoding: Encoding) -> NDArray[Any]:
    """Return the few words that bring a decoder's time to where all of *words* would."""
    if encoding is Encoding.ARRAY:
        return words[:0]
    kinds = words >> words.dtype.type(8 * words.dtype.itemsize - 4)
    highs = np.flatnonzero(kinds == 0x8)
    if encoding is not Encoding.EVT3:
        return words[highs[-1:]]
    lows = np.flatnonzero(kinds == 0x6)[-1:]
    # A TIME_HIGH that changes clears the low part and a repeated one does not: which it is shows in the order of these.
    before = highs[highs < lows[0]][-1:] if lows.size else highs[:0]
    after = highs[highs > lows[0]] if lows.size else highs[-1:]  # all: one that changes it and one that changes it back
    kept: NDArray[Any] = words[np.concatenate((before, lows, after))]
    return kept
