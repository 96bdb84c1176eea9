"""The lines of Kurokesu's SCF4: what is said to its motors, and how its replies read. Pure functions.

From the maker's page of commands and the examples of the SDK, which disagree in places: what they disagree on is
found out on the device (``scf4_homing``).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

MOTORS = ("A", "B", "C")
LENS_MOTOR = "A"
STATUS = b"!1\n"
STOP = b"M0 A\n"
VERSION = b"$S\n"
INITIALIZE = b"$B2\n"
RESET_DRIVER = b"$B1\n"
HOMED_COUNT = 32_000
"""What the counter is set to at the edge of the photo-interrupter, as in the maker's examples: a board that has
restarted counts from 0, which no place of an ordinary lens is then."""

WRAP = 1 << 16
LONGEST_MOVE = WRAP - 1
FASTEST_CODE, SLOWEST_CODE = 250, 16_000
"""The codes of ``M240`` that the maker's examples use; the larger, the slower."""

_VERSION = re.compile(r"([\w.]+), *(SCF4[^,]*), *Kurokesu\b.*")
_STATUS = re.compile(r" *\d{1,5}( *, *\d{1,5}){8} *")


@dataclass(frozen=True, slots=True)
class Status:
    """A motor: its counter (0 to 65535), whether its photo-interrupter reads 1, and whether it moves."""

    count: int
    interrupter: bool
    moving: bool


def order(text: str) -> bytes:
    """Frame a command."""
    return f"{text}\n".encode("ascii")


def parse_status(line: str, motor: str = LENS_MOTOR) -> Status | None:
    """Read what the reply to ``!1`` says of a motor; None for anything else."""
    if not _STATUS.fullmatch(line):
        return None
    numbers = [int(part) for part in line.split(",")]
    if max(numbers[:3]) >= WRAP or max(numbers[3:]) > 1:
        return None
    at = MOTORS.index(motor)
    return Status(numbers[at], bool(numbers[3 + at]), bool(numbers[6 + at]))


def parse_version(line: str) -> tuple[str, str] | None:
    """Return firmware and model from the reply to ``$S``; None for anything else."""
    found = _VERSION.fullmatch(line.strip())
    return None if found is None else (found[1], found[2])


def refusal(line: str) -> bool:
    """Say whether a line refuses a command."""
    return line.upper().startswith("ERR")


def unwrapped(count: int, near: int) -> int:
    """Return the count that reads *count* in 16 bits and lies nearest to *near*."""
    return near + (count - near + WRAP // 2) % WRAP - WRAP // 2
