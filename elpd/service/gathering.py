"""The packets of a tenth of a second, decoded as one.

A camera may send a thousand a second, and there is more to calling a decoder, and whoever looks at what it says, than
to decoding a millisecond of a scene at rest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from elpd.events.decoder import EventArrays
from elpd.events.stream import PacketDecoder

if TYPE_CHECKING:
    from elpd.records import CameraPacket, Geometry
    from elpd.units import SensorUs


class Gathering:
    """Packets that wait to be decoded. State goes on from one turn to the next.

    Parameters
    ----------
    geometry
        The sensor; events outside it are dropped.
    """

    def __init__(self, geometry: Geometry) -> None:
        self._decoder = PacketDecoder(geometry)
        self._waiting: list[bytes] = []
        self._last: CameraPacket | None = None
        self._until_us: SensorUs | None = None
        self._after_gap = False
        self._decoded: list[EventArrays] = []
        self.size_bytes = 0
        """How much has been taken since it was decoded last."""

    def add(self, packet: CameraPacket) -> None:
        """Take a packet; its data is copied."""
        if packet.gap_before:  # what a decoder knew of rows before does not hold after it
            self._decode()
            self._after_gap = True
        self._last = packet
        self._until_us = self._until_us if packet.complete_until_us is None else packet.complete_until_us
        self._waiting.append(packet.data.tobytes())
        self.size_bytes += packet.data.nbytes

    def take(self) -> EventArrays | None:
        """Return the events of all packets since the last call, ``None`` if there was no packet."""
        self._decode()
        pieces, self._decoded, self.size_bytes = self._decoded, [], 0
        if len(pieces) > 1:
            return EventArrays(*(np.concatenate(columns) for columns in zip(*pieces, strict=True)))
        return pieces[0] if pieces else None

    def _decode(self) -> None:
        if self._last is None:
            return
        whole = np.frombuffer(b"".join(self._waiting), self._last.data.dtype)
        packet = replace(self._last, data=whole, gap_before=self._after_gap, complete_until_us=self._until_us)
        self._waiting, self._last, self._after_gap = [], None, False
        events = self._decoder.feed(packet)
        self._decoded.append(EventArrays(events.t.copy(), events.x.copy(), events.y.copy(), events.p.copy()))
