"""A lens on a Pololu Tic (T-series), over its TTL serial port.

A Tic obeys at once (``direct.DirectLens``): it ramps through zero by itself, a stop is one byte (halt and hold), and
its command timeout (the "watchdog") ends a motion that nobody watches any more.

After an abrupt halt the Tic says "position uncertain", because a halt may cost steps. Below the motor's start-stop
speed it does not, so the driver confirms the position it read at rest; above, the lens counts as unreferenced.

The time at which a position was sampled lies between the query's last byte on the wire and the reply's first one;
``elpd.motion.trajectory`` makes positions at any instant of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from elpd.errors import LensError
from elpd.motion.commanded import Motion
from elpd.motion.readings import Timing
from elpd.records import LensCapabilities, StopMode
from elpd.units import NS_PER_MS, after_ms
from elpd_drivers.lenses import tic_wire as wire
from elpd_drivers.lenses.asking import Asking
from elpd_drivers.lenses.axis import limits_from
from elpd_drivers.lenses.direct import DirectLens, Going, Latency, Reading
from elpd_drivers.lenses.line import Trouble, open_on_line
from elpd_drivers.lenses.motor import Motor
from elpd_drivers.lenses.tic_wire import crc7, encode, long_word, parse_reply, reply_length

if TYPE_CHECKING:
    from collections.abc import Mapping

    from elpd.ports import BytePort, Clock
    from elpd.records import LensReport
    from elpd_drivers.lenses.line import Line, Sent

IDENTIFICATIONS = 3
"""How often to ask who is there, before what answers counts as no Tic."""


@dataclass(frozen=True, slots=True)
class TicSettings:
    """The table ``[lens]`` for a Tic.

    ``latency_us`` is the usual time from a command's last bit to its effect, adapter included, and
    ``latency_sigma_us`` how well that is known. Unless given, a real port gets what USB adapters need, which is wider.
    ``start_stop_um_s`` is the speed from which the motor can halt without
    losing steps. ``crc`` must be what the Tic's own settings say.
    """

    port: str = ""
    baud: int = 115_200
    device_number: int | None = None
    crc_commands: bool = False
    crc_responses: bool = False
    um_per_step: float = 0.3125
    min_um: float = 0.0
    max_um: float = 2500.0
    max_speed_um_s: float = 12_000.0
    acceleration_um_s2: float = 200_000.0
    start_stop_um_s: float = 16_000.0
    query_ms: float = 4.0
    reply_ms: float = 50.0
    watchdog_ms: float = 1000.0
    latency_us: float = 100.0
    latency_sigma_us: float = 30.0


def open_lens(settings: Mapping[str, Any], clock: Clock, port: BytePort | None = None) -> DirectLens:
    """Open, identify and energize a Tic. Nothing moves; what was moving is halted.

    Raises ``ConfigError`` for a wrong table, ``LensError`` if there is no Tic.
    """

    def build(table: TicSettings, line: Line) -> DirectLens:
        latency = Latency.from_us(table.latency_us, table.latency_sigma_us)
        motor = Motor(Timing(latency.usual_ns, latency.sigma_ns, quantum_steps=1.0, ramp_steps=0.3))
        controller = TicController(table, clock, line, motor, latency)
        return DirectLens(controller, line, motor, clock, latency, poll_ms=table.query_ms)

    return open_on_line(TicSettings, settings, clock, port, build)


class TicController:
    """``direct.Controller`` for a Tic. Use ``open_lens``."""

    abrupt_is_ramped = False

    def __init__(self, settings: TicSettings, clock: Clock, line: Line, motor: Motor, latency: Latency) -> None:
        self._settings, self._clock, self._line, self._motor = settings, clock, line, motor
        self._latency = latency
        self.limits = limits_from(
            settings.um_per_step,
            settings.min_um,
            settings.max_um,
            settings.max_speed_um_s,
            settings.acceleration_um_s2,
        )
        self.asking = Asking(settings.query_ms, settings.reply_ms)
        self.stop_bytes: Mapping[StopMode, bytes] = {
            StopMode.ABRUPT: self._frame(wire.HALT_AND_HOLD),
            StopMode.RAMPED: self._frame(wire.SET_TARGET_VELOCITY, long_word(0)),
        }
        self.last_resort = self._frame(wire.DEENERGIZE)
        self.command_ns = 14 * line.byte_ns
        get = self._frame(wire.GET_VARIABLE, bytes((0x22, 8)))
        self._query_head = len(self._frame(wire.RESET_TIMEOUT) + get)
        self._query_bytes = self._frame(wire.RESET_TIMEOUT) + get + self._frame(wire.GET_VARIABLE, bytes((0x01, 3)))
        self._reply_length = reply_length(crc=settings.crc_responses)
        self._received = bytearray()
        self._sampled_from_ns = 0
        self._newest = wire.TicReply(0, 0.0, 0, 0)
        self._status = self._errors = 0
        self._cleared_ns = 0
        self._halted_softly = False
        self._told_home_ns: int | None = None
        self._newest_from_ns = 0
        self._speed_sps = 0.0

    @property
    def trouble_bytes(self) -> bytes:
        """A halt; with it the Tic itself says that the position is uncertain."""
        return self.stop_bytes[StopMode.ABRUPT]

    @property
    def capabilities(self) -> LensCapabilities:
        """True velocity, a halt at once, a dead-man in the board."""
        return LensCapabilities(
            native_velocity=True,
            abrupt_stop=True,
            stop_on_command=True,
            homing=True,
            stop_onset_ms=(self._latency.usual_ns + self._line.byte_ns) / NS_PER_MS,
            stop_onset_sigma_ms=self._latency.sigma_ns / NS_PER_MS,
            watchdog_ms=self._settings.watchdog_ms,
        )

    # --- connecting ------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Identify the board, halt it if it moves, and set its ramps."""
        self._identify()
        acceleration = long_word(round(self.limits.acceleration_sps2 * 100))
        setup = [(wire.SET_MAX_ACCELERATION, acceleration), (wire.SET_MAX_DECELERATION, acceleration)]
        setup.append((wire.SET_STARTING_SPEED, long_word(0)))
        for command, data in setup:
            self._line.send(self._frame(command, data))
        if any(self._ask_for(0x26, 4)):
            self._line.send(self.stop_bytes[StopMode.ABRUPT])
        self._line.send(self._frame(wire.ENERGIZE) + self._frame(wire.EXIT_SAFE_START))

    def referenced(self) -> bool:
        """Whether the Tic says that its position is certain."""
        return not self._status & wire.UNCERTAIN

    def _identify(self) -> None:
        """See that a Tic answers; where what another session had asked for arrives first, ask again.

        Raises ``LensError`` after the last attempt.
        """
        for attempts_left in reversed(range(IDENTIFICATIONS)):
            self._line.read()
            try:
                state = self._ask_for(0x00, 9)
                step_mode = self._ask_for(0x49, 1)[0]
                supply_mv = int.from_bytes(self._ask_for(0x33, 2), "little")
            except LensError:
                if attempts_left == 0:
                    raise
                self._clock.sleep_until(after_ms(self._clock.now_ns(), self._settings.reply_ms))
            else:
                break
        if state[0] not in wire.OPERATION_STATES or step_mode > 9 or not 2_000 <= supply_mv <= 60_000:
            raise LensError(
                f"lens port {self._line.name}: what answered is not a Tic: operation state "
                f"{state[0]}, step mode {step_mode}, supply {supply_mv} mV; check lens.board, baud and CRC settings"
            )

    def _ask_for(self, offset: int, length: int) -> bytes:
        """Read variables, waiting for the reply within the limit."""
        self._received.clear()
        self._line.send(self._frame(wire.GET_VARIABLE, bytes((offset, length))))
        due = after_ms(self._clock.now_ns(), self._settings.reply_ms)
        expected = length + self._settings.crc_responses
        while True:
            self._received += self._line.read()
            if len(self._received) >= expected:
                break
            if self._line.looked_ns >= due:
                raise LensError(
                    f"lens port {self._line.name}: no answer from a Tic within "
                    f"{self._settings.reply_ms:.0f} ms (received {bytes(self._received)!r}); check power, cable, baud "
                    f"({self._settings.baud}), device number and CRC settings"
                )
            self._clock.sleep_until(after_ms(self._clock.now_ns(), 0.5))
        raw = bytes(self._received)
        self._received.clear()
        if len(raw) != expected or (self._settings.crc_responses and crc7(raw[:length]) != raw[length]):
            raise LensError(
                f"lens port {self._line.name}: what answered is not a Tic: {raw[:40]!r} where "
                f"{expected} bytes were due; check lens.board, baud and CRC settings"
            )
        return raw[:length]

    # --- motion ----------------------------------------------------------------------------------------------------

    def go(self, target: int, speed_sps: float) -> Going:
        """Aim at a target under another speed limit, in one write."""
        self._prepare()
        aim = self._frame(wire.SET_TARGET_POSITION, long_word(target))
        limit = self._frame(wire.SET_MAX_SPEED, long_word(max(1, round(speed_sps * 10_000))))
        motion = Motion(self.limits.acceleration_sps2, target_steps=float(target), speed_sps=speed_sps)
        # in motion the target goes first: another speed limit alone would accelerate towards the old target
        steps: list[tuple[bytes, Motion | None]]
        steps = [(aim, replace(motion, speed_sps=self._speed_sps)), (limit, motion)]
        if self._speed_sps == speed_sps:
            steps = [(aim, motion)]
        elif self._motor.rest_due_ns is None:
            steps = [(limit, None), (aim, motion)]
        sent = self._line.send(b"".join(data for data, _ in steps))
        self._speed_sps = speed_sps
        behind = sum(len(data) for data, _ in steps)
        planned: list[tuple[int, Motion]] = []
        for data, then in steps:
            behind -= len(data)
            if then is not None:
                planned.append((sent.off_wire_ns - behind * self._line.byte_ns, then))
        return Going(sent.begun_ns, sent.done_ns, planned)

    def stopped(self, mode: StopMode, sent: Sent, speed_sps: float) -> int:
        """Remember whether the halt came from a speed at which it costs no steps."""
        del sent
        if mode is StopMode.ABRUPT:
            safe = speed_sps * self._settings.um_per_step <= self._settings.start_stop_um_s
            self._halted_softly = self._motor.referenced = self._motor.referenced and safe
        return 0

    def _prepare(self) -> None:
        """Clear what keeps an idle Tic from moving: its command timeout and the safe start that follows."""
        report = self._motor.report
        idle = report is None or self._clock.now_ns() - report.latest_ns > 200 * NS_PER_MS
        if self._errors or idle:
            sent = self._line.send(self._frame(wire.ENERGIZE) + self._frame(wire.EXIT_SAFE_START))
            self._errors, self._cleared_ns = 0, sent.off_wire_ns

    # --- homing ----------------------------------------------------------------------------------------------------

    def begin_homing(self) -> None:
        """Run to the reverse limit switch; position 0 is where it lets go."""
        self._prepare()
        self._halted_softly = False
        self._told_home_ns = self._line.send(
            self._frame(wire.EXIT_SAFE_START) + self._frame(wire.GO_HOME, b"\0")
        ).off_wire_ns

    def homing(self) -> bool:
        """Whether the Tic says that it is homing, or has homed since it was looked at last.

        A Tic that begins on its switch, or beside it, may be done between two looks. Then it stands at 0, is certain of
        it, and has made a step since it was told to home.
        """
        if self._status & wire.HOMING:
            self._told_home_ns = None
            return True
        told_ns, newest = self._told_home_ns, self._newest
        if (
            told_ns is None
            or self._newest_from_ns < told_ns
            or self._status & wire.UNCERTAIN
            or newest.position != 0
            or newest.velocity_sps != 0.0
        ):
            return False
        self._settle()
        since_ns = int.from_bytes(self._ask_for(*wire.SINCE_LAST_STEP), "little") * 1000 // wire.SINCE_PER_US
        if self._line.by_ns - since_ns < told_ns:
            return False
        self._told_home_ns = None
        return True

    def _settle(self) -> None:
        """Let the reply that is under way arrive, and leave it: another question follows."""
        due = after_ms(self._clock.now_ns(), self._settings.reply_ms)
        while self._line.looked_ns < due and (
            self.asking.pausing(self._line.looked_ns) or (self.asking.open and len(self._received) < self._reply_length)
        ):
            self._clock.sleep_until(after_ms(self._clock.now_ns(), 0.5))
            self._received += self._line.read()
        self.asking.forget()

    def end_homing(self) -> None:
        """See that the position is certain."""
        if self._status & wire.UNCERTAIN:
            raise Trouble("homing ended without a certain position; look at the limit switch")

    # --- queries and replies ---------------------------------------------------------------------------------------

    def ask(self) -> None:
        """Ask for position, velocity, flags and errors, and keep the command timeout from running out."""
        again = self.asking.open
        self._received.clear()
        end = self._line.send(self._query_bytes).off_wire_ns
        if again:
            self.asking.asked_again()  # the answer may be to the first one, and as old
        else:
            self._sampled_from_ns = end - (len(self._query_bytes) - self._query_head) * self._line.byte_ns

    def read(self) -> Reading | None:
        """Take the reply when all of it has come; without CRC only what cannot be is refused.

        The beginning of one whose rest does not come is given up: nothing is asked before the line had time to bring
        the rest, so that it is not taken for the beginning of the next.
        """
        self._received += self._line.read()
        if not self.asking.open:
            return None
        if len(self._received) < self._reply_length:
            if self._received and self.asking.due(self._line.looked_ns):
                self.asking.gave_up()
            return None
        # more than one can only be right where it was asked for again
        raw = bytes(self._received[: self._reply_length if self.asking.twice else None])
        self.asking.answered()
        reply = parse_reply(raw, crc=self._settings.crc_responses)
        self._received.clear()
        # it homes at speeds of its own settings
        if reply is None or (abs(reply.velocity_sps) > 2 * self.limits.max_speed_sps and not reply.flags & wire.HOMING):
            return None  # the silence limit counts on; the next query resynchronises
        self._newest, self._newest_from_ns = reply, self._sampled_from_ns
        velocity = reply.velocity_sps
        at_switch = bool(reply.flags & (wire.FORWARD_LIMIT | wire.REVERSE_LIMIT))
        # a moving motor is half a step beyond the last one that it made, on average
        steps = reply.position + (0.5 if velocity > 0 else -0.5 if velocity < 0 else 0.0)
        latest = self._line.by_ns - self._reply_length * self._line.byte_ns
        return Reading(
            steps,
            velocity,
            velocity != 0.0,
            self._sampled_from_ns,
            latest,
            limit=at_switch,
            restart=at_switch and not velocity,
        )

    def believed(self, reading: Reading, report: LensReport) -> None:
        """Look at errors and at the reference."""
        del reading
        self._status, self._errors = self._newest.flags, self._newest.errors
        self._watch_errors(report)
        self._watch_reference(report)

    def _watch_errors(self, report: LensReport) -> None:
        """Stop for what a person must look at; an idle Tic's timeout is cleared before the next motion."""
        errors, due = self._errors, self._motor.rest_due_ns
        # A reply that was asked for before an idle Tic's errors were cleared may arrive after: it tells of those.
        under_way = due is not None and self._cleared_ns < report.earliest_ns and report.latest_ns < due
        serious = errors & ~wire.RECOVERABLE
        if serious or (errors and under_way and not report.moving):
            words = ", ".join(word for bit, word in wire.ERROR_WORDS.items() if errors & bit)
            raise Trouble(f"the Tic stopped itself: {words} (error bits {errors:#06x}); remove the cause, home")

    def _watch_reference(self, report: LensReport) -> None:
        """Confirm the position after a halt that cost no steps; without one, "uncertain" means lost."""
        if not self._status & wire.UNCERTAIN:
            return
        motor = self._motor
        if not self._halted_softly:
            motor.referenced = motor.referenced and motor.rest_due_ns is not None and report.moving
        elif not report.moving and report.earliest_ns > motor.rest_from_ns:
            self._line.send(self._frame(wire.HALT_AND_SET_POSITION, long_word(self._newest.position)))
            self._halted_softly = False

    def _frame(self, command: int, data: bytes = b"") -> bytes:
        settings = self._settings
        return encode(command, data, device_number=settings.device_number, crc=settings.crc_commands)
