"""A lens on a controller that obeys at once: one that takes another target, speed or direction in mid-motion.

Every motion is a *target position* under a speed limit, also the ones that ``run`` asks for: the board itself then
ends the motion inside the limits, even if this program dies in the middle of it. A stop is one write of bytes that
were made beforehand, from any thread, behind nothing; a command that was being written when it came is stopped again,
so the stop wins. What is still moving after its time is stopped harder, and its driver switched off in the end.

What differs between such controllers is their wire protocol and the truth about their stops: a ``Controller`` each.
"""

from __future__ import annotations

import math
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from elpd.errors import LensError
from elpd.motion.commanded import REST, Motion
from elpd.records import CommandStamp, LensFlag, LensReport, StopMode
from elpd.units import NS_PER_MS, NS_PER_US, HostNs, after_ms
from elpd_drivers.lenses.axis import check_output, check_speed, check_target, run_target, with_measured_stop
from elpd_drivers.lenses.line import Trouble

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from elpd.ports import Clock
    from elpd.records import LensCapabilities, LensLimits, PositionEstimate, StopTiming
    from elpd.units import Steps
    from elpd_drivers.lenses.asking import Asking
    from elpd_drivers.lenses.line import Line, Sent
    from elpd_drivers.lenses.motor import Motor

STOPS_TRIED = 3
STOP_GRACE_MS = 20.0
LOOK_AHEAD_NS = 2 * NS_PER_MS
"""What a question and its answer take on the wire, and a little."""


@dataclass(frozen=True, slots=True)
class Latency:
    """From a command's last bit to its effect: the usual time, and one standard deviation."""

    usual_ns: int
    sigma_ns: int

    @classmethod
    def from_us(cls, usual_us: float, sigma_us: float) -> Latency:
        """Return it from microseconds."""
        return cls(round(usual_us * NS_PER_US), round(sigma_us * NS_PER_US))


@dataclass(frozen=True, slots=True)
class Reading:
    """What a controller said of itself, and between which instants that was so.

    ``velocity_sps`` is ``None`` where it does not tell. ``restart`` asks to begin from this reading instead of
    comparing it with the model: the controller stopped by itself, for a reason that it tells (a limit switch).
    """

    steps: float
    velocity_sps: float | None
    moving: bool
    earliest_ns: int
    latest_ns: int
    limit: bool = False
    restart: bool = False


@dataclass(frozen=True, slots=True)
class Going:
    """Commands that left for a motion: each with the instant it was complete, and what it made the motor do."""

    begun_ns: HostNs
    done_ns: HostNs
    steps: Sequence[tuple[int, Motion]]


class Controller(Protocol):
    """A wire protocol, and its truth about stopping. It raises ``Trouble`` for what must stop the motor."""

    asking: Asking
    stop_bytes: Mapping[StopMode, bytes]
    abrupt_is_ramped: bool
    last_resort: bytes
    command_ns: int

    @property
    def trouble_bytes(self) -> bytes:
        """What to send when something went wrong: the hardest stop, and that the position is not to be trusted."""
        ...

    @property
    def limits(self) -> LensLimits:
        """Travel and speed; final once connected."""
        ...

    @property
    def capabilities(self) -> LensCapabilities:
        """What it can truly do."""
        ...

    def connect(self) -> None:
        """Identify, halt what moves, set up. Raises ``LensError`` for what is not this controller."""
        ...

    def ask(self) -> None:
        """Send the question for the next reading."""
        ...

    def read(self) -> Reading | None:
        """Take what has come; return a reading when one is complete."""
        ...

    def believed(self, reading: Reading, report: LensReport) -> None:
        """Act on what came with a reading that was believed: errors, lost references."""
        ...

    def referenced(self) -> bool:
        """Say whether the controller's position means anything, after connecting."""
        ...

    def go(self, target: int, speed_sps: float) -> Going:
        """Command an absolute target under a speed limit, whatever is under way."""
        ...

    def stopped(self, mode: StopMode, sent: Sent, speed_sps: float) -> int:
        """Note that a stop has left, at a speed of *speed_sps*; return how much later than usual it may bite, in ns.

        Called from any thread.
        """
        ...

    def begin_homing(self) -> None:
        """Start to look for the reference."""
        ...

    def homing(self) -> bool:
        """Say whether it is still looking, as far as the newest reading tells."""
        ...

    def end_homing(self) -> None:
        """Make sure that the reference was found. Raises ``Trouble`` if not."""
        ...


@runtime_checkable
class Marking(Protocol):
    """A controller that makes an edge each time its count comes to a multiple of so many steps."""

    @property
    def mark_every_steps(self) -> int:
        """Of how many steps; 0: the line is not wired."""
        ...

    @property
    def mark_channel(self) -> int:
        """To which of the camera's trigger channels it is wired."""
        ...


@runtime_checkable
class Switching(Protocol):
    """A controller with outputs of its own."""

    @property
    def outputs(self) -> Sequence[str]:
        """The outputs' names."""
        ...

    def switch(self, name: str, *, on: bool) -> Sent:
        """Switch one of them, behind nothing that moves the motor. Raises ``Trouble`` if it is refused."""
        ...


class DirectLens:
    """``elpd.ports.Lens`` on a controller that obeys at once.

    Parameters
    ----------
    controller
        The wire protocol.
    latency
        From a command to its effect.
    poll_ms
        How often to look while waiting for the end of homing.
    """

    def __init__(
        self, controller: Controller, line: Line, motor: Motor, clock: Clock, latency: Latency, *, poll_ms: float
    ) -> None:
        self._controller, self._line, self._motor = controller, line, motor
        self._clock, self._latency, self._poll_ms = clock, latency, poll_ms
        self._limit = False
        self._obeyed_ns = 0
        self._measured: dict[StopMode, StopTiming] = {}

    # --- what the cycle sees ---------------------------------------------------------------------------------------

    @property
    def limits(self) -> LensLimits:
        """Travel and speed that nothing exceeds."""
        return self._controller.limits

    @property
    def capabilities(self) -> LensCapabilities:
        """What this controller can truly do; its stops as they were measured, if they were."""
        return with_measured_stop(self._controller.capabilities, self._measured)

    def learn_stops(self, measured: Mapping[StopMode, StopTiming]) -> None:
        """Model stops by what was measured of them."""
        self._measured.update(measured)

    def connect(self) -> None:
        """Identify the controller, halt it if it moves, and take its first report."""
        with self._guarded():
            self._controller.connect()
            due = after_ms(self._clock.now_ns(), 4 * self._controller.asking.silence_ms)
            while self._poll(fuse=True) is None:
                self._wait(due, 0.5, "no report after connecting; check the cable")
            self._motor.referenced = self._controller.referenced()

    def home(self, deadline: HostNs) -> LensReport:
        """Let the controller find its reference; return at rest beside it."""
        with self._guarded():
            stops = self._motor.stops
            self._motor.referenced, self._motor.rest_due_ns = False, None
            self._controller.begin_homing()
            patience = after_ms(self._clock.now_ns(), 4 * self._controller.asking.silence_ms)
            seen = False
            while True:
                report = self._poll(fuse=False)
                if self._motor.stops != stops:
                    raise Trouble("homing was stopped; the position is unknown, home it again")
                homing = self._controller.homing()
                seen = seen or homing
                if report is not None and seen and not homing and not report.moving:
                    break
                if not seen and self._clock.now_ns() >= patience:
                    raise Trouble("the controller did not start to home; see that its limit switch is set up")
                why = "homing did not end before its deadline; check the limit switch, or allow more time"
                self._wait(deadline, self._poll_ms, why)
            self._controller.end_homing()
            self._motor.referenced = True
            self._motor.begin(report)
            return self._flagged(report)

    def move_to(self, target: Steps, speed_sps: float) -> CommandStamp:
        """Start an absolute move."""
        stops = self._motor.stops
        self._line.check()
        check_target(target, self.limits)
        check_speed(speed_sps, self.limits)
        if not self._motor.referenced:
            raise LensError(f"lens: cannot move to {target} steps, its position is unknown; home it first")
        return self._go(int(target), abs(speed_sps), "move_to", stops)

    def run(self, velocity_sps: float, until: HostNs) -> CommandStamp:
        """Run at a signed velocity, ending at *until* or the limit: a target position that says both."""
        stops = self._motor.stops
        self._line.check()
        check_speed(velocity_sps, self.limits)
        now = self._clock.now_ns()
        steps, moving_sps = self._motor.state_at(now)
        late_ns = self._latency.usual_ns + 3 * self._latency.sigma_ns + self._controller.command_ns
        spare_ns = until - now - late_ns
        target = run_target(steps, moving_sps, velocity_sps, spare_ns, self.limits, referenced=self._motor.referenced)
        return self._go(target, abs(velocity_sps), "run", stops)

    def stop(self, mode: StopMode) -> CommandStamp:
        """Write the stop bytes now, from any thread; the books are kept afterwards."""
        self._motor.stops += 1
        sent = self._line.send(self._controller.stop_bytes[mode])
        self._motor.written_ns = max(self._motor.written_ns, sent.done_ns - sent.begun_ns)
        effective = sent.off_wire_ns + self._latency.usual_ns
        measured = self._measured.get(mode)
        if measured is not None:
            effective = sent.done_ns + round(measured.onset_ms * NS_PER_MS)
        if self._motor.known:
            _, velocity_sps = self._motor.state_at(effective)
            half_ns = self._controller.stopped(mode, sent, abs(velocity_sps)) // 2
            ramped = mode is StopMode.RAMPED or self._controller.abrupt_is_ramped
            sigma_ns = math.hypot(self._latency.sigma_ns, half_ns)
            braking_sps2 = self.limits.acceleration_sps2
            if measured is not None:
                half_ns, sigma_ns = 0, measured.onset_sigma_ms * NS_PER_MS
                braking_sps2 = measured.deceleration_sps2 or braking_sps2
            motion = Motion(braking_sps2, rounding_steps=0.3) if ramped else REST
            self._motor.command(motion, effective + half_ns, sigma_ns, grace_ms=STOP_GRACE_MS)
        return CommandStamp(f"stop {mode.name.lower()}", sent.begun_ns, sent.done_ns)

    def poll(self) -> LensReport | None:
        """Ask when due, read what has come, return the newest report if there is a new one."""
        with self._guarded():
            report = self._poll(fuse=True)
            return None if report is None else self._flagged(report)

    @property
    def outputs(self) -> Sequence[str]:
        """What the controller can switch beside the motor."""
        return self._controller.outputs if isinstance(self._controller, Switching) else ()

    @property
    def mark_channel(self) -> int | None:
        """The camera's trigger channel that the controller's position marks come on; ``None``: none do."""
        controller = self._controller
        return controller.mark_channel if isinstance(controller, Marking) and controller.mark_every_steps else None

    def mark(self, when: HostNs) -> bool:
        """Learn from an edge that the camera has stamped; say whether it is believed."""
        controller = self._controller
        if not isinstance(controller, Marking) or not controller.mark_every_steps:
            return False
        return self._motor.mark(controller.mark_every_steps, when)

    @property
    def remarks(self) -> Sequence[str]:
        """What a person should know of how the controller answers."""
        return self._controller.asking.remarks

    def set_output(self, name: str, *, on: bool) -> CommandStamp:
        """Switch one of the controller's outputs."""
        controller = self._controller
        check_output(name, self.outputs)
        assert isinstance(controller, Switching), "it has that output"
        with self._guarded():
            sent = controller.switch(name, on=on)
        return CommandStamp(f"{name} {'on' if on else 'off'}", sent.begun_ns, sent.done_ns)

    def position_at(self, when: HostNs) -> PositionEstimate:
        """Return where the motor was at *when*."""
        return self._motor.position_at(when)

    def close(self) -> None:
        """Stop if moving, and give the port back. Idempotent."""
        try:
            if self._motor.may_move:
                self._line.send(self._controller.stop_bytes[StopMode.ABRUPT])
        except LensError:
            pass  # the line is dead: the motion ends at its target
        self._line.close()

    # --- below: how it is done -------------------------------------------------------------------------------------

    def _go(self, target: int, speed_sps: float, name: str, stops: int) -> CommandStamp:
        with self._guarded():
            going = self._controller.go(target, speed_sps)
            self._motor.written_ns = going.done_ns - going.begun_ns
            for off_wire_ns, motion in going.steps:
                self._obeyed_ns = off_wire_ns + self._latency.usual_ns + 3 * self._latency.sigma_ns
                self._motor.command(motion, off_wire_ns + self._latency.usual_ns, self._latency.sigma_ns)
            self._motor.stops_ignored = 0
            if self._motor.stops != stops:
                self.stop(StopMode.ABRUPT)  # one came from another thread while this was on its way: it wins
            return CommandStamp(name, going.begun_ns, going.done_ns)

    def _poll(self, *, fuse: bool) -> LensReport | None:
        asking = self._controller.asking
        reading = self._controller.read()
        report = None if reading is None else self._take(reading, fuse=fuse)
        looked = self._line.looked_ns
        asking.check(looked, " and the controller's settings")
        if self._due(looked):
            self._controller.ask()
            asking.asked(self._clock.now_ns())  # before that nobody can have missed an answer
        return report

    def _due(self, now: int) -> bool:
        """Ask at regular intervals, and as soon as the motor should rest: then somebody waits for the answer."""
        asking, look_ns = self._controller.asking, self._motor.look_ns
        if asking.open or asking.pausing(now) or look_ns is None or look_ns - now > LOOK_AHEAD_NS:
            return asking.due(now)
        if now < look_ns:
            return False  # an answer from before the rest would only keep the line from the one after it
        self._motor.look_ns = None
        return True

    def _take(self, reading: Reading, *, fuse: bool) -> LensReport | None:
        flags = LensFlag.MOVING if reading.moving else LensFlag.NONE
        latest = max(reading.latest_ns, reading.earliest_ns)
        report = LensReport(reading.steps, HostNs(reading.earliest_ns), HostNs(latest), reading.velocity_sps, flags)
        if reading.restart and reading.earliest_ns < self._obeyed_ns:
            reading = replace(reading, restart=False)  # it was so before the last command
        self._motor.replies_are_held(self._controller.asking.held_ns)
        if fuse:
            if reading.restart:
                self._motor.begin(report)
            elif not self._motor.believes(report):
                self._controller.asking.soon()
                return None
        self._controller.asking.believed()
        self._motor.report, self._limit = report, reading.limit
        self._controller.believed(reading, report)
        self._watch_motion(report)
        return report

    def _watch_motion(self, report: LensReport) -> None:
        """See that what should be at rest by now is; else stop again, harder each time."""
        motor = self._motor
        if motor.rest_due_ns is None or report.earliest_ns < motor.rest_due_ns:
            return
        if not motor.overdue(report):
            motor.at_rest()
            return
        if motor.stops_ignored > STOPS_TRIED:
            self._line.send(self._controller.last_resort)
            speed = "" if report.velocity_sps is None else f" at {report.velocity_sps:.0f} steps/s"
            raise Trouble(f"the motor still runs{speed} after {STOPS_TRIED} stops; its driver was switched off")
        self._line.send(self._controller.stop_bytes[StopMode.ABRUPT])

    def _flagged(self, report: LensReport) -> LensReport:
        return self._motor.flagged(report, LensFlag.LIMIT if self._limit else LensFlag.NONE)

    def _wait(self, deadline: HostNs, ms: float, why: str) -> None:
        now = self._clock.now_ns()
        if now >= deadline:
            raise Trouble(why)
        self._clock.sleep_until(after_ms(now, ms))

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Around everything that can meet trouble: the halt goes out, the fault stays, the reference is gone."""
        with self._line.stopping_on_trouble(self._strongest, "halt"):
            try:
                yield
            except Trouble:
                self._motor.referenced = False
                raise

    def _strongest(self) -> bytes:
        """Return what ends a motion that is in trouble; one that ignores stops has its driver switched off."""
        return self._controller.trouble_bytes + (self._controller.last_resort if self._motor.runs_on else b"")
