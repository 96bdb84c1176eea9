"""The lines of GRBL 1.1: status reports, jogs, and what its numbers mean. Pure functions."""

from __future__ import annotations

import re
from dataclasses import dataclass

STATUS, CANCEL, RESUME, RESET = b"?", b"\x85", b"~", b"\x18"
FULL_STATUS = b"\x87"
"""Asks for a report with every field that there is; grblHAL knows it, GRBL takes it as a letter."""

ERROR_WORDS = {
    "1": "expected a letter",
    "2": "bad number",
    "3": "unknown $ statement",
    "4": "negative value",
    "5": "homing is off, $22=0",
    "8": "not idle",
    "9": "locked",
    "7": "settings could not be read",
    "15": "beyond the travel",
    "16": "invalid jog",
    "20": "unsupported",
    "22": "no feed",
}
ALARM_WORDS = {
    "1": "hard limit",
    "2": "soft limit",
    "3": "reset in motion",
    "6": "homing was reset",
    "7": "door opened while homing",
    "8": "homing could not leave the switch",
    "9": "homing did not find the switch",
}
OUTPUTS = {
    "coolant": (b"M8\n", b"M9\n"),
    "spindle": (b"M3S1000\n", b"M5\n"),
    "iris": (b"M114P1\n", b"M114P0\n"),
}
"""What switches an output on and off. The iris is Kurokesu's SCE2's; other boards refuse it (error 20)."""

_STATE = re.compile(r"<(Idle|Jog|Run|Hold:[01]|Alarm|Home|Door:[0-4]|Check|Sleep|Tool)(?::\d+)?\|")
_POSITION = re.compile(r"\|MPos:(-?\d+\.\d{3,4}),[-\d.,]+[|>]")
_HOMED = re.compile(r"\|H:1[,|>]")
_PINS = re.compile(r"\|Pn:([A-Z]+)[|>]")


@dataclass(frozen=True, slots=True)
class Status:
    """What a status report says; ``homed`` where it has a field for that. A code behind the state is left out."""

    state: str
    x_mm: float
    pins: str = ""
    homed: bool = False


def parse_status(line: str) -> Status | None:
    """Read a status report, or return None for anything that is not a whole and sane one."""
    if not line.endswith(">") or line.count("<") != 1 or line.count(">") != 1:
        return None
    state, position, pins = _STATE.match(line), _POSITION.search(line), _PINS.search(line)
    if state is None or position is None:
        return None
    return Status(state[1], float(position[1]), pins[1] if pins else "", _HOMED.search(line) is not None)


def jog_line(x_mm: float, feed_mm_min: float) -> bytes:
    """Return a jog to an absolute machine position, in mm and mm/min whatever the board's modal state."""
    return f"$J=G21G90G53X{x_mm:.5f}F{feed_mm_min:.3f}\n".encode("ascii")
