"""Our own lens controller (drivers/firmware): an ATmega328P that stops within one step.

Every motion is an absolute target under a speed limit, ended by the controller itself; a dead-man brakes when nobody
has spoken for ``watchdog_ms``. The two stops are single bytes, obeyed in the interrupt that receives them; a command
that was sent before a stop and not yet obeyed is dead. A command that was not confirmed is sent again: targets are
absolute, so that twice is as good as once.

A report carries the controller's own time of its sample and of the last step, so that a position in motion is known to
a fraction of a step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from elpd.errors import ConfigError, LensError
from elpd.motion.commanded import Motion
from elpd.motion.readings import Timing
from elpd.records import LensCapabilities, StopMode
from elpd.units import NS_PER_MS, NS_PER_US, after_ms
from elpd_drivers.lenses import avr_wire as wire
from elpd_drivers.lenses.asking import Asking
from elpd_drivers.lenses.axis import limits_from
from elpd_drivers.lenses.direct import DirectLens, Going, Latency, Reading
from elpd_drivers.lenses.line import Trouble, open_on_line
from elpd_drivers.lenses.motor import Motor

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from elpd.ports import BytePort, Clock
    from elpd.records import LensReport
    from elpd_drivers.lenses.line import Line, Sent

SWITCH_STEPS = 32
"""How far a limit switch may close from the end of the travel."""

SETTLING_SPS = 2000.0
"""A rotor takes a single step at about this speed, however slowly the next one comes."""

START_STEPS, TURN_STEPS = 0.5, 4.0
"""How far its ramps stray from the ideal, from rest and through rest, one standard deviation, seen on the firmware."""

SAMPLED_SOONER_US = 45.0
"""By how much sooner than a command takes effect a question's answer is sampled: it needs its check only."""

STEP_NS = 55_000
"""What a step takes of the processor's time; so much of it everything else has to wait for."""

OUTPUTS = ("iris",)

TRIES = 3
"""How often a command is sent before its silence is a fault."""


@dataclass(frozen=True, slots=True)
class AvrSettings:
    """The table ``[lens]`` for our own controller.

    ``watchdog_ms`` is its dead-man; ``sync_steps`` makes an edge on the sync line at each multiple of so many steps (0:
    none), which is wired to the camera's trigger input ``sync_channel``: the camera then stamps where the lens was.
    ``start_stop_um_s`` is the speed from which the motor can halt without losing steps. ``latency_us`` is the usual
    time from a command's last bit to its effect, adapter included.
    """

    port: str = ""
    baud: int = 500_000
    um_per_step: float = 0.3125
    min_um: float = 0.0
    max_um: float = 2500.0
    max_speed_um_s: float = 4_000.0
    acceleration_um_s2: float = 200_000.0
    start_stop_um_s: float = 16_000.0
    homing_um_s: float = 2_000.0
    homing_slow_um_s: float = 150.0
    homing_ms: int = 30_000
    sync_steps: int = 0
    sync_channel: int = 0
    query_ms: float = 4.0
    reply_ms: float = 50.0
    watchdog_ms: float = 500.0
    latency_us: float = 115.0
    latency_sigma_us: float = 20.0


def open_lens(settings: Mapping[str, Any], clock: Clock, port: BytePort | None = None) -> DirectLens:
    """Open, identify and set up the controller. Nothing moves; what was moving is halted.

    Raises ``ConfigError`` for a wrong table, ``LensError`` if something else answers, or nothing.
    """

    def build(table: AvrSettings, line: Line) -> DirectLens:
        latency = Latency.from_us(table.latency_us, table.latency_sigma_us)
        sampled_ns = max(0, latency.usual_ns - round(SAMPLED_SOONER_US * NS_PER_US))
        motor = Motor(Timing(sampled_ns, latency.sigma_ns, quantum_steps=0.5, ramp_steps=1.5))
        return DirectLens(
            AvrController(table, clock, line, motor, latency), line, motor, clock, latency, poll_ms=table.query_ms
        )

    return open_on_line(AvrSettings, settings, clock, port, build)


def held_up(ns: int, velocity_sps: float) -> int:
    """Return how much longer than *ns* something takes beside the steps of a motion, ns."""
    load = min(STEP_NS * abs(velocity_sps) / 1e9, 0.7)
    return round(ns * load / (1.0 - load))


class AvrController:
    """``direct.Controller`` for our own firmware. Use ``open_lens``."""

    abrupt_is_ramped = False

    def __init__(self, settings: AvrSettings, clock: Clock, line: Line, motor: Motor, latency: Latency) -> None:
        self._settings, self._clock, self._line, self._motor = settings, clock, line, motor
        self._latency = latency
        self.limits = limits_from(
            settings.um_per_step,
            settings.min_um,
            settings.max_um,
            settings.max_speed_um_s,
            settings.acceleration_um_s2,
        )
        if self.limits.max_speed_sps > wire.FASTEST_SPS:
            raise ConfigError(
                f"lens.max_speed_um_s: {settings.max_speed_um_s:g} um/s is {self.limits.max_speed_sps:.0f} steps/s; "
                f"this controller makes {wire.FASTEST_SPS} at the most: sweep slower, or set larger microsteps"
            )
        self.asking = Asking(settings.query_ms, settings.reply_ms)
        self.stop_bytes: Mapping[StopMode, bytes] = {StopMode.ABRUPT: wire.HALT, StopMode.RAMPED: wire.BRAKE}
        self.last_resort = wire.encode(0, wire.ENABLE, b"\0")
        # the frame, and the half millisecond that a rotor takes for the last, slow step
        self.command_ns = len(wire.encode(0, wire.GO, wire.go(0, 1000.0))) * line.byte_ns + NS_PER_MS
        self._frames = wire.Frames()
        self._sequence = 0
        self._asked = -1
        self._sampled_from_ns = 0
        self._flags = 0
        self._stamp: int | None = None
        self._homing_begun = False
        self._iris: tuple[bool, int] | None = None  # what it was told to be and is not known to be, tries
        self._unconfirmed: tuple[int, bytes, int, int] | None = None  # sequence, frame, stops before it, tries

    @property
    def mark_every_steps(self) -> int:
        """How many steps lie between two edges on SYNC."""
        return self._settings.sync_steps

    @property
    def mark_channel(self) -> int:
        """The camera's trigger channel that SYNC is wired to."""
        return self._settings.sync_channel

    @property
    def trouble_bytes(self) -> bytes:
        """A halt, and the driver off: with it the controller forgets its reference."""
        return wire.HALT + self.last_resort

    @property
    def capabilities(self) -> LensCapabilities:
        """True velocity, a halt within a step, a dead-man in the controller."""
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
        """Identify the controller, halt it if it moves, and set its limits and ramps."""
        self._line.read()
        answer = self._converse(wire.HELLO)
        if answer.more[1:] != wire.NAME or answer.more[0] != wire.VERSION:
            raise LensError(
                f"lens port {self._line.name}: what answered is {answer.more[1:]!r} version {answer.more[:1].hex()}; "
                f"this driver speaks to {wire.NAME!r} version {wire.VERSION:02x}: flash drivers/firmware"
            )
        if answer.flags & (wire.MOVING | wire.HOMING):
            self._line.send(wire.HALT)
        limits, settings = self.limits, self._settings
        payload = wire.configure(
            limits.acceleration_sps2,
            limits.max_speed_sps,
            limits.min_steps,
            limits.max_steps,
            settings.watchdog_ms,
            settings.sync_steps,
        )
        done = self._converse(wire.CONFIGURE, payload)
        if done.status != wire.OK:
            raise LensError(
                f"lens port {self._line.name}: the controller refused its settings: "
                f"{wire.STATUS_WORDS.get(done.status, done.status)}; "
                "check acceleration, speed, travel and watchdog_ms in [lens]"
            )
        self._flags = done.flags

    def referenced(self) -> bool:
        """Whether the controller says that its count has an origin."""
        return bool(self._flags & wire.REFERENCED)

    def _converse(self, command: int, payload: bytes = b"") -> wire.Reply:
        """Send a command until it is answered. Raises ``LensError`` after the last try."""
        for _ in range(TRIES):
            sequence = self._next()
            self._line.send(wire.encode(sequence, command, payload))
            due = after_ms(self._clock.now_ns(), self._settings.reply_ms)
            while self._line.looked_ns < due:
                for reply in self._frames.feed(self._line.read()):
                    if reply.sequence == sequence and reply.command == command:
                        return reply
                self._clock.sleep_until(after_ms(self._clock.now_ns(), 0.5))
        raise LensError(
            f"lens port {self._line.name}: no answer from an elpd lens controller within {TRIES} times "
            f"{self._settings.reply_ms:.0f} ms; check power, cable and baud ({self._settings.baud})"
        )

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) & 0xFF
        return self._sequence

    # --- motion ----------------------------------------------------------------------------------------------------

    def go(self, target: int, speed_sps: float) -> Going:
        """Aim at a target under a speed limit, in one frame."""
        sequence = self._next()
        frame = wire.encode(sequence, wire.GO, wire.go(target, speed_sps))
        self._unconfirmed = (sequence, frame, self._motor.stops, 1)
        sent = self._line.send(frame)
        strays, late_ns = START_STEPS, 0
        if self._motor.under_way:
            _, velocity_sps = self._motor.state_at(sent.off_wire_ns)
            # it takes effect at the next step, and the rotor is one behind
            late_ns = held_up(self._latency.usual_ns, velocity_sps) + round(
                1.5e9 / max(abs(velocity_sps), SETTLING_SPS)
            )
            strays = TURN_STEPS
        motion = Motion(
            self.limits.acceleration_sps2,
            target_steps=float(target),
            speed_sps=speed_sps,
            rounding_steps=strays,
        )
        return Going(sent.begun_ns, sent.done_ns, [(sent.off_wire_ns + late_ns, motion)])

    def stopped(self, mode: StopMode, sent: Sent, speed_sps: float) -> int:
        """Let what was not obeyed yet be forgotten; a halt from too high a speed costs steps, and the reference."""
        del sent
        self._unconfirmed = None
        if mode is StopMode.ABRUPT and speed_sps * self._settings.um_per_step > self._settings.start_stop_um_s:
            self._motor.referenced = False
        return 0

    # --- the iris --------------------------------------------------------------------------------------------------

    @property
    def outputs(self) -> Sequence[str]:
        """The iris output."""
        return OUTPUTS

    def switch(self, name: str, *, on: bool) -> Sent:
        """Open or close the iris; the reports say whether that was obeyed, and it is said again if not."""
        del name
        self._iris = (on, 1)
        return self._send_iris(on=on)

    def _send_iris(self, *, on: bool) -> Sent:
        return self._line.send(wire.encode(self._next(), wire.IRIS, bytes((int(on),))))

    def _watch_iris(self, flags: int) -> None:
        """See in a report's flags that the iris was obeyed; saying it twice is as good as once."""
        if self._iris is None:
            return
        on, tries = self._iris
        if bool(flags & wire.IRIS_OPEN) == on:
            self._iris = None
        elif tries > TRIES:
            raise Trouble(f"the iris output does not obey, {tries} times told; check the cable and the firmware")
        else:
            self._iris = (on, tries + 1)
            self._send_iris(on=on)

    # --- homing ----------------------------------------------------------------------------------------------------

    def begin_homing(self) -> None:
        """Run to the lower switch and out of it slowly; the step that lets it go is 0."""
        settings = self._settings
        fast = min(settings.homing_um_s / settings.um_per_step, self.limits.max_speed_sps)
        slow = min(settings.homing_slow_um_s / settings.um_per_step, fast)
        sequence = self._next()
        frame = wire.encode(sequence, wire.HOME, wire.home(fast, slow, settings.homing_ms))
        self._unconfirmed = (sequence, frame, self._motor.stops, 1)
        self._line.send(frame)

    def homing(self) -> bool:
        """Whether the controller says that it is homing."""
        begun, self._homing_begun = self._homing_begun, False
        return begun or bool(self._flags & wire.HOMING)

    def end_homing(self) -> None:
        """See that there is a reference."""
        if self._flags & wire.HOMING_FAILED or not self._flags & wire.REFERENCED:
            raise Trouble("homing ended without finding the lower limit switch; look at the switch and its cable")

    # --- questions and replies -------------------------------------------------------------------------------------

    def ask(self) -> None:
        """Ask for a report; send again what was not confirmed."""
        pending = self._unconfirmed
        if pending is not None:
            sequence, frame, stops, tries = pending
            if tries > TRIES:
                raise Trouble(f"a command was not confirmed, {tries} times sent; check the cable")
            if stops == self._motor.stops:
                self._unconfirmed = (sequence, frame, stops, tries + 1)
                if tries > 1:
                    self._line.send(frame)
        self._asked = self._next()
        self._sampled_from_ns = self._line.send(wire.encode(self._asked, wire.STATUS)).off_wire_ns

    def read(self) -> Reading | None:
        """Take what has come; the reply to the newest question is a reading, all others are acted on."""
        reading = None
        for reply in self._frames.feed(self._line.read()):
            self._confirm(reply)
            if reply.status != wire.OK or reply.sequence != self._asked or reply.command != wire.STATUS:
                continue
            self._asked = -1
            self.asking.answered()
            if abs(reply.velocity_sps) > 2 * self.limits.max_speed_sps:
                continue
            self._watch_restart(reply)
            self._flags = reply.flags
            self._watch_iris(reply.flags)
            reading = self._reading(reply)
        return reading

    def _reading(self, reply: wire.Reply) -> Reading:
        velocity, steps = float(reply.velocity_sps), float(reply.position)
        if velocity:
            # a rotor moves to a step after its pulse: so much of the way is still to go
            way = reply.since_step_s * max(abs(velocity), SETTLING_SPS)
            steps -= math.copysign(max(0.0, 1.0 - way), velocity)
        at_switch = bool(reply.flags & (wire.AT_MIN | wire.AT_MAX))
        reply_ns = len(wire.encode(0, wire.STATUS, bytes(19))) * self._line.byte_ns
        latest = max(self._line.by_ns - reply_ns, self._sampled_from_ns)
        return Reading(
            steps,
            velocity,
            bool(reply.flags & wire.MOVING),
            self._sampled_from_ns,
            latest,
            limit=at_switch,
            restart=at_switch and not velocity,
        )

    def _confirm(self, reply: wire.Reply) -> None:
        """Match a reply with the command that waits for it. Raises ``Trouble`` for a refusal."""
        pending = self._unconfirmed
        if pending is None or reply.sequence != pending[0] or reply.command not in {wire.GO, wire.HOME}:
            return
        self._unconfirmed = None
        self._homing_begun = reply.command == wire.HOME and reply.status == wire.OK
        if reply.status in wire.STATUS_WORDS and not (reply.status == wire.LIMIT and reply.command == wire.GO):
            raise Trouble(f"the controller refused to move: {wire.STATUS_WORDS[reply.status]}; home the lens")

    def _watch_restart(self, reply: wire.Reply) -> None:
        """See that the controller's clock goes on: one that begins anew has lost its count."""
        if self._stamp is not None and ((reply.stamp - self._stamp) & 0xFFFFFFFF) > 1 << 31:
            raise Trouble("the controller has restarted; check its supply, then home it")
        self._stamp = reply.stamp

    def believed(self, reading: Reading, report: LensReport) -> None:
        """Look at what stopped it, and at the reference."""
        del reading
        if self._flags & wire.DEAD_MAN and self._motor.under_way and not report.moving:
            raise Trouble(
                f"the controller heard nothing for {self._settings.watchdog_ms:.0f} ms and stopped by itself; "
                "raise lens.watchdog_ms, or look for what kept this program from speaking"
            )
        low, high = self.limits.min_steps + SWITCH_STEPS, self.limits.max_steps - SWITCH_STEPS
        if (self._flags & wire.AT_MIN and report.steps > low) or (self._flags & wire.AT_MAX and report.steps < high):
            self._motor.referenced = False  # a switch where there should be none: the count is wrong
        if self._motor.referenced and not self._flags & (wire.REFERENCED | wire.HOMING):
            raise Trouble("the controller has lost its reference: it restarted or was switched off; home it")
