"""What a Tic's serial port understands: which bytes are commands, how long they are, and how memory is laid out."""

from __future__ import annotations

from dataclasses import dataclass, field

QUICK = frozenset({0x83, 0x85, 0x86, 0x89, 0x8A, 0x8C, 0x8F, 0xB0})
SEVEN_BIT = frozenset({0x91, 0x92, 0x94, 0x97, 0x98})
LONG = frozenset({0xE0, 0xE3, 0xE5, 0xE6, 0xE9, 0xEA, 0xEC})
BLOCK = frozenset({0xA1, 0xA2, 0xA8})
CLEARS_SERIAL_ERROR = frozenset({0xE0, 0xE3, 0xEC, 0x89, 0x85, 0x83, 0xB0})
MAX_BLOCK = 15
NOT_A_COMMAND = 0  # stands in the queue of commands for a frame that was none


def crc7(data: bytes) -> int:
    """Return the CRC that the Tic wants behind a command: polynomial 0x91, least significant bit first."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc ^ 0x91) >> 1 if crc & 1 else crc >> 1
    return crc


@dataclass(slots=True)
class MemoryMap:
    """256 bytes, little-endian fields at offsets."""

    data: bytearray = field(default_factory=lambda: bytearray(256))

    def put(self, offset: int, size: int, value: int) -> None:
        """Write a field; a negative value in two's complement."""
        self.data[offset : offset + size] = (int(value) & ((1 << 8 * size) - 1)).to_bytes(size, "little")


def payload_length(command: int) -> int | None:
    """Return how many data bytes follow a command, or None for what is no command."""
    if command in QUICK:
        return 0
    if command in SEVEN_BIT:
        return 1
    if command in BLOCK:
        return 2
    return 5 if command in LONG else None


def decode_long(payload: bytes) -> int:
    """Put the top bits, sent together in the first byte, back on their bytes."""
    raw = bytes(payload[1 + i] | ((payload[0] >> i) & 1) << 7 for i in range(4))
    return int.from_bytes(raw, "little", signed=True)
