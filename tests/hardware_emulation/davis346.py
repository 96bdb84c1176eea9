"""A DAVIS346 on the wire: registers by module and number over control transfers, and a stream of words on 0x82.

Taken from what libcaer and neuromorphic-drivers send: vendor request 0xBF reads or writes one register, four bytes big
endian, the module as the value and the register as the index; 0xC2 writes several, six bytes each. A register reads as
it was last written, or as the camera's logic reports itself. What is not switched on sends nothing.
"""

from __future__ import annotations

import struct
import threading
from typing import TYPE_CHECKING

from hardware_emulation.wire import Outbox, described, descriptors

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hardware_emulation.davis_words import Kind

VENDOR, PRODUCT, RELEASE = 0x152A, 0x841A, 0x0006
STREAM_IN = 0x82
_ONE, _SEVERAL = 0xBF, 0xC2
MULTIPLEXER, DVS, APS, IMU, EXTERNAL, CHIP, SYSTEM, USB = 0, 1, 2, 3, 4, 5, 6, 9
RUN = {"events": (DVS, 3), "frames": (APS, 4), "imu": (IMU, 2), "edges": (EXTERNAL, 0)}
"""By kind of word, the register that switches it on."""

STREAM_RUN = ((MULTIPLEXER, 0), (MULTIPLEXER, 1), (USB, 0))
ROI = ((DVS, 41), (DVS, 42), (DVS, 43), (DVS, 44))
ON_THRESHOLD, EXPOSURE, FRAME_INTERVAL = (CHIP, 11), (APS, 12), (APS, 13)
MASKED_ROWS = tuple((DVS, 11 + 2 * slot) for slot in range(8))
MASKED_COLUMNS = tuple((DVS, 12 + 2 * slot) for slot in range(8))
ADC_MHZ = 30
_LOGIC = {
    (SYSTEM, 0): 18,  # version
    (SYSTEM, 3): 120,  # MHz: logic, ADC, USB; then their deviation in thousandths
    (SYSTEM, 4): ADC_MHZ,
    (SYSTEM, 5): 104,
    (SYSTEM, 6): 1000,
    (SYSTEM, 7): 1,  # patch
    **dict.fromkeys(((DVS, 10), (DVS, 30), (DVS, 40), (DVS, 50), (DVS, 60), (APS, 6)), 1),  # filters, global shutter
    (IMU, 0): 2,  # InvenSense 9250
}


class Davis346:
    """See ``usbfs.Device``.

    *aps_orientation* has bit 2 where the picture is read out by rows, bits 1 and 0 where from right or from below.
    """

    vendor, product = VENDOR, PRODUCT
    streaming_endpoints = frozenset({STREAM_IN})

    def __init__(self, serial: str = "00000499", aps_orientation: int = 0) -> None:
        self.descriptors = descriptors(VENDOR, PRODUCT, RELEASE, (STREAM_IN,), serial_at=3)
        self.attributes = {"manufacturer": "iniVation", "product": "DAVIS346", "serial": serial}
        self.registers: dict[tuple[int, int], int] = {}
        self.answering = threading.Event()
        """While cleared, writing a register takes as long as it stays so."""
        self.answering.set()
        self._strings = ("iniVation", "DAVIS346", serial)
        self._logic = {**_LOGIC, (APS, 2): aps_orientation}
        self._stream = Outbox()

    def send(self, words: bytes, *kinds: Kind) -> bool:
        """Queue a USB packet of words of *kinds*, if all of those are switched on; say whether they are."""
        if not all(self.registers.get(RUN[kind], 0) for kind in kinds):
            return False
        self._stream.put(words)
        return True

    def forget(self) -> None:
        """Drop the packets that wait for the host to ask."""
        self._stream.forget()

    def stall(self) -> None:
        """Let the next request for words fail, as an endpoint does that has lost its way."""
        self._stream.stall()

    @property
    def streaming(self) -> bool:
        """Whether the host has started the stream."""
        return all(self.registers.get(place, 0) for place in STREAM_RUN)

    @property
    def unsent(self) -> int:
        """How many packets wait for the host to ask."""
        return len(self._stream)

    def read(self, places: Iterable[tuple[int, int]]) -> list[int]:
        """Return what the host wrote there."""
        return [self.registers[place] for place in places]

    def control(self, setup: bytes, data: bytes) -> bytes | None:
        """Answer descriptors and registers."""
        kind, request, value, index, length = struct.unpack("<BBHHH", setup)
        if (kind, request) == (0x80, 0x06):
            answer = described(self.descriptors, self._strings, value)
            return None if answer is None else answer[:length]
        if (kind, request) == (0xC0, _ONE):
            return struct.pack(">I", self._logic.get((value, index), self.registers.get((value, index), 0)))
        if (kind, request) == (0x40, _ONE):
            self.registers[value, index] = struct.unpack(">I", data)[0]
        if (kind, request) == (0x40, _SEVERAL):
            for module, register, content in struct.iter_unpack(">BBI", data):
                self.registers[module, register] = content
        return b"" if not kind & 0x80 else None

    def written(self, endpoint: int, data: bytes) -> None:
        """Take nothing: a DAVIS has no endpoint to write to."""
        raise AssertionError(f"{len(data)} bytes were written to endpoint {endpoint:#x}")

    def next_packet(self, endpoint: int, length: int) -> bytes | None:
        """Return a packet of words."""
        assert endpoint == STREAM_IN
        return self._stream.take(length) if self.streaming else None
