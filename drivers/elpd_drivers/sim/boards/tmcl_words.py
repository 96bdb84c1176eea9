"""What a TMCL module understands: datagrams, status codes, axis parameters at power-up, and the units of motion."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

WITH_TMC429 = frozenset({1110, 1140, 1141, 1160, 1161, 3110, 6110})
TMC429_CLOCK_HZ = 16e6


class Status(IntEnum):
    """The third byte of a reply."""

    WRONG_CHECKSUM = 1
    INVALID_COMMAND = 2
    WRONG_TYPE = 3
    INVALID_VALUE = 4
    OK = 100


def as_signed(value: int) -> int:
    """Return the low 32 bits of *value* as a signed number."""
    return (value + (1 << 31)) % (1 << 32) - (1 << 31)


@dataclass(frozen=True, slots=True)
class Datagram:
    """A command, taken apart."""

    LENGTH: ClassVar[int] = 9

    command: int
    kind: int
    bank: int
    value: int

    @classmethod
    def read(cls, raw: bytes) -> Datagram | None:
        """Take nine bytes apart, or return None for a wrong checksum."""
        if sum(raw[:8]) % 256 != raw[8]:
            return None
        return cls(raw[1], raw[2], raw[3], as_signed(int.from_bytes(raw[4:8], "big")))


def reply_bytes(host: int, address: int, status: Status, command: int, value: int) -> bytes:
    """Put a reply together."""
    raw = bytes((host, address, status, command)) + (value % (1 << 32)).to_bytes(4, "big")
    return raw + bytes((sum(raw) % 256,))


@dataclass(frozen=True, slots=True)
class MotionUnits:
    """Microsteps/s and microsteps/s² of one unit; with divisors those of a TMC429, else pulses per second."""

    pulse_divisor: int | None = None
    ramp_divisor: int = 0

    @property
    def internal(self) -> bool:
        """Whether they are a TMC429's."""
        return self.pulse_divisor is not None

    @property
    def speed_sps(self) -> float:
        """One unit of speed."""
        return 1.0 if self.pulse_divisor is None else TMC429_CLOCK_HZ / (2.0**self.pulse_divisor * 2048 * 32)

    @property
    def acceleration_sps2(self) -> float:
        """One unit of acceleration."""
        if self.pulse_divisor is None:
            return 1.0
        return TMC429_CLOCK_HZ * TMC429_CLOCK_HZ / 2.0 ** (self.pulse_divisor + self.ramp_divisor + 29)

    @property
    def largest(self) -> int:
        """The largest speed or acceleration that can be set."""
        return 2047 if self.internal else 16_777_215


READ_ONLY = frozenset({3, 8, 9, 10, 11, 135, 206, 207, 208})
AXIS_DEFAULTS = {
    **dict.fromkeys((0, 1, 2, 3, 9, 10, 11, 12, 13, 130, 135, 138, 149, 194, 195, 196, 204, 206, 207, 208, 209), 0),
    4: 51_200,
    5: 51_200,
    6: 128,
    7: 8,
    8: 1,
    140: 8,
    193: 1,
}
"""Axis parameters at power-up."""
