"""What every emulated camera has: USB descriptors, and packets that wait until the host asks for them."""

from __future__ import annotations

import struct
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


def string(text: str) -> bytes:
    """Return a string descriptor."""
    content = text.encode("utf-16-le")
    return bytes((len(content) + 2, 3)) + content


def descriptors(vendor: int, product: int, release: int, endpoints: Sequence[int], serial_at: int = 0) -> bytes:
    """Return the descriptors of a USB 3 device with one interface of bulk *endpoints*; string 3 is its serial number.

    *release* is the device's own version, ``serial_at`` the number of the string with its serial number.
    """
    device = struct.pack(
        "<BBHBBBBHHHBBBB", 18, 1, 0x0300, 0, 0, 0, 9, vendor, product, release, 1, 2, serial_at, 1
    )  # fmt: skip
    bulk = b"".join(
        struct.pack("<BBBBHB", 7, 5, endpoint, 2, 1024, 0) + struct.pack("<BBBBH", 6, 48, 15, 0, 0)
        for endpoint in endpoints
    )
    interface = struct.pack("<BBBBBBBBB", 9, 4, 0, 0, len(endpoints), 0xFF, 0, 0, 0) + bulk
    return device + struct.pack("<BBHBBBBB", 9, 2, 9 + len(interface), 1, 1, 0, 0x80, 50) + interface


def described(descriptors: bytes, strings: Sequence[str], value: int) -> bytes | None:
    """Answer a request for a descriptor, ``None`` if there is none of that kind and number."""
    kind, number = value >> 8, value & 0xFF
    if kind == 3:
        languages = b"\x04\x03\x09\x04"
        return languages if number == 0 else string(strings[number - 1]) if number <= len(strings) else None
    return {1: descriptors[:18], 2: descriptors[18:]}.get(kind)


class Outbox:
    """Packets of a streaming endpoint."""

    def __init__(self) -> None:
        self._waiting: deque[bytes | None] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, packet: bytes) -> None:
        """Queue a packet; one that is longer than the host asks for goes in several."""
        self._waiting.append(packet)

    def forget(self) -> None:
        """Drop what waits."""
        self._waiting.clear()

    def stall(self) -> None:
        """Let the next request fail, as an endpoint does that has lost its way."""
        self._waiting.appendleft(None)

    def take(self, length: int) -> bytes | None:
        """Return what goes into a request of *length* bytes, ``None`` for nothing yet."""
        if not self._waiting:
            return None
        packet = self._waiting.popleft()
        if packet is None:
            raise BrokenPipeError
        if len(packet) > length:
            self._waiting.appendleft(packet[length:])
        return packet[:length]
