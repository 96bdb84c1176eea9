"""A lens on a Theia MCR600 board, over USB: it moves to places, and cannot be stopped on its way.

Its manual says so: nothing is read while a motor moves, and the board keeps no position. So the host counts steps; a
motion is answered when it is over, and between there is silence; ``stop`` has nothing to send. Every motion is bounded
by the travel and by its target before it begins, and the capabilities say that the lens does not stop on command, so
that a focus cycle which must stop on the moment refuses it before anything moves.

At the switch the board ends a motion by itself and does not tell; but the answer comes too early then, which is how it
shows here: the position was not what it seemed, and the lens must be homed. A move whose answer was lost is never sent
again: relative moves done twice go twice as far. With a ``position_file`` the count outlives the session.

Positions count from the switch, upwards with the command 0x66. The lens's iris, on another motor (``theia_iris``), is
turned while the lens rests only.
"""

from __future__ import annotations

import math
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import structlog

from elpd.errors import LensError, UsageError
from elpd.motion.commanded import Motion
from elpd.motion.readings import Timing
from elpd.records import CommandStamp, LensCapabilities, LensFlag, LensLimits, LensReport, StopMode
from elpd.units import NS_PER_MS, NS_PER_S, NS_PER_US, HostNs, Steps, after_ms
from elpd_drivers.lenses import theia_wire as wire
from elpd_drivers.lenses.asking import Asking
from elpd_drivers.lenses.axis import check_output, check_speed, check_target, run_target
from elpd_drivers.lenses.iris_axis import IRIS
from elpd_drivers.lenses.line import Trouble, open_on_line
from elpd_drivers.lenses.motor import Motor
from elpd_drivers.lenses.remembered import Remembered
from elpd_drivers.lenses.theia_iris import theia_iris
from elpd_drivers.lenses.theia_settings import SLOWEST_PPS, TheiaSettings, limits_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from elpd.ports import BytePort, Clock
    from elpd.records import PositionEstimate
    from elpd_drivers.lenses.line import Line

_log = structlog.get_logger()

OLDEST_FIRMWARE = 5
AWAY_STEPS = 200
"""How far to go back into the travel before the switch is looked for again, as the maker's library does."""

PACE_ERROR = 0.02
"""How far the board's step rate may be from what it was told."""

PAUSE_NS = 20 * NS_PER_MS
"""By how much earlier than that a motion must be over to have ended at the switch."""


REMEDY = "name a file in lens.position_file, where the position is kept from one program to the next"


def open_lens(settings: Mapping[str, Any], clock: Clock, port: BytePort | None = None) -> TheiaLens:
    """Open and identify a Theia MCR board. Nothing moves; what moves is waited for.

    Raises ``ConfigError`` for a wrong table, ``LensError`` if there is no MCR board with firmware 5 or newer.
    """
    return open_on_line(TheiaSettings, settings, clock, port, lambda table, line: TheiaLens(table, clock, line))


class TheiaLens:
    """``elpd.ports.Lens`` on a Theia MCR board. Use ``open_lens``."""

    def __init__(self, settings: TheiaSettings, clock: Clock, line: Line) -> None:
        self._settings, self._clock, self._line = settings, clock, line
        self.limits: LensLimits = limits_of(settings)
        self._sigma_ns = round(settings.latency_sigma_us * NS_PER_US)
        self._latency_ns = round(settings.latency_us * NS_PER_US)
        self._motor = Motor(Timing(self._latency_ns, self._sigma_ns, 2.0, ramp_steps=1.0))
        self._asking = Asking(settings.query_ms, settings.reply_ms)
        self._replies = wire.ReplyReader()
        self._asked_ns = 0
        self._going: _Going | None = None
        ruler = {"motor": settings.motor, "switch": settings.switch, "um_per_step": settings.um_per_step}
        self._remembered = Remembered(settings.position_file, ruler)
        self._steps = 0
        self._at_switch = False
        self._iris = theia_iris(settings)

    # --- what the cycle sees ---------------------------------------------------------------------------------------

    @property
    def remarks(self) -> Sequence[str]:
        """What a person should know of how the controller answers."""
        return self._asking.remarks

    @property
    def capabilities(self) -> LensCapabilities:
        """Bounded moves, no stop of any kind: what moves ends when it is there."""
        return LensCapabilities(
            native_velocity=False,
            abrupt_stop=False,
            stop_on_command=False,
            homing=True,
            stop_onset_ms=1000.0 * (self.limits.max_steps - self.limits.min_steps) / SLOWEST_PPS,
            stop_onset_sigma_ms=0.0,
            watchdog_ms=None,
        )

    def connect(self) -> None:
        """Identify the board, tell it of its motor; where that is is remembered, or unknown (and called 0)."""
        with self._guarded():
            self._identify()
            self._set_up(self._settings.motor, self._setup())
            if self._iris is not None:
                self._set_up(self._iris.motor, self._iris.setup())
            steps = self._remembered.recall()
            if steps is not None and self.limits.min_steps <= steps <= self.limits.max_steps:
                self._steps, self._motor.referenced = steps, True
            self._report(self._clock.now_ns(), self._clock.now_ns())

    def home(self, deadline: HostNs) -> LensReport:
        """Let the board look for the switch; return at rest there. It cannot be called off."""
        with self._guarded():
            self._refuse_moving("home")
            self._motor.referenced = False
            if not self._seek_switch(deadline):
                away = AWAY_STEPS if self._settings.switch == "low" else -AWAY_STEPS
                self._send(wire.move(self._settings.motor, away, self._pace()), AWAY_STEPS / self._pace(), 0)
                self._arrive(deadline)
                if not self._seek_switch(deadline):
                    raise Trouble("the board did not find the switch; check lens.switch, lens.max_um and its cable")
            self._steps, self._at_switch = 0, False
            self._motor.referenced = True
            self._motor.at_rest()
            now = self._clock.now_ns()
            self._remembered.keep(self._steps)
            if not self._settings.position_file:
                _log.warning("this board keeps no position, so the next program must home again", remedy=REMEDY)
            report = LensReport(0.0, now, now, 0.0)
            self._motor.begin(report)
            self._motor.report = report
            return self._flagged(report)

    def move_to(self, target: Steps, speed_sps: float) -> CommandStamp:
        """Start an absolute move. Raises ``UsageError`` while another one is under way: it cannot be called off."""
        self._line.check()
        check_target(target, self.limits)
        check_speed(speed_sps, self.limits)
        if not self._motor.referenced:
            raise LensError(f"lens: cannot move to {target} steps, its position is unknown; home it first")
        return self._go(int(target), abs(speed_sps), "move_to")

    def run(self, velocity_sps: float, until: HostNs) -> CommandStamp:
        """Start a move that ends at *until* or at the limit, and that nothing ends before."""
        self._line.check()
        check_speed(velocity_sps, self.limits)
        late_ns = self._latency_ns + 3 * self._sigma_ns + 8 * self._line.byte_ns
        spare_ns = round((until - self._clock.now_ns() - late_ns) * (1 - PACE_ERROR))
        referenced = self._motor.referenced
        target = run_target(self._steps, 0.0, velocity_sps, spare_ns, self.limits, referenced=referenced)
        return self._go(target, abs(velocity_sps), "run")

    def stop(self, mode: StopMode) -> CommandStamp:
        """Send nothing: the board would not read it. What moves goes on to its target, inside the limits."""
        del mode
        now = self._clock.now_ns()
        return CommandStamp("stop (this board cannot)", now, now)

    def poll(self) -> LensReport | None:
        """Ask when due and at rest, read what has come; return a new report if there is one."""
        with self._guarded():
            report = self._poll()
            return None if report is None else self._flagged(report)

    @property
    def outputs(self) -> Sequence[str]:
        """The stepper iris, if there is one."""
        return () if self._iris is None else (IRIS,)

    def set_output(self, name: str, *, on: bool) -> CommandStamp:
        """Open or close the iris. The board does nothing else meanwhile: ``UsageError`` while the lens moves."""
        check_output(name, self.outputs)
        assert self._iris is not None, "it has that output"
        with self._guarded():
            self._refuse_moving(f"turn the {name}")
            turn = self._iris.turn(opened=on)
            now = self._clock.now_ns()
            if turn is None:
                return CommandStamp(f"{name} {'on' if on else 'off'}", now, now)
            sent = self._send(turn.message, turn.takes_s, None, lens=False)
        return CommandStamp(f"{name} {'on' if on else 'off'}", sent.written_from_ns, sent.written_to_ns)

    def position_at(self, when: HostNs) -> PositionEstimate:
        """Return where the motor was at *when*, by its commands."""
        return self._motor.position_at(when)

    def close(self) -> None:
        """Give the port back. Idempotent. What moves goes on to its target."""
        self._line.close()

    # --- connecting and homing -------------------------------------------------------------------------------------

    def _identify(self) -> None:
        due = after_ms(self._clock.now_ns(), self._settings.connect_ms)
        name = self._line.name
        while True:
            self._line.send(wire.version())
            answer_due = after_ms(self._clock.now_ns(), self._settings.reply_ms)
            while self._clock.now_ns() < answer_due:
                reply = self._newest(wire.VERSION)
                if reply is not None:
                    if reply[1] < OLDEST_FIRMWARE:
                        version = ".".join(f"{part:x}" for part in reply[1:-1])
                        raise LensError(
                            f"lens port {name}: firmware {version} answered, this driver needs {OLDEST_FIRMWARE} or "
                            "newer; ask Theia for it"
                        )
                    return
                self._clock.sleep_until(after_ms(self._clock.now_ns(), 1))
            if self._clock.now_ns() >= due:
                raise LensError(
                    f"lens port {name}: no answer from a Theia MCR board for {self._settings.connect_ms:.0f} ms; check "
                    "its power, and that this is its port; while a motor moves it does not answer either"
                )

    def _set_up(self, motor: int, setup: wire.Setup) -> None:
        self._line.send(wire.set_up(motor, setup))
        due = after_ms(self._clock.now_ns(), self._settings.reply_ms)
        while (reply := self._newest(wire.SET_UP)) is None:
            self._wait(due, f"no answer to the set-up of motor {motor} (0x63); check the cable")
        if reply[1] != 0:
            raise Trouble(f"the board refuses the set-up of motor {motor} (0x63); compare [lens] with its manual")

    def _setup(self) -> wire.Setup:
        low = self._settings.switch == "low"
        travel = self.limits.max_steps - self.limits.min_steps
        return wire.Setup(not low, low, travel, SLOWEST_PPS, math.floor(self.limits.max_speed_sps + 1e-6))

    def _seek_switch(self, deadline: HostNs) -> bool:
        """Go to the switch; say whether it was found."""
        travel = self.limits.max_steps - self.limits.min_steps
        longest_s = 2.0 * (travel + AWAY_STEPS) / self._pace()
        self._send(wire.home(self._settings.motor, 0, self._pace()), longest_s, None)
        return self._arrive(deadline)

    def _arrive(self, deadline: HostNs) -> bool:
        """Wait until what was sent is over; say whether the board says that it went well."""
        while self._going is not None:
            done = self._newest(wire.DONE)
            if done is not None:
                self._going = None
                return done[1] == 0
            self._check_late()
            self._wait(
                deadline, "the motion did not end before its deadline; it goes on until the switch or its target"
            )
        raise AssertionError("a motion was sent before")

    def _pace(self) -> int:
        return math.floor(self.limits.max_speed_sps + 1e-6)

    # --- motion ----------------------------------------------------------------------------------------------------

    def _go(self, target: int, speed_sps: float, name: str) -> CommandStamp:
        with self._guarded():
            self._refuse_moving(name)
            way, pace = target - self._steps, math.floor(speed_sps + 1e-6)
            now = self._clock.now_ns()
            if way == 0:
                return CommandStamp(name, now, now)
            if pace < SLOWEST_PPS:
                raise UsageError(
                    f"lens: a speed of {speed_sps:g} steps/s was asked for, the slowest is {SLOWEST_PPS}; go faster"
                )
            sent = self._send(wire.move(self._settings.motor, way, pace), abs(way) / pace, target)
            motion = Motion(self.limits.acceleration_sps2, target_steps=float(target), speed_sps=float(pace))
            self._motor.command(motion, sent.begun_ns + self._latency_ns, self._sigma_ns)
            return CommandStamp(name, sent.written_from_ns, sent.written_to_ns)

    def _send(self, message: bytes, takes_s: float, target: int | None, *, lens: bool = True) -> _Going:
        if lens:
            self._remembered.forget()
            self._at_switch = False
        sent = self._line.send(message)
        late_ns = round(self._settings.late_ms * NS_PER_MS)
        ends_ns = sent.off_wire_ns + round(takes_s * NS_PER_S)
        self._going = _Going(sent.begun_ns, sent.done_ns, sent.off_wire_ns, ends_ns, ends_ns + late_ns, target, lens)
        return self._going

    def _refuse_moving(self, what: str) -> None:
        if self._going is not None:
            left_ms = max(self._going.ends_ns - self._clock.now_ns(), 0) / NS_PER_MS
            raise UsageError(
                f"lens: cannot {what.replace('_', ' ')} now: it moves for another {left_ms:.0f} ms, and this board "
                "cannot be told anything before that is over; wait for it"
            )

    # --- replies ---------------------------------------------------------------------------------------------------

    def _poll(self) -> LensReport | None:
        data = self._line.read()
        before, now = self._line.since_ns, self._line.by_ns
        newest: LensReport | None = None
        for reply in self._replies.feed(data):
            if reply[0] == wire.DONE and self._going is not None:
                latest_ns = max(now - len(reply) * self._line.byte_ns, self._going.begun_ns)
                newest = self._over(self._going, reply, max(before, self._going.begun_ns), latest_ns)
            elif reply[0] == wire.VERSION and self._asking.open and self._going is None:
                self._asking.answered()
                newest = self._report(self._asked_ns, now)
        self._check_late()
        if self._going is not None:
            self._asking.forget()  # it would not be read
            return newest
        looked = self._line.looked_ns
        self._asking.check(looked, "")
        if self._asking.due(looked):
            sent = self._line.send(wire.version())
            self._asked_ns = sent.off_wire_ns
            self._asking.asked(sent.done_ns)
        return newest

    def _over(self, going: _Going, reply: bytes, earliest_ns: int, latest_ns: int) -> LensReport:
        """Take the end of a motion: at its target, unless the board says no, or it came too early."""
        self._going = None
        if not going.lens:
            if reply[1] != 0:
                raise Trouble("the board says that the iris's turn failed; look at lens.iris_open and iris_speed_sps")
            return self._report(earliest_ns, latest_ns)
        assert going.target is not None, "homing waits for its own end"
        if reply[1] != 0:
            raise Trouble("the board says that a move failed; where it ended is unknown, home it")
        takes_ns = going.ends_ns - going.begun_ns
        self._motor.at_rest()
        if latest_ns < going.ends_ns - round(PACE_ERROR * takes_ns) - PAUSE_NS:
            self._motor.referenced, self._at_switch = False, True
            self._steps = round(self._motor.position_at(HostNs(latest_ns)).steps)
            report = self._report(earliest_ns, latest_ns)
            self._motor.begin(report)
            return report
        self._steps = going.target
        if self._motor.referenced:
            self._remembered.keep(self._steps)
        return self._report(max(earliest_ns, min(going.ends_ns, latest_ns)), latest_ns)

    def _report(self, earliest_ns: int, latest_ns: int) -> LensReport:
        """Say that it rests where the host has counted it to be."""
        report = LensReport(float(self._steps), HostNs(earliest_ns), HostNs(max(earliest_ns, latest_ns)), 0.0)
        if not self._motor.believes(report):
            raise Trouble("the count of steps and the model of their motion disagree; home it again")
        self._asking.believed()
        self._motor.report = report
        return report

    def _newest(self, kind: int) -> bytes | None:
        replies = [reply for reply in self._replies.feed(self._line.read()) if reply[0] == kind]
        return replies[-1] if replies else None

    def _check_late(self) -> None:
        now, going = self._clock.now_ns(), self._going
        if going is not None and now > going.late_ns:
            self._going = None
            raise Trouble(
                f"no reply to a move {(now - going.ends_ns) / NS_PER_MS:.0f} ms after it should have ended (limit "
                f"{self._settings.late_ms:.0f}); where it is is unknown; check the cable, then home it"
            )

    def _flagged(self, report: LensReport) -> LensReport:
        return self._motor.flagged(report, LensFlag.LIMIT if self._at_switch else LensFlag.NONE)

    def _wait(self, deadline: HostNs, why: str) -> None:
        now = self._clock.now_ns()
        if now >= deadline:
            raise Trouble(why)
        self._clock.sleep_until(after_ms(now, 1))

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Around everything that can meet trouble: there is no stop to send; the fault stays, the reference is gone."""
        with self._line.stopping_on_trouble(lambda: b"", "stop"):
            try:
                yield
            except Trouble:
                self._motor.referenced = False
                raise


@dataclass(frozen=True, slots=True)
class _Going:
    """A motion of the lens (or the iris): when it was sent, should be over and is overdue, and where it leads."""

    written_from_ns: HostNs
    written_to_ns: HostNs
    begun_ns: int
    ends_ns: int
    late_ns: int
    target: int | None
    lens: bool
