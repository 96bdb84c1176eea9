"""What the firmwares of the GRBL 1.1 family do differently, and how each is known: by its answer to ``$I``.

Facts, not branches: a driver asks the table. Sources: the firmwares' own documentation of ``$I``, greeting and status
reports; for GRBL also its behaviour under test.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

HOMED_BY_US = 197
"""A tool number that says "homed, and not reset since" to the next program that opens the board."""


@dataclass(frozen=True, slots=True)
class Dialect:
    """One firmware.

    ``version`` matches its ``[VER:`` line. ``home`` is the line that homes the lens's axis. ``stop_onset_ms`` is the
    time from a stop byte to the first slower segment where nobody has calibrated it: so long is what was prepared.
    ``remembers`` says that a tool number is kept until a reset and does nothing else.
    """

    name: str
    version: re.Pattern[str]
    home: bytes
    stop_onset_ms: float
    stop_onset_sigma_ms: float
    remembers: bool


DIALECTS = (
    # 10 segments of 10 ms instead of 6 (of which 5 run ahead); X is one of four axes and homed alone
    Dialect("SCE2", re.compile(r"\[VER:1\.1\w?-SCE2\b"), b"$HX\n", 90.0, 6.0, remembers=False),
    Dialect("FluidNC", re.compile(r"\[VER:\d[\d.]* FluidNC\b"), b"$HX\n", 45.0, 15.0, remembers=False),
    Dialect("grblHAL", re.compile(r"\[FIRMWARE:grblHAL\]"), b"$HX\n", 45.0, 15.0, remembers=False),
    Dialect("GRBL", re.compile(r"\[VER:1\.1[a-z]?\."), b"$H\n", 45.0, 3.0, remembers=True),
)


def dialect_of(version: list[str]) -> Dialect | None:
    """Return whose answer to ``$I`` *version* is; ``None``: nobody's that is known."""
    for dialect in DIALECTS:
        if any(dialect.version.match(line) for line in version):
            return dialect
    return None
