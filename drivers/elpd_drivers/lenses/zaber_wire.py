"""The lines of Zaber's ASCII protocol (firmware 7): commands, replies, checksums, warning flags, and its units.

From the ASCII protocol manual, chapters "message format", "warning flags" and "data". Pure functions.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

NOT_REFERENCED = frozenset({"WR", "WH"})
LIMIT = "WL"
FAULT_WORDS = {
    "FF": "critical system error",
    "FH": "hardware emergency stop",
    "FV": "supply voltage out of range",
    "FO": "driver switched off",
    "FC": "current inrush",
    "FM": "motor or driver too hot",
    "FD": "driver disabled",
    "FQ": "encoder error",
    "FI": "index error",
    "FR": "overdriven",
    "FS": "stalled and stopped",
    "FE": "limit sensor error",
    "FT": "too much twist",
}
REJECTIONS = {
    "AGAIN": "busy with something else",
    "BADAXIS": "no such axis",
    "BADCOMMAND": "unknown command",
    "BADDATA": "value out of range",
    "DRIVERDISABLED": "the driver is off",
    "STATUSBUSY": "not while it moves",
}
SPEED_PER_SPS = 1.6384
ACCELERATION_PER_SPS2 = 1.6384e-4

_REPLY = re.compile(r"@(\d\d) (\d)(?: (\d\d))? (OK|RJ) (BUSY|IDLE) (--|[A-Z]{2}) ([^:]*)")
_ALERT = re.compile(r"!(\d\d) (\d) (BUSY|IDLE) (--|[A-Z]{2})")
_CHECKED = re.compile(r"(.*):([0-9A-F]{2})")


@dataclass(frozen=True, slots=True)
class Reply:
    """What a device said. ``number`` is the message's, ``None`` where it had none (or was an alert)."""

    device: int
    axis: int
    number: int | None
    accepted: bool
    busy: bool
    flag: str
    data: str
    checked: bool


def checksum(message: str) -> str:
    """Return the two hexadecimal digits that make the sum of all bytes behind the first a multiple of 256."""
    return f"{-sum(message[1:].encode('ascii')) & 0xFF:02X}"


def command(device: int, axis: int, words: str, number: int | None = None) -> bytes:
    """Frame a command, with its checksum, and a number that the reply will repeat."""
    message = f"/{device} {axis} {words}" if number is None else f"/{device} {axis} {number:02d} {words}"
    return f"{message}:{checksum(message)}\n".encode("ascii")


def parse_reply(line: str, *, checked_only: bool = False) -> Reply | None:
    """Read a reply or an alert; None for anything else, and for a wrong (or, with *checked_only*, no) checksum."""
    checked = _CHECKED.fullmatch(line)
    if checked is not None:
        line = checked[1]
        if checksum(line) != checked[2]:
            return None
    elif checked_only:
        return None
    found = _REPLY.fullmatch(line)
    if found is not None:
        number = None if found[3] is None else int(found[3])
        accepted, busy = found[4] == "OK", found[5] == "BUSY"
        return Reply(int(found[1]), int(found[2]), number, accepted, busy, found[6], found[7], checked is not None)
    alert = _ALERT.fullmatch(line)
    if alert is not None:
        busy = alert[3] == "BUSY"
        return Reply(int(alert[1]), int(alert[2]), None, accepted=True, busy=busy, flag=alert[4], data="", checked=True)
    return None
