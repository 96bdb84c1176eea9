"""The bytes of a Pololu Tic's serial port: commands, framing, CRC, and the one reply that the driver asks for.

From the user's guide, sections 7 (variables), 8 (commands) and 9 (serial). Pure functions.
"""

from __future__ import annotations

from dataclasses import dataclass

HALT_AND_HOLD, ENERGIZE, DEENERGIZE, EXIT_SAFE_START, RESET_TIMEOUT = 0x89, 0x85, 0x86, 0x83, 0x8C
GO_HOME, GET_VARIABLE = 0x97, 0xA1
SET_TARGET_POSITION, SET_TARGET_VELOCITY, HALT_AND_SET_POSITION = 0xE0, 0xE3, 0xEC
SET_MAX_SPEED, SET_STARTING_SPEED, SET_MAX_DECELERATION, SET_MAX_ACCELERATION = 0xE6, 0xE5, 0xE9, 0xEA

SINCE_LAST_STEP, SINCE_PER_US = (0x2E, 4), 3
"""Where the time since the last step stands and how long it is; in thirds of a microsecond."""

ENERGIZED, UNCERTAIN, FORWARD_LIMIT, REVERSE_LIMIT, HOMING = 1, 2, 4, 8, 16
ERROR_WORDS = {
    0x01: "de-energized",
    0x02: "motor driver error",
    0x04: "supply voltage low",
    0x08: "kill switch active",
    0x10: "required input invalid",
    0x20: "serial error",
    0x40: "command timeout",
    0x80: "safe start violation",
    0x100: "ERR line high",
}
RECOVERABLE = 0x20 | 0x40 | 0x80
OPERATION_STATES = frozenset({0, 2, 4, 6, 8, 10})


def crc7(data: bytes) -> int:
    """Return the CRC-7 of Pololu's serial protocols (polynomial 0x91, least significant bit first; guide §9)."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc ^ 0x91) >> 1 if crc & 1 else crc >> 1
    return crc


def encode(command: int, data: bytes = b"", *, device_number: int | None = None, crc: bool = False) -> bytes:
    """Frame a command: compact, or Pololu's with a device number; with a CRC byte where asked for."""
    frame = bytes((command,)) if device_number is None else bytes((0xAA, device_number & 0x7F, command & 0x7F))
    frame += data
    return frame + bytes((crc7(frame),)) if crc else frame


def long_word(value: int) -> bytes:
    """Return the five data bytes of a signed 32-bit value: the four top bits together, then seven bits of each byte."""
    raw = (value & 0xFFFF_FFFF).to_bytes(4, "little")
    tops = sum((byte >> 7) << index for index, byte in enumerate(raw))
    return bytes((tops, *(byte & 0x7F for byte in raw)))


@dataclass(frozen=True, slots=True)
class TicReply:
    """Variables 0x22 to 0x29 and 0x01 to 0x03: position in microsteps, velocity, miscellaneous flags, error status."""

    position: int
    velocity_sps: float
    flags: int
    errors: int


def reply_length(*, crc: bool) -> int:
    """Return how many bytes answer the driver's two block reads."""
    return 8 + 3 + 2 * crc


def parse_reply(raw: bytes, *, crc: bool) -> TicReply | None:
    """Read the answers to the two block reads, or return None for what cannot be one.

    Without CRC the Tic's replies carry no redundancy but the bits that are always zero.
    """
    if len(raw) != reply_length(crc=crc):
        return None
    if crc:
        if crc7(raw[:8]) != raw[8] or crc7(raw[9:12]) != raw[12]:
            return None
        raw = raw[:8] + raw[9:12]
    velocity = int.from_bytes(raw[4:8], "little", signed=True) / 10_000
    errors = int.from_bytes(raw[9:11], "little")
    if raw[8] & 0xE0 or errors & 0xFE00:
        return None
    return TicReply(int.from_bytes(raw[0:4], "little", signed=True), velocity, raw[8], errors)
