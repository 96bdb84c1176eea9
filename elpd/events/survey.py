"""What can be said of a packet of words without decoding it: its time, its triggers, how many events, what was dropped.

Whoever captures a live stream must know until when a packet is complete, how many events go missing with it if it is
thrown away, and what the camera's rate controller has dropped. One walk over the words answers all of it, at a few
times the speed of decoding, and keeps registers of its own.

The rate controller counts in pairs: how many events came in a period (OTHERS 0x014), then how many it let through
(0x016). In recordings the two are equal to the event while nothing is dropped, so their difference is what was lost. A
pair that was cut apart by a loss says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import UsageError
from elpd.events.evt2 import HIGH_BITS, LOW_BITS
from elpd.events.evt3 import WORDS, skip_to_time, take_rare_words
from elpd.events.jit import kernel
from elpd.events.registers import (
    COUNT_BEFORE_CONTROLLER,
    HIGH,
    LOOP,
    LOW,
    NO_SUBTYPE,
    OTHERS_SUBTYPE,
    RATE_AFTER,
    RATE_BEFORE,
    RATE_COUNTS,
    new_state,
    new_triggers,
    take_triggers,
    time_of,
)
from elpd.events.split import split_evt2, split_evt21
from elpd.records import Encoding

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Trigger
    from elpd.units import SensorUs

TALLY_EVENTS, TALLY_DROPPED, TALLY_BEFORE = 0, 1, 2
NO_COUNT = -1
FOREVER_US = 1 << 62


@dataclass(frozen=True, slots=True)
class Surveyed:
    """One packet: ``time_us`` after its last word (``None`` before the first time), the rest of this packet alone.

    ``events`` counts those outside the sensor too; ``dropped`` is what the rate controller held back.
    """

    time_us: SensorUs | None
    events: int
    dropped: int
    triggers: tuple[Trigger, ...]


class Survey:
    """Walks over the words of one camera, packet by packet. Only EVT3 tells what its rate controller drops.

    Raises ``UsageError`` for an encoding that is not words.
    """

    def __init__(self, encoding: Encoding) -> None:
        if encoding is Encoding.ARRAY:
            raise UsageError("event arrays are not words: their times are columns")
        self._encoding = encoding
        self._state, self._triggers = new_state(), new_triggers()
        self._tally = np.array([0, 0, NO_COUNT], np.int64)

    def take(self, words: NDArray[Any]) -> Surveyed:
        """Walk over the next words of the stream."""
        self._tally[:TALLY_BEFORE] = 0
        if self._encoding is Encoding.EVT3:
            survey_evt3(words, self._state, self._tally, self._triggers)
        elif self._encoding is Encoding.EVT2:
            known = self._state[HIGH] >= 0
            split_evt2(words, 0, self._state, FOREVER_US, self._triggers)
            self._tally[TALLY_EVENTS] = _after_time(words >> np.uint32(28), known).sum()
        else:
            known = self._state[HIGH] >= 0
            split_evt21(words, 0, self._state, FOREVER_US, self._triggers)
            is_event = _after_time(words >> np.uint64(60), known)
            self._tally[TALLY_EVENTS] = np.bitwise_count(words[is_event] & np.uint64(0xFFFFFFFF)).sum()
        bits = (12, 12) if self._encoding is Encoding.EVT3 else (LOW_BITS, HIGH_BITS)
        return Surveyed(
            time_us=None if self._state[HIGH] < 0 else time_of(self._state, *bits),
            events=int(self._tally[TALLY_EVENTS]),
            dropped=int(self._tally[TALLY_DROPPED]),
            triggers=take_triggers(self._state, self._triggers),
        )

    def gap(self) -> None:
        """Say that words are missing here: a count whose other half is among them means nothing."""
        self._tally[TALLY_BEFORE] = NO_COUNT
        self._state[OTHERS_SUBTYPE] = NO_SUBTYPE


@kernel(f"void({WORDS}, int64[::1], int64[::1], int64[:, ::1])", serves=Encoding.EVT3.value)
def survey_evt3(
    words: NDArray[np.uint16], state: NDArray[np.int64], tally: NDArray[np.int64], triggers: NDArray[np.int64]
) -> None:
    """Walk over *words*: time and triggers into the registers, events and drops added to *tally*."""
    position = 0
    if state[HIGH] < 0:
        position = skip_to_time(words, 0, state)
    loop, high, low = state[LOOP], state[HIGH], state[LOW]
    events = 0
    i = np.uint64(position)
    size = np.uint64(words.shape[0])
    while i < size:
        word = np.int64(words[i])
        i += np.uint64(1)
        kind = word >> 12
        if kind == 0x2:
            events += 1
        elif kind == 0x6:
            low = word & 0xFFF
        elif kind == 0x8:
            content = word & 0xFFF
            if content != high:
                if high >= 2048 + content:
                    loop += 1
                high = content
                low = np.int64(0)
        elif kind in (0x4, 0x5):
            mask = np.uint32(word & 0xFFF if kind == 0x4 else word & 0xFF)
            while mask != 0:
                events += 1
                mask = np.uint32(mask & (mask - np.uint32(1)))
        elif kind in (0xE, 0xF, 0x7, 0xA):
            counts, before, after = state[RATE_COUNTS], state[RATE_BEFORE], state[RATE_AFTER]
            subtype = word & 0xFFF if kind == 0xE else state[OTHERS_SUBTYPE]
            i = take_rare_words(words, i, (loop << 24) + (high << 12) + low, state, triggers)
            if state[RATE_COUNTS] == counts:
                continue
            if subtype == COUNT_BEFORE_CONTROLLER:
                tally[TALLY_BEFORE] = state[RATE_BEFORE] - before
            elif tally[TALLY_BEFORE] != NO_COUNT:
                tally[TALLY_DROPPED] += max(0, tally[TALLY_BEFORE] - (state[RATE_AFTER] - after))
                tally[TALLY_BEFORE] = NO_COUNT
    state[LOOP], state[HIGH], state[LOW] = loop, high, low
    tally[TALLY_EVENTS] += events


def _after_time(kinds: NDArray[Any], known: np.bool_) -> NDArray[np.bool_]:
    """Say which words of these kinds are events, once there is a time."""
    events: NDArray[np.bool_] = kinds < 2
    if not known:
        events &= np.logical_or.accumulate(kinds == 0x8)
    return events
