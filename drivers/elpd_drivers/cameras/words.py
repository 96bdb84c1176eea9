"""A camera's raw bytes as packets: cut to whole words, dated, surveyed, their clock watched.

A camera that hands out its words undecoded keeps everything that is in them: trigger edges and the rate controller's
counts, which libraries throw away. What a packet must say beside them is found here, in the capture process.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.errors import CameraError
from elpd.events.survey import Survey
from elpd.units import NS_PER_US
from elpd_drivers.cameras.ring import Captured
from elpd_drivers.cameras.source import WORDS

if TYPE_CHECKING:
    from elpd.records import Encoding

STEP_BACK_US = 16
"""EVT3 times step back by up to 11 us in recordings: a promise of completeness keeps this much to itself."""

CLOCK_JUMP_US = 1_000_000
"""No queue on the way to the host and no drift makes a second; a sensor that was reset does."""


class WordStream:
    """Turns bytes into packets, state carried from one to the next.

    Attributes
    ----------
    held_back : int
        How many events the rate controller has held back so far.
    """

    def __init__(self, encoding: Encoding) -> None:
        self._survey = Survey(encoding)
        self._dtype = np.dtype(WORDS[encoding])
        self._rest = b""
        self._until_us: int | None = None
        self._time_us: int | None = None
        self._received_ns = 0
        self.held_back = 0

    def captured(
        self, data: bytes, received_ns: int, *, gap_before: bool = False, lost_events: int = 0, backlog: int = 0
    ) -> Captured:
        """Return the next bytes as a packet.

        Raises
        ------
        CameraError
            If the camera's clock has jumped: it was reset, and nothing before agrees with anything after.
        """
        if gap_before:
            self._rest = b""
            self._survey.gap()
        whole = self._rest + data if self._rest else data
        size = len(whole) // self._dtype.itemsize * self._dtype.itemsize
        words = np.frombuffer(whole, self._dtype, size // self._dtype.itemsize)
        self._rest = whole[size:]
        seen = self._survey.take(words)
        if seen.time_us is not None:
            self._watch_clock(seen.time_us, received_ns)
            self._until_us = max(self._until_us or 0, seen.time_us - STEP_BACK_US)
        self.held_back += seen.dropped
        return Captured(
            words,
            received_ns,
            complete_until_us=self._until_us,
            events=seen.events,
            triggers=seen.triggers,
            gap_before=gap_before or seen.dropped > 0,
            lost_events=lost_events + seen.dropped,
            backlog=backlog,
        )

    def _watch_clock(self, time_us: int, received_ns: int) -> None:
        if self._time_us is not None:
            passed_us = time_us - self._time_us
            ahead_us = passed_us - (received_ns - self._received_ns) / NS_PER_US
            if passed_us < -STEP_BACK_US or ahead_us > CLOCK_JUMP_US:
                raise CameraError(
                    f"camera: its clock jumped by {passed_us / 1e6:+.3f} s where "
                    f"{(received_ns - self._received_ns) / 1e9:.3f} s had passed; it was reset, start again"
                )
        self._time_us, self._received_ns = time_us, received_ns
