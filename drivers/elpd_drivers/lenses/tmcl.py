"""A lens on a Trinamic stepper module that speaks TMCL, over USB, RS232 or RS485.

Nine bytes go out, nine come back, and nothing new may be sent in between: so one question is in flight at a time and
commands wait for its reply, some milliseconds at the most. The stop does not wait. On USB and RS232 the module keeps
it until the reply is out; on RS485 it may collide with the reply and be lost, so it is repeated until the module
acknowledges it. A stop (MST) takes effect at once and brakes with the maximum acceleration; there is no harder one,
and the module has no dead-man: what ends a motion is its target.

The module does not know whether its position means anything. After homing, the driver leaves a mark in a user
variable, which is gone when the module was without power. The mark is looked at again and again: a module that
restarted by itself is found out even if it stands where it should.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from elpd.errors import ConfigError, LensError
from elpd.motion.commanded import Motion
from elpd.motion.readings import Timing
from elpd.records import LensCapabilities, LensLimits, StopMode
from elpd.units import NS_PER_MS, after_ms
from elpd_drivers.lenses import tmcl_wire as wire
from elpd_drivers.lenses.asking import Asking
from elpd_drivers.lenses.axis import limits_from
from elpd_drivers.lenses.direct import DirectLens, Going, Latency, Reading
from elpd_drivers.lenses.iris_axis import IRIS
from elpd_drivers.lenses.line import Trouble, open_on_line
from elpd_drivers.lenses.motor import Motor
from elpd_drivers.lenses.tmcl_iris import tmcl_iris
from elpd_drivers.lenses.tmcl_talk import LOOK_MS, Talk, TmclSettings, identify, learn_units, refusal

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from elpd.ports import BytePort, Clock
    from elpd.records import LensReport
    from elpd_drivers.lenses.line import Line, Sent

REFERENCED_MARK, MARK_VARIABLE = 0x454C_5044, 55
OUTPUTS = tuple(f"out{port}" for port in range(8))


def open_lens(settings: Mapping[str, Any], clock: Clock, port: BytePort | None = None) -> DirectLens:
    """Open and identify a TMCL module. Nothing moves; what was moving is stopped.

    Raises ``ConfigError`` for a wrong table, ``LensError`` if there is no TMCL stepper module.
    """

    def build(table: TmclSettings, line: Line) -> DirectLens:
        latency = Latency.from_us(table.latency_us, table.latency_sigma_us)
        timing = Timing(latency.usual_ns, latency.sigma_ns, quantum_steps=1.0, ramp_steps=0.3)
        motor = Motor(timing)
        controller = TmclController(table, clock, line, motor, latency)
        return DirectLens(controller, line, motor, clock, latency, poll_ms=table.query_ms)

    return open_on_line(TmclSettings, settings, clock, port, build)


class TmclController:
    """``direct.Controller`` for a TMCL module. Use ``open_lens``."""

    abrupt_is_ramped = True

    def __init__(self, settings: TmclSettings, clock: Clock, line: Line, motor: Motor, latency: Latency) -> None:
        self._settings, self._clock, self._line, self._motor = settings, clock, line, motor
        self._latency = latency
        self._wanted = limits_from(
            settings.um_per_step,
            settings.min_um,
            settings.max_um,
            settings.max_speed_um_s,
            settings.acceleration_um_s2,
        )
        self.limits = self._wanted
        self._talk = Talk(settings, clock, line)
        self._iris = tmcl_iris(self._talk)
        self.asking = Asking(settings.query_ms, settings.reply_ms)
        stop = self._talk.frame(wire.MST)
        self._stopping = {StopMode.ABRUPT: stop, StopMode.RAMPED: stop}
        abort = self._talk.frame(wire.RFS, wire.STOP) + stop
        self._aborting = {StopMode.ABRUPT: abort, StopMode.RAMPED: abort}
        self.stop_bytes: Mapping[StopMode, bytes] = self._stopping
        self.last_resort = self._talk.frame(wire.SAP, wire.RUN_CURRENT) + self._talk.frame(
            wire.SAP, wire.STANDBY_CURRENT
        )
        self._exchange_ns = 2 * wire.FRAME * line.byte_ns + latency.usual_ns + 4 * latency.sigma_ns
        self.command_ns = 3 * self._exchange_ns
        self._units = wire.Units()
        # the question in flight, and those that follow it
        self._waiting: _Question | None = None
        self._round: deque[_Question] = deque()
        self._rounds = 0
        self._stop_first_ns = self._stop_sent_ns = 0
        self._speed_units = 0
        self._speed_sps = 0.0
        self._left = self._right = self._searching = self._marked = False
        self._asked_off_ns = 0
        self._ready: deque[Reading] = deque()

    @property
    def trouble_bytes(self) -> bytes:
        """Stop, and take the mark away: the next session must home."""
        return self.stop_bytes[StopMode.ABRUPT] + self._talk.frame(wire.SGP, MARK_VARIABLE, 0, motor=wire.USER_BANK)

    @property
    def capabilities(self) -> LensCapabilities:
        """True velocity; a stop that brakes at once, but is not abrupt; no dead-man."""
        return LensCapabilities(
            native_velocity=True,
            abrupt_stop=False,
            stop_on_command=True,
            homing=True,
            stop_onset_ms=(self._latency.usual_ns + wire.FRAME * self._line.byte_ns) / NS_PER_MS,
            stop_onset_sigma_ms=self._latency.sigma_ns / NS_PER_MS,
            watchdog_ms=None,
        )

    # --- connecting ------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Identify the module, stop it if it moves, learn its units, and set its acceleration."""
        identify(self._talk)
        self._talk.attempt(wire.RFS, wire.STOP)
        self._talk.exchange(wire.MST)
        self._units = learn_units(self._talk)
        wanted, units = self._wanted, self._units
        if not units.fits(wanted.max_speed_sps, wanted.acceleration_sps2):
            raise ConfigError(
                f"lens: the module's divisors allow {wire.TMC429_MAX * units.speed_sps:.0f} steps/s and "
                f"{wire.TMC429_MAX * units.acceleration_sps2:.0f} steps/s2, the config asks for "
                f"{wanted.max_speed_sps:.0f} and {wanted.acceleration_sps2:.0f}; change axis parameters 153 and 154, "
                "or lens.max_speed_um_s and lens.acceleration_um_s2"
            )
        self._speed_units = units.speed(wanted.max_speed_sps)
        acceleration = units.acceleration(wanted.acceleration_sps2)
        self._talk.exchange(wire.SAP, wire.MAX_ACCELERATION, acceleration)
        self._talk.exchange(wire.SAP, wire.MAX_SPEED, self._speed_units)
        self.limits = LensLimits(
            wanted.min_steps,
            wanted.max_steps,
            min(wanted.max_speed_sps, self._speed_units * units.speed_sps),
            acceleration * units.acceleration_sps2,
        )
        due = after_ms(self._clock.now_ns(), 20 * self._settings.reply_ms)
        while self._talk.exchange(wire.GAP, wire.SPEED):
            if self._clock.now_ns() >= due:
                raise LensError(f"lens port {self._line.name}: the motor does not stop; switch the module off and on")
        self._marked = self._talk.exchange(wire.GGP, MARK_VARIABLE, motor=wire.USER_BANK) == REFERENCED_MARK
        if self._iris is not None:
            self._iris.meet()

    def referenced(self) -> bool:
        """Whether the mark of an earlier homing is still there: the module had power ever since."""
        return self._marked

    def _settle(self) -> None:
        """Wait until nothing is in flight, or what is must be taken for lost."""
        due = after_ms(self._clock.now_ns(), self._settings.reply_ms / 4)
        self._round.clear()
        while self._waiting is not None or self._talk.stops_open > 0:
            self._take()
            if self._line.looked_ns >= due:
                break
            self._clock.sleep_until(after_ms(self._clock.now_ns(), LOOK_MS))
        self._waiting, self._talk.stops_open = None, 0
        self.asking.answered()

    # --- motion ----------------------------------------------------------------------------------------------------

    def go(self, target: int, speed_sps: float) -> Going:
        """Aim at a target under another speed limit: two commands, each behind the reply to the one before it."""
        self._settle()
        begun = self._clock.now_ns()
        units = self._units.speed(speed_sps)
        motion = Motion(
            self.limits.acceleration_sps2, target_steps=float(target), speed_sps=units * self._units.speed_sps
        )
        old = Motion(
            self.limits.acceleration_sps2,
            target_steps=float(target),
            speed_sps=self._speed_units * self._units.speed_sps,
        )
        aim = (wire.MVP, wire.ABSOLUTE, target)
        limit = (wire.SAP, wire.MAX_SPEED, units)
        # in motion the target goes first: another speed limit alone would accelerate towards the old target
        steps: list[tuple[tuple[int, int, int], Motion | None]]
        if units == self._speed_units:
            steps = [(aim, motion)]
        elif self._motor.under_way:
            steps = [(aim, old), (limit, motion)]
        else:
            steps = [(limit, None), (aim, motion)]
        planned: list[tuple[int, Motion]] = []
        done, stops = begun, self._motor.stops
        for command, then in steps:
            if self._motor.stops != stops:
                break  # one came while the first reply was awaited
            sent = self._line.send(self._talk.frame(*command))
            self._talk.confirm(command[0])
            done = sent.done_ns
            if then is not None:
                planned.append((sent.off_wire_ns, then))
        self._speed_units = units
        return Going(begun, done, planned)

    def stopped(self, mode: StopMode, sent: Sent, speed_sps: float) -> int:
        """Remember that an acknowledgement is due; the module may finish the reply before it first."""
        del mode, speed_sps
        self._talk.stops_open += 1
        self._stop_first_ns = self._stop_sent_ns = sent.off_wire_ns
        if self._waiting is None:
            return 0
        reply_out_ns = self._asked_off_ns + self._latency.usual_ns + wire.FRAME * self._line.byte_ns
        return max(0, reply_out_ns - sent.off_wire_ns)

    def _repeat_stop(self) -> None:
        """Send an unacknowledged stop again, when its reply and the one before it should have come."""
        if self._talk.stops_open > 0 and self._line.looked_ns - self._stop_sent_ns > 2 * self._exchange_ns:
            sent = self._line.send(self.stop_bytes[StopMode.RAMPED])
            self._talk.stops_open, self._stop_sent_ns = 1, sent.off_wire_ns
            # it may have been any of them
            half_ns = (sent.off_wire_ns - self._stop_first_ns) // 2
            effective_ns = self._stop_first_ns + half_ns + self._latency.usual_ns
            self._motor.amend(self._motor.newest_command, effective_ns, half_ns)

    # --- outputs ---------------------------------------------------------------------------------------------------

    @property
    def outputs(self) -> Sequence[str]:
        """The module's general purpose outputs (it refuses those that it does not have), and an iris on a motor."""
        return OUTPUTS if self._iris is None else (IRIS, *OUTPUTS)

    def switch(self, name: str, *, on: bool) -> Sent:
        """Switch an output, and wait for the reply: no other command may be sent before it."""
        self._settle()
        if self._iris is not None and name == IRIS:
            return self._iris.turn(opened=on)
        port = int(name.removeprefix("out"))
        sent = self._line.send(self._talk.frame(wire.SIO, port, int(on), motor=wire.OUTPUT_BANK))
        self._talk.confirm(wire.SIO)
        return sent

    # --- homing ----------------------------------------------------------------------------------------------------

    def begin_homing(self) -> None:
        """Let the module search its left switch; position 0 is where it lets go."""
        self._settle()
        settings = self._settings
        towards = self._units.speed(settings.home_um_s / settings.um_per_step)
        away = self._units.speed(settings.switch_um_s / settings.um_per_step)
        self._talk.exchange(wire.SGP, MARK_VARIABLE, 0, motor=wire.USER_BANK)
        for kind, value in (
            (wire.RIGHT_SWITCH_OFF, 0),
            (wire.LEFT_SWITCH_OFF, 0),
            (wire.SEARCH_MODE, wire.SEARCH_LEFT_SWITCH),
            (wire.SEARCH_SPEED, towards),
            (wire.SWITCH_SPEED, away),
        ):
            self._talk.exchange(wire.SAP, kind, value)
        self._marked = False
        self.stop_bytes = self._aborting
        self._talk.exchange(wire.RFS, wire.START)
        self._searching = True
        self.asking.soon()

    def homing(self) -> bool:
        """Whether the module says that it is searching."""
        return self._searching

    def end_homing(self) -> None:
        """Leave the mark."""
        self._settle()
        self.stop_bytes = self._stopping
        self._talk.exchange(wire.SGP, MARK_VARIABLE, REFERENCED_MARK, motor=wire.USER_BANK)
        self._marked = True

    # --- queries and replies ---------------------------------------------------------------------------------------

    def ask(self) -> None:
        """Begin a round of questions: speed, then position, and one more that is due now and then."""
        self._waiting = None
        self._round.clear()
        if self.stop_bytes is self._aborting:
            self._round.append(_Question(wire.RFS, wire.STATUS))
        self._round.extend((_Question(wire.GAP, wire.SPEED), _Question(wire.GAP, wire.POSITION)))
        self._round.append(_NOW_AND_THEN[self._rounds % len(_NOW_AND_THEN)])
        self._rounds += 1
        self._go_on()

    def read(self) -> Reading | None:
        """Take what has come, and send the round's next question, or again a stop that nobody heard."""
        self._take()
        self._repeat_stop()
        if self.asking.open:
            self._go_on()
        return self._ready.popleft() if self._ready else None

    def _take(self) -> None:
        for reply, behind in self._talk.replies():
            if self._waiting is None or reply.command != self._waiting.command:
                self._talk.heed(reply)  # or late, or a duplicate: its instant of sampling is unknown
                continue
            ended_ns = self._line.by_ns - behind * self._line.byte_ns
            if ended_ns < self._asked_off_ns + wire.FRAME * self._line.byte_ns:
                continue  # so soon it cannot be the answer: replies do not say which parameter they are of
            question, self._waiting = self._waiting, None
            if reply.status != wire.OK:
                raise refusal(reply, "check lens.motor")
            self._learn(question, reply.value, ended_ns - wire.FRAME * self._line.byte_ns)

    def _go_on(self) -> None:
        """Send the next question, unless a reply is still to come: another command would collide with it."""
        if self._waiting is not None or self._talk.stops_open > 0:
            return
        if not self._round:
            self.asking.answered()
            return
        self._waiting = question = self._round.popleft()
        self.asking.asked(self._clock.now_ns())
        motor = wire.USER_BANK if question.command in {wire.GGP, wire.SGP} else None
        sent = self._line.send(self._talk.frame(question.command, question.kind, motor=motor))
        self._asked_off_ns = sent.off_wire_ns

    def _learn(self, question: _Question, value: int, latest_ns: int) -> None:
        if question.command == wire.RFS:
            self._searching = value != 0
        elif question.command == wire.GGP:
            if self._marked and value != REFERENCED_MARK:
                raise Trouble("the module has restarted by itself; check its supply, then home")
        elif question.command == wire.SGP:
            pass  # the mark is gone
        elif question.kind == wire.SPEED:
            self._learn_speed(value)
        elif question.kind == wire.RIGHT_SWITCH:
            self._right = value != 0
        elif question.kind == wire.LEFT_SWITCH:
            self._left = value != 0
        elif question.kind == wire.DRIVER_FLAGS:
            words = ", ".join(word for bit, word in wire.DRIVER_WORDS.items() if value & bit)
            if words:
                raise Trouble(f"the motor driver stopped: {words} (flags {value:#04x}); remove the cause, home")
        else:
            self._learn_position(value, latest_ns)

    def _learn_speed(self, value: int) -> None:
        sps = value * self._units.speed_sps
        if abs(sps) > 2 * self.limits.max_speed_sps:
            self._round.clear()  # nonsense with a right checksum; silence counts on
            return
        self._speed_sps = sps
        planned = self._motor.planned_rest_ns
        due = self._motor.rest_due_ns is not None and (planned is None or planned > self._clock.now_ns())
        if sps == 0.0 and (due or self._left or self._right):
            # it stands when it should move: was it a switch?
            first = _Question(wire.GAP, wire.LEFT_SWITCH), _Question(wire.GAP, wire.RIGHT_SWITCH)
            self._round.extendleft(first)

    def _learn_position(self, value: int, latest_ns: int) -> None:
        speed, limit = self._speed_sps, self._left or self._right
        # a moving motor is half a step beyond the last one that it made, on average
        steps = value + (0.5 if speed > 0 else -0.5 if speed < 0 else 0.0)
        standing = limit and not speed
        self._ready.append(
            Reading(steps, speed, speed != 0.0, self._asked_off_ns, latest_ns, limit=limit, restart=standing)
        )

    def believed(self, reading: Reading, report: LensReport) -> None:
        """Distrust the position when a switch has ended a motion: it was not what it seemed."""
        del report
        if reading.restart and not self._searching and self._motor.rest_due_ns is not None and self._motor.referenced:
            self._motor.referenced = self._marked = False
            self._round.append(_Question(wire.SGP, MARK_VARIABLE))


@dataclass(frozen=True, slots=True)
class _Question:
    command: int
    kind: int


_NOW_AND_THEN = (
    _Question(wire.GGP, MARK_VARIABLE),
    _Question(wire.GAP, wire.LEFT_SWITCH),
    _Question(wire.GAP, wire.DRIVER_FLAGS),
    _Question(wire.GAP, wire.RIGHT_SWITCH),
)
