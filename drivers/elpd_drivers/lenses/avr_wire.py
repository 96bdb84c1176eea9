"""The wire protocol of our own lens controller (drivers/firmware/protocol.h): frames, their check, replies."""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass

HALT, BRAKE = b"\xf1", b"\xf2"
_ESCAPE, _START, END = 0xFD, 0xFE, 0xFF
_CONTROL, _FLIP = 0xF0, 0x20

VERSION = 1
NAME = b"elpd-avr"

HELLO, STATUS, CONFIGURE, GO, SET_POSITION, HOME, IRIS, ENABLE = range(1, 9)
REPLY = 0x80

OK, BAD_CRC, UNKNOWN, LENGTH, RANGE, BUSY, LIMIT, OVERRUN, STOPPED = range(9)
STATUS_WORDS = {
    UNKNOWN: "an unknown command",
    LENGTH: "a payload of the wrong length",
    RANGE: "a value outside its range",
    BUSY: "not while moving",
    LIMIT: "the limit switch that way is closed",
}

MOVING, REFERENCED, AT_MIN, AT_MAX, HOMING, HOMING_FAILED, DEAD_MAN, STOPPED_BY_BYTE, LATE, IRIS_OPEN, ENABLED = (
    1 << bit for bit in range(11)
)

FASTEST_SPS = 16_000
TICKS_PER_S = 2_000_000
LONGEST_FRAME = 2 + 2 * 32
_REPLY = struct.Struct("<BBBHiiII")


def crc16(data: bytes) -> int:
    """Return the CRC-16 of *data*: polynomial 0x1021, start 0xFFFF, no reflection."""
    return binascii.crc_hqx(data, 0xFFFF)


def encode(sequence: int, command: int, payload: bytes = b"") -> bytes:
    """Return a frame, ready for the wire."""
    body = bytes((sequence, command)) + payload
    body += crc16(body).to_bytes(2, "little")
    out = bytearray((_START,))
    for byte in body:
        if byte >= _CONTROL:
            out += bytes((_ESCAPE, byte ^ _FLIP))
        else:
            out.append(byte)
    out.append(END)
    return bytes(out)


@dataclass(frozen=True, slots=True)
class Reply:
    """What a controller answered. ``stamp`` and ``step_stamp`` count ticks of 0.5 us, modulo 2³²."""

    sequence: int
    command: int
    status: int
    flags: int
    position: int
    velocity_sps: int
    stamp: int
    step_stamp: int
    more: bytes

    @property
    def since_step_s(self) -> float:
        """How long before the sample the last step was made."""
        return ((self.stamp - self.step_stamp) & 0xFFFFFFFF) / TICKS_PER_S


class Frames:
    """Bytes in, intact replies out; whatever is damaged is dropped and counted."""

    def __init__(self) -> None:
        self.damaged = 0
        self._held = bytearray()
        self._framing = self._escaped = False

    def feed(self, data: bytes) -> list[Reply]:
        """Return the replies that end in *data*."""
        replies = []
        for byte in data:
            if byte == _START:
                self.damaged += self._framing
                self._framing, self._escaped = True, False
                self._held.clear()
            elif not self._framing:
                continue
            elif byte == END:
                self._framing = False
                reply = _parse(bytes(self._held))
                if reply is None:
                    self.damaged += 1
                else:
                    replies.append(reply)
            elif byte == _ESCAPE:
                self._escaped = True
            elif byte >= _CONTROL or len(self._held) > LONGEST_FRAME:
                self._framing = False
                self.damaged += 1
            else:
                self._held.append(byte ^ _FLIP if self._escaped else byte)
                self._escaped = False
        return replies


def _parse(body: bytes) -> Reply | None:
    if len(body) < _REPLY.size + 2 or crc16(body[:-2]) != int.from_bytes(body[-2:], "little"):
        return None
    sequence, command, status, flags, position, velocity_sps, stamp, step_stamp = _REPLY.unpack(body[: _REPLY.size])
    more = body[_REPLY.size : -2]
    return Reply(sequence, command & ~REPLY, status, flags, position, velocity_sps, stamp, step_stamp, more)


def configure(
    acceleration_sps2: float, max_speed_sps: float, low: int, high: int, dead_man_ms: float, sync_steps: int
) -> bytes:
    """Return the payload of ``CONFIGURE``."""
    return struct.pack(
        "<IHiiHH", round(acceleration_sps2), int(max_speed_sps), low, high, round(dead_man_ms), sync_steps
    )


def go(target: int, speed_sps: float, for_ms: int = 0) -> bytes:
    """Return the payload of ``GO``; 0 ms: as long as it takes."""
    return struct.pack("<iHH", target, max(2, round(speed_sps)), for_ms)


def home(fast_sps: float, slow_sps: float, for_ms: int) -> bytes:
    """Return the payload of ``HOME``."""
    return struct.pack("<HHH", round(fast_sps), max(2, round(slow_sps)), for_ms)
