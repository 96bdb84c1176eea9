"""An EVK4 on the wire: the Treuzell frames of its control endpoint, registers that remember, and an event stream.

Taken from what the maker's open HAL and neuromorphic-drivers send: frames of a command, a length and a payload, little
endian, on bulk endpoints 0x02 and 0x82; events on 0x81. A register reads as it was last written.
"""

from __future__ import annotations

import struct
import threading
from collections import deque

from hardware_emulation.wire import Outbox, described, descriptors

VENDOR, PRODUCT = 0x04B4, 0x00F5
CONTROL_OUT, CONTROL_IN, EVENTS_IN = 0x02, 0x82, 0x81
_SERIAL, _RELEASE, _BUILD, _DEVICES, _NAME, _COMPATIBLE = 0x72, 0x79, 0x7A, 0x10000, 0x10001, 0x10003
_REGISTER, _WRITE, _FAILED = 0x10102, 0x40000000, 0x80000000
_ADC_STATUS, _ADC_DONE = 0x50, 1 << 11
_TIME_BASE, _ROI_CONTROL, _OUT_OF_RESET = 0x9008, 0x4, 1 << 10
ROI_X, ROI_Y, DIGITAL_MASK = 0x2000, 0x4000, 0x9100
RATE_ENABLE, RATE_EVENTS, BIAS_DIFF_ON = 0x6028, 0x600C, 0x1010
_PIPELINE, _TRIGGER = 0x7004, 1 << 10


class Evk4:
    """See ``usbfs.Device``. ``serial`` has eight hexadecimal digits."""

    vendor, product = VENDOR, PRODUCT
    streaming_endpoints = frozenset({EVENTS_IN})

    def __init__(self, serial: str = "00050567") -> None:
        self.descriptors = descriptors(VENDOR, PRODUCT, 0x100, (EVENTS_IN, CONTROL_IN, CONTROL_OUT))
        self.attributes = {"manufacturer": "Prophesee", "product": "EVK4", "serial": serial}
        self.registers: dict[int, int] = {}
        self.writes = 0
        self.answering = threading.Event()
        """While cleared, frames get no answer and the host waits."""
        self.answering.set()
        self._answer_then = False
        self._serial = bytes.fromhex(serial)[::-1]
        self._replies: deque[bytes] = deque()
        self._stream = Outbox()

    def send(self, packet: bytes) -> None:
        """Queue a USB packet of events; one that is longer than the host asks for goes in several."""
        self._stream.put(packet)

    def stall(self) -> None:
        """Let the next request for events fail, as an endpoint does that has lost its way."""
        self._stream.stall()

    def forget(self) -> None:
        """Drop the packets that wait for the host to ask."""
        self._stream.forget()

    def answer_when_sent(self) -> None:
        """Answer frames again once the host has taken every packet of events."""
        self._answer_then = True

    @property
    def streaming(self) -> bool:
        """Whether the host has started the sensor: its clock runs and its pixels are not held in reset."""
        return bool(self.registers.get(_TIME_BASE, 0) & 1 and self.registers.get(_ROI_CONTROL, 0) & _OUT_OF_RESET)

    @property
    def listening(self) -> bool:
        """Whether edges on the trigger input come between the events."""
        return bool(self.registers.get(_PIPELINE, 0) & _TRIGGER)

    @property
    def unsent(self) -> int:
        """How many packets wait for the host to ask."""
        return len(self._stream)

    def control(self, setup: bytes, data: bytes) -> bytes | None:
        """Answer descriptors, the type of camera and nothing else."""
        del data
        kind, request, value, _, length = struct.unpack("<BBHHH", setup)
        if (kind, request) == (0xC0, 0x72):
            return b"\x31\x00"
        if (kind, request) == (0x80, 0x06):
            answer = described(self.descriptors, ("Prophesee", "EVK4"), value)
            return None if answer is None else answer[:length]
        return b"" if not kind & 0x80 else None

    def written(self, endpoint: int, data: bytes) -> None:
        """Take a Treuzell frame and queue the answer."""
        assert endpoint == CONTROL_OUT
        command, _ = struct.unpack_from("<II", data)
        payload = data[8:]
        self._replies.append(self._answer(command, payload))

    def next_packet(self, endpoint: int, length: int) -> bytes | None:
        """Return a reply or a packet of events."""
        if self._answer_then and not self._stream:
            self._answer_then = False
            self.answering.set()
        if endpoint == CONTROL_IN:
            return self._replies.popleft() if self._replies and self.answering.is_set() else None
        return self._stream.take(length) if self.streaming else None

    def _answer(self, command: int, payload: bytes) -> bytes:
        if command == _REGISTER | _WRITE:
            device, address, *values = struct.unpack(f"<{len(payload) // 4}I", payload)
            for place, value in enumerate(values):
                self.registers[address + 4 * place] = value
            self.writes += 1
            return struct.pack("<IIII", command, 8, device, address)
        if command == _REGISTER:
            device, address, count = struct.unpack("<3I", payload)
            values = [self._register(address + 4 * place) for place in range(count)]
            return struct.pack(f"<IIII{count}I", command, 8 + 4 * count, device, address, *values)
        content = {
            _SERIAL: self._serial + b"\x00" * 4,
            _RELEASE: struct.pack("<I", 0x00030900),
            _BUILD: struct.pack("<Q", 1_650_000_000),
            _DEVICES: struct.pack("<I", 1),
            _NAME: b"\x00\x00\x00\x00CCam5 Imx636 Event-Based Camera\x00",
            _COMPATIBLE: b"\x00\x00\x00\x00psee,ccam5_imx636\x00psee,ccam5_gen42\x00",
        }.get(command)
        if content is None:
            return struct.pack("<II", command | _FAILED, 0)
        return struct.pack("<II", command, len(content)) + content

    def _register(self, address: int) -> int:
        if address == _ADC_STATUS:
            return _ADC_DONE | 500  # 500 * 0.19 - 56 = 39 degrees
        return self.registers.get(address, 0)
