"""What GRBL 1.1h reads and prints: settings, jog and motion lines, status reports. No state, no motion.

The texts are the firmware's own (its wiki: interface, configuration and jogging pages); what a lens does not have
(spindle, coolant, arcs, tools) is refused as unsupported, ``error:20``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

UNLOCK = "[MSG:'$H'|'$X' to unlock]"
UNLOCKED = "[MSG:Caution: Unlocked]"
RESET_TO_CONTINUE = "[MSG:Reset to continue]"
HELP = "[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]"
PARAMETERS = (
    *(f"[G{code}:0.000,0.000,0.000]" for code in (54, 55, 56, 57, 58, 59, 28, 30, 92)),
    "[TLO:0.000]",
    "[PRB:0.000,0.000,0.000:0]",
)

BAD_NUMBER, BAD_STATEMENT, NEGATIVE, HOMING_OFF, NOT_IDLE, LOCKED = 2, 3, 4, 5, 8, 9
EXPECTED_LETTER, SOFT_NEEDS_HOMING, LINE_TOO_LONG, BEYOND_TRAVEL, BAD_JOG = 1, 10, 11, 15, 16
UNSUPPORTED, NO_FEED = 20, 22
NOT_IN_ALARM = 79


@dataclass(frozen=True, slots=True)
class Firmware:
    """What one firmware of the family says and does.

    ``prepared`` is how many segments of 10 ms run before a stop bites, ``one_axis_homing`` whether ``$HX`` is known
    (and ``one_axis_flag`` the flag of ``$22`` that it needs), ``tells_homing`` whether status is reported while homing
    (GRBL's own cycle answers nothing until it is over). With ``tells_homed`` a full report (0x87) says whether the axis
    is homed. With ``hears_in_alarm`` the firmware answers after a hard limit, and with the alarm's number, though it
    allows nothing before a reset; it sleeps over no alarm. ``has_iris``: M114 switches one.
    """

    greeting: str
    version: tuple[str, ...]
    axes: int = 3
    prepared: int = 5
    one_axis_homing: bool = True
    tells_homing: bool = False
    one_axis_flag: int = 0
    tells_homed: bool = False
    hears_in_alarm: bool = False
    has_iris: bool = False


FIRMWARES = {
    "grbl": Firmware("\r\nGrbl 1.1h ['$' for help]", ("[VER:1.1h.20190830:]", "[OPT:V,15,128]"), one_axis_homing=False),
    "grblhal": Firmware(
        "\r\nGrblHAL 1.1f ['$' or '$HELP' for help]",
        ("[VER:1.1f.20240815:]", "[OPT:VNMSL,100,1024,3,0]", "[FIRMWARE:grblHAL]", "[DRIVER:iMXRT1062]"),
        prepared=2,
        tells_homing=True,
        one_axis_flag=2,
        tells_homed=True,
        hears_in_alarm=True,
    ),
    "fluidnc": Firmware(
        "\r\nGrbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]",
        ("[VER:3.7 FluidNC v3.7.8:]", "[OPT:MPHS]", "[MSG: Machine: lens]"),
        tells_homing=True,
    ),
    "sce2": Firmware(
        "\r\nGrbl 1.1f-SCE2 ['$' for help]",
        ("[VER:1.1f-SCE2.20211130:L086,6ZG-BEG19]", "[OPT:V,15,254]"),
        axes=4,
        has_iris=True,
        prepared=10,
    ),
}


SCE2_OUTPUT_WORDS = {"M114P1": ("iris", True), "M114P0": ("iris", False)}


class GrblError(Exception):
    """A line that the firmware answers with ``error:N``."""

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


@dataclass(slots=True)
class GrblSettings:
    """The ``$`` settings that matter here, for a lens of 3200 microsteps per mm; the rest keep GRBL's defaults."""

    values: dict[int, float]

    @classmethod
    def for_lens(
        cls, steps_per_mm: float, travel_mm: float, speed_mm_min: float, acceleration_mm_s2: float
    ) -> GrblSettings:
        """Return settings as a careful builder of a lens rig would have made them."""
        values = {0: 10, 1: 25, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0}
        values |= {20: 1, 21: 1, 22: 1, 23: 1, 24: 25, 25: 150, 26: 25, 27: 0.05, 30: 1000, 31: 0, 32: 0}
        for axis in range(3):
            values |= {100 + axis: steps_per_mm, 110 + axis: speed_mm_min, 120 + axis: acceleration_mm_s2}
            values |= {130 + axis: travel_mm if axis == 0 else 200}
        return cls({number: float(value) for number, value in values.items()})

    def lines(self) -> list[str]:
        """Return what ``$$`` prints."""
        return [f"${number}={_number(number, value)}" for number, value in sorted(self.values.items())]

    def assign(self, number: int, text: str) -> None:
        """Change a setting as ``$number=text`` does. Raises ``GrblError``."""
        value = parse_number(text)
        if number not in self.values:
            raise GrblError(BAD_STATEMENT)
        if value < 0:
            raise GrblError(NEGATIVE)
        if number == 20 and value and not self.values[22]:
            raise GrblError(SOFT_NEEDS_HOMING)
        self.values[number] = value
        if number == 22 and not value:
            self.values[20] = 0.0

    def __getitem__(self, number: int) -> float:
        return self.values[number]


@dataclass(frozen=True, slots=True)
class MotionWords:
    """What a motion line asks for: X in mm (None: no X), absolute or not, and its feed in mm/min (None: unsaid)."""

    x_mm: float | None
    relative: bool | None
    feed_mm_min: float | None
    mode: int | None
    machine: bool
    tool: int | None = None


_WORD = re.compile(r"([A-Z])([+-]?\d*\.?\d*)")


def parse_number(text: str) -> float:
    """Read a number as GRBL does: no exponent. Raises ``GrblError``."""
    if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)", text):
        raise GrblError(BAD_NUMBER)
    return float(text)


OUTPUT_WORDS = {
    "M8": ("coolant", True),
    "M9": ("coolant", False),
    "M3S1000": ("spindle", True),
    "M5": ("spindle", False),
}


def parse_motion(line: str, *, jog: bool) -> MotionWords:
    """Read the words of a motion line (spaces and case already removed). Raises ``GrblError``."""
    x_mm = relative = feed = mode = None
    machine, tool = False, None
    scale = 1.0
    position = 0
    while position < len(line):
        match = _WORD.match(line, position)
        if match is None:
            raise GrblError(EXPECTED_LETTER)
        letter, value = match[1], parse_number(match[2])
        position = match.end()
        if letter == "G" and value in {20.0, 21.0}:
            scale = 25.4 if value == 20.0 else 1.0
        elif letter == "G" and value in {90.0, 91.0}:
            relative = value == 91.0
        elif letter == "G" and value == 53.0:
            machine = True
        elif letter == "G" and value in {0.0, 1.0} and not jog:
            mode = int(value)
        elif letter == "G" and value in {17.0, 54.0, 94.0} and not jog:
            continue
        elif letter == "T" and not jog and 0 <= value <= 255:
            tool = int(value)
        elif letter == "X":
            x_mm = value
        elif letter == "F":
            if value < 0:
                raise GrblError(NEGATIVE)
            feed = value
        elif letter in "YZN":
            continue
        elif jog and letter in "GM":
            raise GrblError(BAD_JOG)
        else:
            raise GrblError(UNSUPPORTED)
    if x_mm is not None:
        x_mm *= scale
    return MotionWords(x_mm, relative, None if feed is None else feed * scale, mode, machine, tool)


def status_report(
    state: str,
    position_mm: float,
    feed_mm_min: float,
    *,
    pins: str = "",
    wco: bool = False,
    overrides: bool = False,
    axes: int = 3,
    homed: bool | None = None,
) -> str:
    """Return a status report with machine position, in GRBL's field order."""
    others = ",0.000" * (axes - 1)
    fields = [state, f"MPos:{position_mm:.3f}{others}", f"FS:{feed_mm_min:.0f},0"]
    if pins:
        fields.append(f"Pn:{pins}")
    if wco:
        fields.append(f"WCO:0.000{others}")
    elif overrides:
        fields.append("Ov:100,100,100")
    if homed is not None:
        fields.append(f"H:{int(homed)},{int(homed)}")
    return f"<{'|'.join(fields)}>"


def _number(number: int, value: float) -> str:
    return f"{value:.3f}" if number in {11, 12, 24, 25, 27} or number >= 100 else f"{value:.0f}"
