"""What is asked of a GRBL board before it is a lens: is it there, is it GRBL 1.1, does it agree with the config.

A board may boot because its port was opened, may be dead after an alarm until it is reset, and may be executing
somebody else's jog. Each of these has an end in time here, and nothing is moved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.errors import ConfigError, LensError
from elpd.units import after_ms
from elpd_drivers.lenses.axis import limits_from
from elpd_drivers.lenses.grbl_dialect import DIALECTS, Dialect, dialect_of
from elpd_drivers.lenses.grbl_lines import CANCEL, FULL_STATUS, RESET, STATUS, Status, parse_status
from elpd_drivers.lenses.lines import LineReader

if TYPE_CHECKING:
    from elpd.ports import Clock
    from elpd.records import LensLimits
    from elpd_drivers.lenses.line import Line


@dataclass(frozen=True, slots=True)
class GrblLensSettings:
    """The table ``[lens]`` for GRBL. What the board knows (``$100``, ``$110``, ``$120``, ``$130``) is read from it.

    The travel ends half the pull-off (``$27``) before a homing switch that is a hard limit too (``$21``, ``$22``).
    ``um_per_step`` must agree with the board's ``$100``. ``stop_onset_ms`` is the time from a stop byte to the first
    slower segment; unless given, what the firmware is known for. ``trust_position`` believes any board that is idle
    when it is opened, instead of only one that this driver has homed and that was not reset since. ``latency_us`` and
    ``latency_sigma_us`` are for real-time bytes; unless given, a real port gets what USB adapters need, which is
    wider. ``connect_ms`` is the patience with a board that boots when its port is opened.
    """

    port: str = ""
    baud: int = 115_200
    um_per_step: float = 0.3125
    min_um: float = 0.0
    max_um: float | None = None
    max_speed_um_s: float | None = None
    acceleration_um_s2: float | None = None
    query_ms: float = 6.0
    reply_ms: float = 90.0
    connect_ms: float = 3000.0
    stop_onset_ms: float | None = None
    stop_onset_sigma_ms: float | None = None
    latency_us: float = 225.0
    latency_sigma_us: float = 101.0
    trust_position: bool = False


@dataclass(frozen=True, slots=True)
class BoardFacts:
    """What the board says about itself.

    ``homed``: by this driver, and not reset since. ``home`` is the line that homes it.
    ``restarted``: its banner came while it was looked at.
    """

    limits: LensLimits
    steps_per_mm: float
    travel_mm: float
    idle: bool
    homed: bool
    restarted: bool
    dialect: Dialect
    home: bytes


def handshake(line: Line, clock: Clock, settings: GrblLensSettings) -> BoardFacts:
    """Identify the board, stop it if it moves, and read its settings.

    Raises ``LensError`` if there is no GRBL 1.1, ``ConfigError`` if its settings contradict the config.
    """
    return _Handshake(line, clock, settings).run()


class _Handshake:
    def __init__(self, line: Line, clock: Clock, settings: GrblLensSettings) -> None:
        self._line, self._clock, self._settings = line, clock, settings
        self._lines = LineReader()
        self._restarted = False

    def run(self) -> BoardFacts:
        self._line.read()
        status = self._status()
        due = after_ms(self._clock.now_ns(), self._settings.connect_ms)
        while status.state not in {"Idle", "Alarm"}:
            # somebody else's motion; what a cancel does not end (a hold), a reset does
            now = self._clock.now_ns()
            if now >= after_ms(due, self._settings.connect_ms):
                raise LensError(
                    f"lens port {self._line.name}: GRBL stays in state {status.state}; switch it off and on"
                )
            self._line.send(CANCEL if now < due else RESET)
            self._clock.sleep_until(after_ms(now, 100))
            status = self._status()
        version = self._version()
        dialect = dialect_of(version)
        if dialect is None:
            raise LensError(
                f"lens port {self._line.name}: this driver knows {', '.join(known.name for known in DIALECTS)}; the "
                f"board says {' '.join(version)[:80]!r}; update its firmware, or choose another lens.driver"
            )
        board = self._numbers(self._ask("$$", "$"))
        limits = _agreed_limits(board, self._settings, dialect)
        if status.state == "Alarm" and dialect.reset_after_alarm:
            status = self._reset()
        idle = status.state == "Idle"
        homed = idle and self._has_kept(dialect.homed_by_us)
        if homed and dialect.tells_homed:
            homed = self._status(FULL_STATUS).homed
        home = dialect.home_line(board.get(22, 0.0))
        return BoardFacts(limits, board[100], board[130], idle, homed, self._restarted, dialect, home)

    def _version(self) -> list[str]:
        """Ask for the version; a board that tells its state but takes no line is in a hold, which a reset ends.

        A resume would end it too, and begin whatever motion another session has left in the board.
        """
        try:
            return self._ask("$I", "[")
        except LensError:
            self._line.send(RESET)
            self._restarted = True
            self._status()
            return self._ask("$I", "[")

    def _has_kept(self, word: str) -> bool:
        """Say whether *word* is among the modes that the board is in."""
        return word != "" and any(word in line.strip("[]").split() for line in self._ask("$G", "[GC:"))

    def _reset(self) -> Status:
        """Reset a board that is locked, and so has no position to lose; return its status after the banner."""
        self._restarted = False
        self._line.send(RESET)
        due = after_ms(self._clock.now_ns(), self._settings.connect_ms)
        while not self._restarted:
            for line, _ in self._lines.feed(self._line.read()):
                self._restarted = self._restarted or _is_banner(line)
            now = self._clock.now_ns()
            if now >= due:
                raise LensError(
                    f"lens port {self._line.name}: no banner within {self._settings.connect_ms:.0f} ms of a reset; "
                    "switch the board off and on"
                )
            self._clock.sleep_until(after_ms(now, 1))
        return self._status()

    def _status(self, question: bytes = STATUS) -> Status:
        """Wait for a status report; a board that says nothing may be dead after an alarm, or booting."""
        start = self._clock.now_ns()
        due = after_ms(start, self._settings.connect_ms)
        reset_at = after_ms(start, self._settings.connect_ms / 2)
        ask_at, seen = start, ""
        while True:
            now = self._clock.now_ns()
            if now >= due:
                raise LensError(
                    f"lens port {self._line.name}: no GRBL answered within {self._settings.connect_ms:.0f} ms (saw "
                    f"{seen!r}); check power, cable, baud ({self._settings.baud}) and lens.driver"
                )
            if now >= reset_at:
                self._line.send(RESET)
                self._restarted, reset_at = True, due
            if now >= ask_at:
                self._line.send(question)
                ask_at = after_ms(now, 100)
            for line, _ in self._lines.feed(self._line.read()):
                status = parse_status(line)
                if status is not None:
                    return status
                self._restarted = self._restarted or _is_banner(line)
                seen = (seen + line)[-80:]
            self._clock.sleep_until(after_ms(now, 1))

    def _ask(self, line: str, beginning: str) -> list[str]:
        """Send a line and collect the lines that begin so, up to its ``ok``."""
        self._line.send(f"{line}\n".encode("ascii"))
        patience_ms = 10 * self._settings.reply_ms
        due = after_ms(self._clock.now_ns(), patience_ms)
        answers: list[str] = []
        while True:
            for got, _ in self._lines.feed(self._line.read()):
                if got == "ok":
                    return answers
                if got.startswith(beginning):
                    answers.append(got)
                elif got.startswith("error:"):
                    raise LensError(f"lens port {self._line.name}: GRBL answers {line} with {got}; is it GRBL 1.1?")
            if self._line.looked_ns >= due:
                raise LensError(
                    f"lens port {self._line.name}: no answer to {line} within {patience_ms:.0f} ms; check the cable"
                )
            self._clock.sleep_until(after_ms(self._clock.now_ns(), 1))

    def _numbers(self, lines: list[str]) -> dict[int, float]:
        """Read what ``$$`` printed; other firmware adds comments and settings that are no numbers."""
        board: dict[int, float] = {}
        for line in lines:
            number, _, value = line[1:].split(" ")[0].partition("=")
            try:
                board[int(number)] = float(value)
            except ValueError:
                continue
        missing = [f"${number}" for number in (100, 110, 120, 130) if board.get(number, 0.0) <= 0.0]
        if missing:
            raise LensError(
                f"lens port {self._line.name}: the board does not tell {', '.join(missing)}; is it GRBL 1.1?"
            )
        return board


def _is_banner(line: str) -> bool:
    return line.startswith("Grbl")


def _agreed_limits(board: dict[int, float], settings: GrblLensSettings, dialect: Dialect) -> LensLimits:
    """Take travel, speed and acceleration from the board and the config; refuse contradictions."""
    per_mm, travel_um, speed_um_s = board[100], board[130] * 1000, board[110] / 60 * 1000
    if abs(per_mm * settings.um_per_step / 1000 - 1) > 1e-3:
        raise ConfigError(
            f"lens.um_per_step is {settings.um_per_step:g}, the board's $100 of {per_mm:g} steps/mm makes "
            f"{1000 / per_mm:g}; correct one of them"
        )
    max_um = travel_um if settings.max_um is None else settings.max_um
    speed = settings.max_speed_um_s or speed_um_s
    for name, wanted, number, has in (("max_um", max_um, 130, travel_um), ("max_speed_um_s", speed, 110, speed_um_s)):
        if wanted > has * (1 + 1e-6):
            raise ConfigError(f"lens.{name} is {wanted:g}, the board's ${number} allows {has:g}; change one of them")
    if int(board.get(22, 0.0)) & dialect.origin_flag:
        raise ConfigError(
            f"the board's $22 is {board[22]:g} and makes the place of homing its zero; this driver counts from the end "
            f"of the travel ($130): set $22={int(board[22]) & ~dialect.origin_flag}, and home"
        )
    min_um, max_um = _beside_the_switches(board, dialect, settings.min_um, max_um)
    acceleration = board[120] * 1000
    if settings.acceleration_um_s2 is not None and abs(settings.acceleration_um_s2 / acceleration - 1) > 1e-3:
        raise ConfigError(
            f"lens.acceleration_um_s2 is {settings.acceleration_um_s2:g}, the board's $120 makes {acceleration:g}; "
            "leave the key out, or change $120"
        )
    return limits_from(1000 / per_mm, min_um, max_um, speed, acceleration)


def _beside_the_switches(
    board: dict[int, float], dialect: Dialect, min_um: float, max_um: float
) -> tuple[float, float]:
    """Keep away from switches that are hard limits too by as much of the pull-off as the firmware asks for.

    GRBL allows to go to the very step that closed the homing switch, where an alarm waits: half of it is spared.
    """
    if not (int(board.get(21, 0.0)) & 1 and int(board.get(22, 0.0)) & 1):
        return min_um, max_um
    homed_um, other_um = (share * board.get(27, 0.0) * 1000 for share in dialect.spare)
    upwards = not int(board.get(23, 0.0)) & 1
    low_um, high_um = (other_um, homed_um) if upwards else (homed_um, other_um)
    return max(min_um, low_um), min(max_um, board[130] * 1000 - high_um)
