"""A lens on a GRBL 1.1 board (or a port of it), on its X axis.

GRBL has no velocity mode and no dead-man, and a stop bites only 40 to 50 ms after its byte, because what is prepared
is executed. So a motion is *one* long jog to an absolute machine position, at which it ends if nobody says anything
more; and a change of speed or direction is a jog cancel, standstill, and a new jog, in steps that ``poll`` takes
without waiting. The next jog never travels behind the cancel in the same write: a stop could not overtake it.

Known race of the firmware: a cancel that arrives before the pending ``$J`` is planned does nothing. So the driver
remembers that it wants to stand still, repeats the cancel after the ``ok``, and believes only reported standstill.

Where the abrupt stop is asked for (or on any trouble) the byte is 0x18: pulses end at once, and with them the trust
in the position, until the lens is homed. Steps count from the lower end of GRBL's machine space, ``-$130``.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from elpd.errors import LensError
from elpd.motion.commanded import REST, Motion
from elpd.motion.readings import Timing
from elpd.records import CommandStamp, LensCapabilities, LensFlag, LensReport, StopMode
from elpd.units import NS_PER_MS, NS_PER_US, HostNs, Steps, after_ms
from elpd_drivers.lenses.asking import Asking
from elpd_drivers.lenses.axis import (
    check_output,
    check_speed,
    check_target,
    limits_from,
    run_target,
    with_measured_stop,
)
from elpd_drivers.lenses.grbl_dialect import DIALECTS
from elpd_drivers.lenses.grbl_handshake import GrblLensSettings, handshake
from elpd_drivers.lenses.grbl_lines import CANCEL, OUTPUTS, RESET, jog_line
from elpd_drivers.lenses.grbl_talk import GrblTalk
from elpd_drivers.lenses.line import Trouble, open_on_line
from elpd_drivers.lenses.motor import Motor

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from elpd.ports import BytePort, Clock
    from elpd.records import LensLimits, PositionEstimate, StopTiming
    from elpd_drivers.lenses.line import Line, Sent

SEGMENT_S = 0.010
RAMP_STEPS = 1.5
"""How far its ramps stray from the model's segments."""

PACE_SIGMA = 1e-3 / 3**0.5
"""Pulses are made by a timer of 8 to 16 kHz whose period is rounded to a cycle of 16 MHz: one in a thousand."""


@dataclass(frozen=True, slots=True)
class _Wish:
    """A motion that waits for standstill: a target, or a velocity with its end in time."""

    speed_sps: float
    target: int | None = None
    until_ns: int = 0


def open_lens(settings: Mapping[str, Any], clock: Clock, port: BytePort | None = None) -> GrblLens:
    """Open and identify a GRBL board. Nothing moves; what was moving is stopped.

    Raises ``ConfigError`` for a wrong table, ``LensError`` if there is no GRBL 1.1 or its settings do not fit.
    """
    return open_on_line(GrblLensSettings, settings, clock, port, lambda table, line: GrblLens(table, clock, line))


class GrblLens:
    """``elpd.ports.Lens`` on GRBL. Use ``open_lens``."""

    def __init__(self, settings: GrblLensSettings, clock: Clock, line: Line) -> None:
        self._settings, self._clock, self._line = settings, clock, line
        self._wish: _Wish | None = None
        self._measured: dict[StopMode, StopTiming] = {}
        self._cruise_sps = 0.0
        self._limits = limits_from(settings.um_per_step, 0.0, 1.0, 1.0, 1.0)
        self._dialect = DIALECTS[-1]
        self._home_line = self._dialect.home
        self._motor = self._new_motor()
        asking = Asking(settings.query_ms, settings.reply_ms, lost_share=1 / 3)
        self._talk = GrblTalk(line, clock, asking, self._motor)

    # --- what the cycle sees ---------------------------------------------------------------------------------------

    @property
    def limits(self) -> LensLimits:
        """Travel and speed that nothing exceeds: the config's, inside the board's."""
        return self._limits

    @property
    def capabilities(self) -> LensCapabilities:
        """No velocity mode, a stop that comes late, no dead-man: sweep past and return."""
        assumed = LensCapabilities(
            native_velocity=False,
            abrupt_stop=False,
            stop_on_command=True,
            homing=True,
            stop_onset_ms=self._stop_onset_ms,
            stop_onset_sigma_ms=self._stop_onset_sigma_ms,
            watchdog_ms=None,
        )
        return with_measured_stop(assumed, self._measured)

    def learn_stops(self, measured: Mapping[StopMode, StopTiming]) -> None:
        """Model stops by what was measured of them. An abrupt one is a reset and has nothing to learn."""
        self._measured.update(measured)

    def connect(self) -> None:
        """Identify the board, stop it if it moves, read its settings, and take its first report."""
        with self._guarded():
            board = handshake(self._line, self._clock, self._settings)
            self._limits, self._dialect, self._home_line = board.limits, board.dialect, board.home
            talk = self._talk
            talk.steps_per_mm, talk.travel_mm = board.steps_per_mm, board.travel_mm
            self._motor = talk.motor = self._new_motor(board.steps_per_mm)
            believed = board.homed or (board.idle and self._settings.trust_position)
            self._motor.referenced = believed and not board.restarted
            due = after_ms(self._clock.now_ns(), 4 * self._settings.reply_ms)
            while self._talk.poll(fuse=True) is None:
                self._wait(due, "no report after connecting; check the cable")

    def home(self, deadline: HostNs) -> LensReport:
        """Run GRBL's homing cycle (``$H``), return at rest beside the switch."""
        with self._guarded():
            return self._home(deadline)

    def move_to(self, target: Steps, speed_sps: float) -> CommandStamp:
        """Start an absolute move; first to standstill, if something else is under way."""
        self._line.check()
        check_target(target, self._limits)
        check_speed(speed_sps, self._limits)
        if not self._motor.referenced:
            raise LensError(f"lens: cannot move to {target} steps, its position is unknown; home it first")
        return self._begin(_Wish(abs(speed_sps), target=int(target)), "move_to")

    def run(self, velocity_sps: float, until: HostNs) -> CommandStamp:
        """Jog towards a limit, or as far as the time until *until* allows; first to standstill, if moving otherwise."""
        self._line.check()
        check_speed(velocity_sps, self._limits)
        return self._begin(_Wish(velocity_sps, until_ns=until), "run")

    def stop(self, mode: StopMode) -> CommandStamp:
        """Write the stop byte now, from any thread. ``ABRUPT`` is a reset: the position is lost if in motion."""
        self._motor.stops += 1
        self._wish = None
        sent = self._talk.reset() if mode is StopMode.ABRUPT else self._line.send(CANCEL)
        self._motor.written_ns = max(self._motor.written_ns, sent.done_ns - sent.begun_ns)
        self._note_stop(mode, sent)
        return CommandStamp(f"stop {mode.name.lower()}", sent.begun_ns, sent.done_ns)

    def poll(self) -> LensReport | None:
        """Ask when due, read what has come, take the next step of a reversal; return a new report if there is one."""
        with self._guarded():
            report = self._talk.poll(fuse=True)
            self._take_next_step()
            return None if report is None else self._flagged(report)

    @property
    def outputs(self) -> Sequence[str]:
        """What GRBL can switch beside the motor."""
        return tuple(OUTPUTS)

    @property
    def remarks(self) -> Sequence[str]:
        """What a person should know of how GRBL answers."""
        return self._talk.asking.remarks

    def set_output(self, name: str, *, on: bool) -> CommandStamp:
        """Switch an output. At rest only: in motion the line would wait behind the jog, or be refused."""
        check_output(name, self.outputs)
        with self._guarded():
            if self._talk.busy or (self._talk.status is not None and self._talk.status.state != "Idle"):
                raise LensError(f"lens: GRBL switches {name} at rest only; wait until the motor stands, home if locked")
            sent = self._talk.order(OUTPUTS[name][0 if on else 1])
        return CommandStamp(f"{name} {'on' if on else 'off'}", sent.begun_ns, sent.done_ns)

    def position_at(self, when: HostNs) -> PositionEstimate:
        """Return where the motor was at *when*."""
        return self._motor.position_at(when)

    def close(self) -> None:
        """Stop if moving, and give the port back. Idempotent."""
        try:
            if self._motor.may_move:
                self._line.send(CANCEL)
        except LensError:
            pass  # the line is dead: the jog ends at its target
        self._line.close()

    @property
    def _stop_onset_ms(self) -> float:
        known = self._settings.stop_onset_ms
        return self._dialect.stop_onset_ms if known is None else known

    @property
    def _stop_onset_sigma_ms(self) -> float:
        known = self._settings.stop_onset_sigma_ms
        return self._dialect.stop_onset_sigma_ms if known is None else known

    # --- homing ----------------------------------------------------------------------------------------------------

    def _home(self, deadline: HostNs) -> LensReport:
        while self._talk.resetting:
            self._talk.poll(fuse=False)
            self._wait(deadline, "the board did not come back from a reset; look at the board")
        if self._motor.report is not None and self._motor.report.moving:
            self.stop(StopMode.RAMPED)
            self._await_idle(deadline)
        self._motor.referenced, self._motor.rest_due_ns, self._wish = False, None, None
        self._talk.order(self._home_line)
        self._talk.asking.forget()
        while self._talk.unacknowledged:
            self._talk.take(fuse=False)
            self._wait(deadline, "homing did not end before its deadline; check the limit switch, or allow more time")
        report = None
        while report is None:
            report = self._talk.poll(fuse=False)
            self._wait(deadline, "no report after homing; check the cable")
        if self._talk.status is None or self._talk.status.state != "Idle":
            raise Trouble(f"homing ended in state {self._talk.status.state if self._talk.status else 'unknown'}")
        self._motor.begin(report)
        self._motor.referenced, self._talk.locked_by_stop = True, False
        if self._dialect.homed_by_us:
            self._talk.order(f"{self._dialect.homed_by_us}\n".encode("ascii"))
            while self._talk.unacknowledged:
                self._talk.take(fuse=True)
                self._wait(deadline, "no answer after homing; check the cable")
        return self._flagged(report)

    def _await_idle(self, deadline: HostNs) -> None:
        while True:
            self._talk.poll(fuse=self._motor.known)
            ended = self._talk.status is not None and self._talk.status.state in {"Idle", "Alarm"}
            if ended and self._motor.rest_due_ns is None:
                return
            self._wait(deadline, "the motor did not come to rest; look at the board")

    # --- motion ----------------------------------------------------------------------------------------------------

    def _begin(self, wish: _Wish, name: str) -> CommandStamp:
        """Jog now if at rest; else cancel, and let ``poll`` jog when the motor stands."""
        if self._talk.resetting:
            raise LensError("lens: GRBL restarts after an abrupt stop; home it first")
        now, stops = self._clock.now_ns(), self._motor.stops
        if not self._talk.busy:
            return self._jog(wish, name, stops)
        if wish.target is None and wish.speed_sps == self._cruise_sps and not self._talk.stopping:
            due = self._motor.rest_due_ns or now
            if due <= wish.until_ns:
                return CommandStamp(name, now, now)  # already running so, and ending in time
        stamp = CommandStamp(name, now, now) if self._talk.stopping else self.stop(StopMode.RAMPED)
        self._wish = wish
        return CommandStamp(name, stamp.begun_ns, stamp.done_ns)

    def _jog(self, wish: _Wish, name: str, stops: int) -> CommandStamp:
        if self._talk.status is not None and self._talk.status.state == "Alarm":
            raise LensError("lens: GRBL is locked (Alarm), its position is unknown; home it first")
        now = self._clock.now_ns()
        steps, _ = self._motor.state_at(now)
        target = wish.target
        if target is None:
            spare_ns = wish.until_ns - now - 15 * NS_PER_MS  # the line's own time, and the planner's
            referenced = self._motor.referenced
            target = run_target(steps, 0.0, wish.speed_sps, spare_ns, self._limits, referenced=referenced)
        if target == round(steps):
            return CommandStamp(name, now, now)
        speed_sps = abs(wish.speed_sps)
        line = jog_line(
            target / self._talk.steps_per_mm - self._talk.travel_mm, speed_sps / self._talk.steps_per_mm * 60
        )
        sent = self._line.send(line)
        motion = Motion(self._limits.acceleration_sps2, 0.0, float(target), speed_sps, SEGMENT_S)
        self._motor.written_ns = sent.done_ns - sent.begun_ns
        number = self._motor.command(motion, sent.off_wire_ns + 2 * NS_PER_MS, 2 * NS_PER_MS)
        self._talk.unacknowledged.append(number)
        self._cruise_sps, self._talk.stopping, self._motor.stops_ignored = wish.speed_sps, False, 0
        if self._motor.stops != stops:
            self.stop(StopMode.RAMPED)  # one came from another thread while this was on its way: it wins
        return CommandStamp(name, sent.begun_ns, sent.done_ns)

    def _note_stop(self, mode: StopMode, sent: Sent) -> None:
        motor = self._motor
        if not motor.known:
            return
        if mode is StopMode.ABRUPT:
            moving = self._talk.busy or (motor.report is not None and motor.report.moving)
            motor.referenced = motor.referenced and not moving
            self._talk.unacknowledged.clear()
            motor.command(REST, sent.off_wire_ns + 20 * NS_PER_US, 50 * NS_PER_US, grace_ms=50)
        elif not self._talk.stopping and self._talk.busy:
            onset_ns = sent.off_wire_ns + round(self._stop_onset_ms * NS_PER_MS)
            sigma_ms, braking_sps2 = self._stop_onset_sigma_ms, self._limits.acceleration_sps2
            measured = self._measured.get(mode)
            if measured is not None:
                onset_ns = sent.done_ns + round(measured.onset_ms * NS_PER_MS)
                sigma_ms, braking_sps2 = measured.onset_sigma_ms, measured.deceleration_sps2 or braking_sps2
            ending = motor.planned_rest_ns
            if ending is None or ending > onset_ns:
                braking = Motion(braking_sps2, segment_s=SEGMENT_S)
                motor.command(braking, onset_ns, sigma_ms * NS_PER_MS, grace_ms=60)
        self._talk.stopping = True

    def _take_next_step(self) -> None:
        stops = self._motor.stops
        if self._wish is None or self._talk.busy:
            return
        wish, self._wish = self._wish, None
        self._jog(wish, "run", stops)

    # --- below: how it is done -------------------------------------------------------------------------------------

    def _flagged(self, report: LensReport) -> LensReport:
        flags = LensFlag.NONE
        if self._talk.status is not None and "X" in self._talk.status.pins:
            flags |= LensFlag.LIMIT
        if self._talk.status is not None and self._talk.status.state == "Alarm":
            flags |= LensFlag.ALARM
        return self._motor.flagged(report, flags)

    def _new_motor(self, steps_per_mm: float = 0.0) -> Motor:
        sigma_ns = round(self._settings.latency_sigma_us * NS_PER_US)
        quantum = 0.001 * steps_per_mm
        reply_ns = round(self._settings.latency_us * NS_PER_US)
        timing = Timing(
            reply_ns,
            sigma_ns,
            quantum,
            rest_quantum_steps=quantum,
            ramp_steps=RAMP_STEPS,
            pace_sigma=PACE_SIGMA,
        )
        return Motor(timing, slack_steps=32.0, grace_ms=100.0, floor_steps=0.3)

    def _wait(self, deadline: HostNs, why: str) -> None:
        now = self._clock.now_ns()
        if now >= deadline:
            raise Trouble(why)
        self._clock.sleep_until(after_ms(now, 1))

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Around everything that can meet trouble: the reset goes out, the fault stays, the reference is gone."""
        with self._line.stopping_on_trouble(lambda: RESET, "reset"):
            try:
                yield
            except Trouble:
                self._motor.referenced, self._wish = False, None
                raise
