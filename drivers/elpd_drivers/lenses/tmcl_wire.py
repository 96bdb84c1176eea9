"""The bytes of Trinamic's TMCL: nine each way, big-endian, with a checksum; and the units of its motion controllers.

From the TMCL reference and firmware manuals (chapters "binary command format", "axis parameters"). Pure functions and
one buffer. Older modules (TMC429 inside) count speed and acceleration in units of their own, set by two divisors that
they tell as axis parameters 153 and 154; newer ones count pulses per second.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

FRAME = 9
ROR, ROL, MST, MVP, SAP, GAP, SGP, GGP, RFS, SIO, GET_VERSION = 1, 2, 3, 4, 5, 6, 9, 10, 13, 14, 136
ABSOLUTE = 0
START, STOP, STATUS = 0, 1, 2
OK = 100
STATUS_WORDS = {
    1: "wrong checksum",
    2: "invalid command",
    3: "wrong type",
    4: "invalid value",
    5: "configuration locked",
    6: "command not available",
}
TARGET_POSITION, POSITION, SPEED, MAX_SPEED, MAX_ACCELERATION, RUN_CURRENT, STANDBY_CURRENT = 0, 1, 3, 4, 5, 6, 7
RIGHT_SWITCH, LEFT_SWITCH, RIGHT_SWITCH_OFF, LEFT_SWITCH_OFF = 10, 11, 12, 13
RAMP_DIVISOR, PULSE_DIVISOR = 153, 154
SEARCH_MODE, SEARCH_SPEED, SWITCH_SPEED = 193, 194, 195
DRIVER_FLAGS = 208
SEARCH_LEFT_SWITCH = 1
DRIVER_WORDS = {2: "too hot", 8: "short circuit of phase A", 16: "short circuit of phase B"}
USER_BANK = 2
OUTPUT_BANK = 2
"""Of ports; SIO takes it where others take the motor."""

TMC429_HZ = 16_000_000
TMC429_MAX = 2047

STEPPER_MODULES = frozenset(
    {1021, 1110, 1111, 1140, 1141, 1160, 1161, 1210, 1211, 1240, 1241, 1260, 1270, 1276, 1278, 1290, 1311, 1316, 1321}
    | {1370, 1378, 3110, 3216, 3312, 3351, 6110, 6212, 6214}
)
"""Stepper modules with TMCL firmware, by the number that they answer to command 136."""


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply whose checksum was right. ``value`` is signed."""

    status: int
    command: int
    value: int


@dataclass(frozen=True, slots=True)
class Firmware:
    """What a module says that it is."""

    module: int
    version: str


def checksum(data: bytes) -> int:
    """Return the sum of all bytes, modulo 256."""
    return sum(data) & 0xFF


def request(address: int, command: int, kind: int = 0, motor: int = 0, value: int = 0) -> bytes:
    """Frame a command to the module at *address*; *motor* is the bank for global parameters."""
    frame = bytes((address, command, kind, motor)) + (value & 0xFFFF_FFFF).to_bytes(4, "big")
    return frame + bytes((checksum(frame),))


def parse_version(raw: bytes, host: int) -> Firmware | None:
    """Find a module's answer to command 136 (as text) in *raw*: nine bytes without a checksum."""
    found = re.search(rb"%b(\d{3,4})V(\d)\.?(\d\d)" % re.escape(bytes((host,))), raw)
    return None if found is None else Firmware(int(found[1]), f"{found[2].decode()}.{found[3].decode()}")


class Replies:
    """Cuts what arrives into replies; what is none is skipped byte by byte until one fits."""

    def __init__(self, address: int, host: int) -> None:
        self._head = bytes((host, address))
        self._received = bytearray()

    def feed(self, data: bytes) -> list[tuple[Reply, int]]:
        """Return the replies that are complete now, each with the number of bytes behind it."""
        self._received += data
        found: list[tuple[Reply, int]] = []
        while len(self._received) >= FRAME:
            raw = bytes(self._received[:FRAME])
            if not raw.startswith(self._head) or checksum(raw[:-1]) != raw[-1]:
                del self._received[0]
                continue
            del self._received[:FRAME]
            value = int.from_bytes(raw[4:8], "big", signed=True)
            found.append((Reply(raw[2], raw[3], value), len(self._received)))
        return found

    def clear(self) -> None:
        """Forget what is incomplete."""
        self._received.clear()


@dataclass(frozen=True, slots=True)
class Units:
    """How a module counts speed and acceleration: pulses per second, or a TMC429's own with its two divisors."""

    pulse_divisor: int | None = None
    ramp_divisor: int = 0

    @property
    def speed_sps(self) -> float:
        """Microsteps/s of one unit of speed (TMC429 data sheet: ``f / 2^pulse_div / 2048 / 32``)."""
        return 1.0 if self.pulse_divisor is None else TMC429_HZ / 2**self.pulse_divisor / 2048 / 32

    @property
    def acceleration_sps2(self) -> float:
        """Microsteps/s² of one unit of acceleration (``f² / 2^(pulse_div + ramp_div + 29)``)."""
        if self.pulse_divisor is None:
            return 1.0
        return TMC429_HZ**2 / 2.0 ** (self.pulse_divisor + self.ramp_divisor + 29)

    def speed(self, sps: float) -> int:
        """Return the next lower unit of speed, at least 1."""
        return max(1, int(sps / self.speed_sps + 1e-9))

    def acceleration(self, sps2: float) -> int:
        """Return the next lower unit of acceleration, at least 1."""
        return max(1, int(sps2 / self.acceleration_sps2 + 1e-9))

    def fits(self, sps: float, sps2: float) -> bool:
        """Say whether a module of these units can go so fast, and speed up so."""
        return self.pulse_divisor is None or max(self.speed(sps), self.acceleration(sps2)) <= TMC429_MAX
