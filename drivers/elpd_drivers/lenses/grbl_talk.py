"""The talk with a GRBL board in use: when to ask, what came back, and what that means for the motor.

GRBL answers lines with ``ok`` in their order, and questions (``?``) with a report whenever it comes to it; alarms and
banners come by themselves. An ``ok`` says that a jog was planned, which dates its beginning; a report is dated by the
question before it and by its own way over the line. Rest is believed only when it is reported.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from elpd.records import LensFlag, LensReport
from elpd.units import NS_PER_US, HostNs, after_ms
from elpd_drivers.lenses.grbl_lines import (
    ALARM_WORDS,
    CANCEL,
    ERROR_WORDS,
    RESET,
    RESUME,
    STATUS,
    Status,
    parse_status,
)
from elpd_drivers.lenses.line import Trouble
from elpd_drivers.lenses.lines import LineReader

if TYPE_CHECKING:
    from elpd.ports import Clock
    from elpd_drivers.lenses.asking import Asking
    from elpd_drivers.lenses.line import Line, Sent
    from elpd_drivers.lenses.motor import Motor

STOPS_TRIED = 3
RESTART_MS = 1500.0
"""How long the board may be silent after a reset: in motion, it sleeps for half a second over its alarm."""


class GrblTalk:
    """What is asked of the board and what it says, from connecting on.

    Parameters
    ----------
    line
        The way to it.
    clock
        What its restart is timed by.
    asking
        When to ask, and for how long to be patient.
    motor
        What reports and acknowledgements teach; another one from each connecting on.
    """

    def __init__(self, line: Line, clock: Clock, asking: Asking, motor: Motor) -> None:
        self._line, self._clock = line, clock
        self.asking, self.motor = asking, motor
        self.steps_per_mm = self.travel_mm = 0.0
        self.status: Status | None = None
        self.unacknowledged: deque[int | None] = deque()
        """The commands that wait for their ``ok``: the motor's number of a motion, ``None`` for anything else."""
        self.stopping = False
        """Whether it was told to stand still since the last motion was begun."""
        self.resetting = self.locked_by_stop = False
        self.restarted_by_ns = 0
        self._lines = LineReader()
        self._sampled_from_ns = 0
        self._line_begun_ns = self._line_end_ns = 0

    @property
    def busy(self) -> bool:
        """Whether something is under way, or was asked for and not acknowledged."""
        return self.motor.rest_due_ns is not None or bool(self.unacknowledged)

    def order(self, line: bytes, number: int | None = None) -> Sent:
        """Send a line that will be acknowledged."""
        self.unacknowledged.append(number)
        return self._line.send(line)

    def reset(self) -> Sent:
        """Reset the board: pulses end now, the banner follows."""
        self.resetting = self.locked_by_stop = True
        self.restarted_by_ns = after_ms(self._clock.now_ns(), RESTART_MS)
        return self._line.send(RESET)

    def poll(self, *, fuse: bool) -> LensReport | None:
        """Take what has come and ask when due; *fuse* says whether reports are compared with the model."""
        report = self.take(fuse=fuse)
        now = self._line.looked_ns
        if self.resetting:
            if now >= self.restarted_by_ns:
                raise Trouble(f"no banner within {RESTART_MS:.0f} ms of a reset; check the cable and the supply")
            return report
        self.asking.check(now, "")
        if self.asking.due(now):
            again = self.asking.open
            sent = self._line.send(STATUS)
            if again:
                self.asking.asked_again()  # the answer may be to the first one, and as old
            else:
                self._sampled_from_ns = sent.off_wire_ns
            self.asking.asked(sent.done_ns)
        return report

    def take(self, *, fuse: bool) -> LensReport | None:
        """Read and act on every complete line; return the newest report."""
        data = self._line.read()
        before, now = self._line.since_ns, self._line.by_ns
        newest, newest_begun = None, None
        for line, bytes_after in self._lines.feed(data):
            # when the line's first byte can have left the board, at the latest
            length_ns = (len(line) + 2) * self._line.byte_ns
            begun = now - length_ns - bytes_after * self._line.byte_ns
            if line.startswith("<"):
                status = parse_status(line)
                newest = (self._take_status(status, begun, fuse=fuse) if status else None) or newest
            elif line == "ok":
                # not before the last look at the port, unless it had to wait behind the line before it
                waited = before - length_ns < self._line_end_ns
                self._acknowledged(self._line_begun_ns if waited else before - length_ns, begun)
            else:
                self._heed(line)
            self._line_begun_ns = min(before - length_ns, begun)  # for what comes with it: nobody looked in between
            self._line_end_ns = begun + length_ns
            newest_begun = begun
        if newest_begun is not None:
            self._line_begun_ns = newest_begun
        return newest

    def _acknowledged(self, earliest: int, latest: int) -> None:
        """Take an ``ok``: the jog was planned just before it was sent."""
        if not self.unacknowledged:
            return
        number = self.unacknowledged.popleft()
        if number is None:
            return
        earliest -= self.asking.held_ns
        width = max(latest - earliest, 0)
        sigma_ns = max(width / 12**0.5, 100 * NS_PER_US)
        self.motor.amend(number, latest - width // 2, sigma_ns, still_ending=not self.stopping)
        if self.stopping:
            self._line.send(CANCEL)  # the first one may have come before there was anything to cancel

    def _heed(self, line: str) -> None:
        """Act on what the board says by itself."""
        if line.startswith("ALARM:"):
            if self.resetting:
                return
            raise Trouble(f"GRBL raised {line} ({ALARM_WORDS.get(line[6:], 'unknown')}); clear the cause, home")
        if line.startswith("error:"):
            if self.unacknowledged:
                self.unacknowledged.popleft()
            words = ERROR_WORDS.get(line[6:], "unknown")
            raise Trouble(f"GRBL refused a command with {line} ({words}); compare its $$ with the config")
        if "Grbl" in line or "GrblHAL" in line:
            if not self.resetting:
                raise Trouble("the board restarted by itself (its banner came); check its supply, then home")
            self.resetting = False
            self.asking.forget()

    def _take_status(self, status: Status, begun: int, *, fuse: bool) -> LensReport | None:
        if not self.asking.open:
            return None  # late or duplicate: its instant of sampling is unknown
        self.asking.answered()
        if status.state == "Alarm" and self.busy and not self.locked_by_stop and not self.unacknowledged:
            raise Trouble("GRBL fell into Alarm during a motion; clear the cause, home")
        moving = status.state in {"Jog", "Run", "Home", "Hold:1"}
        velocity = None if moving else 0.0
        earliest = self._sampled_from_ns
        report = LensReport(
            (status.x_mm + self.travel_mm) * self.steps_per_mm,
            HostNs(earliest),
            HostNs(max(begun, earliest)),
            velocity,
            LensFlag.MOVING if moving else LensFlag.NONE,
        )
        self.motor.replies_are_held(self.asking.held_ns)
        if fuse and not self.motor.believes(report):
            self.asking.soon()
            return None
        self.asking.believed()
        self.status, self.motor.report = status, report
        self._watch_motion(report)
        return report

    def _watch_motion(self, report: LensReport) -> None:
        """Believe in rest when it is reported; stop again, harder each time, what should be at rest by now."""
        motor = self.motor
        if motor.rest_due_ns is None:
            return
        planned = motor.planned_rest_ns
        if not report.moving and not self.unacknowledged and (planned is None or report.earliest_ns > planned):
            motor.at_rest()
            if self.stopping:
                # a cancel that came in the jog's last moment holds nothing, for ever: no line is taken any more
                self._line.send(RESUME)
            self.stopping = False
        elif motor.overdue(report):
            if motor.stops_ignored > STOPS_TRIED:
                raise Trouble(f"the motor still runs after {STOPS_TRIED} stops; the board was reset")
            self._line.send(CANCEL)
            self.stopping = True
