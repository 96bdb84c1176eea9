"""The trigger edges of a camera's packets, whatever the packets' encoding, and nothing else of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.events.registers import new_state, new_triggers, take_triggers
from elpd.events.split import SPLITTERS
from elpd.records import Encoding, Trigger
from elpd.units import SensorUs

if TYPE_CHECKING:
    from elpd.records import CameraPacket

_NEVER = 1 << 62
_TURN = {Encoding.EVT3: 1 << 24, Encoding.EVT2: 1 << 34, Encoding.EVT21: 1 << 34}
"""After how many microseconds the encoding's own time begins anew."""


class EdgeReader:
    """Reads trigger edges along a stream of packets; about a nanosecond a word."""

    def __init__(self) -> None:
        self._state = new_state()
        self._triggers = new_triggers()

    def of(self, packet: CameraPacket) -> tuple[Trigger, ...]:
        """Return the edges of the next packet, oldest first, in the packet's own time."""
        splitter = SPLITTERS.get(packet.encoding)
        if splitter is None:
            return packet.triggers
        splitter(np.ascontiguousarray(packet.data), 0, self._state, _NEVER, self._triggers)
        found = take_triggers(self._state, self._triggers)
        until = packet.complete_until_us
        if until is None:
            return found
        turn = _TURN[packet.encoding]  # who came in later has missed turns that the packet's own stamp counts
        return tuple(Trigger(SensorUs(until - (until - one.t_us) % turn), one.id, one.rising) for one in found)
