"""A lens on a Zaber controller or stage, over the ASCII protocol of firmware 7.

Zaber devices obey at once (``direct.DirectLens``), know their travel, and say in every reply whether they are busy
and what is wrong: "WR" means that the position is not referenced, and coming back in the middle of a session, that
the device has restarted. Every command carries a checksum and a number which its reply repeats, so a late or
duplicate reply is told from the one that is due. A speed is given with each move, which needs firmware 7.25; the
settings in the device's memory are read and never written.

``stop`` brakes with the device's own deceleration. ``estop`` ends the steps at once and may lose some: it is for
trouble, and after it the lens must be homed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from elpd.errors import ConfigError, LensError
from elpd.motion.commanded import Motion
from elpd.motion.readings import Timing
from elpd.records import LensCapabilities, LensLimits, StopMode
from elpd.units import NS_PER_MS, Steps, after_ms
from elpd_drivers.lenses import zaber_wire as wire
from elpd_drivers.lenses.asking import Asking
from elpd_drivers.lenses.axis import limits_from
from elpd_drivers.lenses.direct import DirectLens, Going, Latency, Reading
from elpd_drivers.lenses.iris_axis import IRIS, iris_axis
from elpd_drivers.lenses.line import Trouble, open_on_line
from elpd_drivers.lenses.lines import LineReader
from elpd_drivers.lenses.motor import Motor
from elpd_drivers.lenses.zaber_iris import ZaberIris

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from elpd.ports import BytePort, Clock
    from elpd.records import LensReport
    from elpd_drivers.lenses.line import Line, Sent

IDENTIFICATIONS = 3
OLDEST = (7, 25)
LONGEST_COMMAND = 40
OUTPUTS = ("do1", "do2", "do3", "do4")


@dataclass(frozen=True, slots=True)
class ZaberSettings:
    """The table ``[lens]`` for a Zaber device. What it knows (travel, speed, acceleration) is read from it.

    ``device`` is its address in the chain, ``axis`` the motor. With ``iris_axis`` another of the device's axes turns a
    stepper iris, which is the output "iris" then: between ``iris_closed`` and ``iris_open`` (microsteps from that
    axis's home, which is at the closed end) at ``iris_speed_sps``. ``max_um``, ``max_speed_um_s`` and
    ``acceleration_um_s2`` need not be given; a limit must lie inside the device's own, an acceleration agree with it.
    ``latency_us`` is the usual time from a command's last bit to its effect, adapter included, and
    ``latency_sigma_us`` how well that is known; unless given, a real port gets what USB adapters need.
    """

    port: str = ""
    baud: int = 115_200
    device: int = 1
    axis: int = 1
    um_per_step: float = 0.3125
    min_um: float = 0.0
    max_um: float | None = None
    max_speed_um_s: float | None = None
    acceleration_um_s2: float | None = None
    query_ms: float = 6.0
    reply_ms: float = 60.0
    latency_us: float = 300.0
    latency_sigma_us: float = 87.0
    iris_axis: int | None = None
    iris_closed: int = 0
    iris_open: int = 0
    iris_speed_sps: float = 0.0


def open_lens(settings: Mapping[str, Any], clock: Clock, port: BytePort | None = None) -> DirectLens:
    """Open and identify a Zaber device. Nothing moves; what was moving is stopped.

    Raises ``ConfigError`` for a wrong table, ``LensError`` if there is no Zaber device with firmware 7.25 or newer.
    """

    def build(table: ZaberSettings, line: Line) -> DirectLens:
        latency = Latency.from_us(table.latency_us, table.latency_sigma_us)
        # whether a count in motion is rounded or the last step is not documented: it may be either
        timing = Timing(latency.usual_ns, latency.sigma_ns, quantum_steps=2.0, ramp_steps=0.3)
        motor = Motor(timing)
        controller = ZaberController(table, clock, line, motor, latency)
        return DirectLens(controller, line, motor, clock, latency, poll_ms=table.query_ms)

    return open_on_line(ZaberSettings, settings, clock, port, build)


class ZaberController:
    """``direct.Controller`` for a Zaber device. Use ``open_lens``."""

    abrupt_is_ramped = False

    def __init__(self, settings: ZaberSettings, clock: Clock, line: Line, motor: Motor, latency: Latency) -> None:
        self._settings, self._clock, self._line, self._motor = settings, clock, line, motor
        self._latency = latency
        self.limits = limits_from(settings.um_per_step, 0.0, 1.0, 1.0, 1.0)
        self.asking = Asking(settings.query_ms, settings.reply_ms)
        self.stop_bytes: Mapping[StopMode, bytes] = {
            StopMode.RAMPED: self._frame("stop"),
            StopMode.ABRUPT: self._frame("estop"),
        }
        self.last_resort = self._frame("driver disable")
        self.command_ns = LONGEST_COMMAND * line.byte_ns
        self._lines = LineReader()
        self._numbers = 0
        self._checked_only = False
        self._question: int | None = None
        self._asked_off_ns = 0
        self._orders: set[int] = set()
        self._busy = self._referenced = False
        axis = iris_axis(settings, settings.axis, range(1, 10))
        self._iris = None if axis is None else ZaberIris(axis, self._exchange, self._order)

    @property
    def trouble_bytes(self) -> bytes:
        """End the steps at once."""
        return self.stop_bytes[StopMode.ABRUPT]

    @property
    def capabilities(self) -> LensCapabilities:
        """True velocity; a stop that brakes at once, an abrupt one that costs the reference; no dead-man."""
        return LensCapabilities(
            native_velocity=True,
            abrupt_stop=False,
            stop_on_command=True,
            homing=True,
            stop_onset_ms=(self._latency.usual_ns + len(self.stop_bytes[StopMode.RAMPED]) * self._line.byte_ns)
            / NS_PER_MS,
            stop_onset_sigma_ms=self._latency.sigma_ns / NS_PER_MS,
            watchdog_ms=None,
        )

    # --- connecting ------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Identify the device, stop it if it moves, and read its settings."""
        self._identify()
        self._line.send(self.stop_bytes[StopMode.RAMPED])
        due = after_ms(self._clock.now_ns(), 20 * self._settings.reply_ms)
        while (reply := self._exchange("get pos")).busy:
            if self._clock.now_ns() >= due:
                raise LensError(f"lens port {self._line.name}: the motor does not stop; switch the device off and on")
        self._refuse_faults(reply.flag)
        self._referenced = reply.flag not in wire.NOT_REFERENCED
        self.limits = self._agreed_limits()
        if self._iris is not None:
            self._iris.meet()

    def referenced(self) -> bool:
        """Whether the device says that its position is referenced."""
        return self._referenced

    def _identify(self) -> None:
        """See that a Zaber device with firmware that is new enough answers."""
        for attempts_left in reversed(range(IDENTIFICATIONS)):
            self._line.read()
            self._line.send(b"\n")  # ends what another session has left half said
            try:
                version = self._exchange("get version").data
            except Trouble as trouble:
                if attempts_left == 0:
                    raise LensError(
                        f"lens port {self._line.name}: no answer from a Zaber device: {trouble}; check power, baud "
                        f"({self._settings.baud}), lens.device ({self._settings.device}) and lens.axis "
                        f"({self._settings.axis})"
                    ) from None
                continue
            numbers = tuple(int(part) for part in version.split(".") if part.isdigit())
            if numbers < OLDEST:
                raise LensError(
                    f"lens port {self._line.name}: firmware {version} answered, this driver needs "
                    f"{OLDEST[0]}.{OLDEST[1]} or newer; update it with Zaber's launcher"
                )
            return

    def _agreed_limits(self) -> LensLimits:
        """Take travel, speed and acceleration from the device and the config; refuse contradictions."""
        low, high = self._number("limit.min"), self._number("limit.max")
        speed_sps = self._number("maxspeed") / wire.SPEED_PER_SPS
        accel, decel = self._number("accel"), self._number("motion.decelonly")
        if accel <= 0 or accel != decel:
            raise ConfigError(
                f"lens: the device accelerates by {accel:g} and brakes by {decel:g} (its settings accel and "
                "motion.decelonly); set both to the same value above 0"
            )
        acceleration_sps2 = accel / wire.ACCELERATION_PER_SPS2
        settings, um = self._settings, self._settings.um_per_step
        wanted = limits_from(
            um,
            settings.min_um,
            high * um if settings.max_um is None else settings.max_um,
            speed_sps * um if settings.max_speed_um_s is None else settings.max_speed_um_s,
            acceleration_sps2 * um if settings.acceleration_um_s2 is None else settings.acceleration_um_s2,
        )
        for name, value, least, most in (
            ("min_um", wanted.min_steps * um, low * um, high * um),
            ("max_um", wanted.max_steps * um, low * um, high * um),
            ("max_speed_um_s", wanted.max_speed_sps * um, 0.0, speed_sps * um),
        ):
            if not least - 1e-6 <= value <= most * (1 + 1e-6) + 1e-6:
                raise ConfigError(f"lens.{name} is {value:g}, the device allows {least:g} to {most:g}; change it")
        if abs(wanted.acceleration_sps2 / acceleration_sps2 - 1) > 0.02:
            raise ConfigError(
                f"lens.acceleration_um_s2 is {wanted.acceleration_sps2 * um:g}, the device's accel makes "
                f"{acceleration_sps2 * um:g}; leave the key out, or change the device's setting"
            )
        return LensLimits(Steps(wanted.min_steps), Steps(wanted.max_steps), wanted.max_speed_sps, acceleration_sps2)

    def _number(self, setting: str) -> float:
        data = self._exchange(f"get {setting}").data
        try:
            return float(data)
        except ValueError:
            raise Trouble(f"the device's setting {setting} reads {data!r}, which is no number") from None

    # --- one command, one reply ------------------------------------------------------------------------------------

    def _frame(self, words: str, number: int | None = None) -> bytes:
        return wire.command(self._settings.device, self._settings.axis, words, number)

    def _next_number(self) -> int:
        self._numbers = (self._numbers + 1) % 100
        return self._numbers

    def _exchange(self, words: str, axis: int | None = None) -> wire.Reply:
        """Send a command and wait for its reply. Raises ``Trouble`` if it is refused or lost."""
        number = self._next_number()
        axis = self._settings.axis if axis is None else axis
        self._line.send(wire.command(self._settings.device, axis, words, number))
        due = after_ms(self._clock.now_ns(), self._settings.reply_ms)
        seen = ""
        while True:
            for line, _ in self._lines.feed(self._line.read()):
                seen = line
                reply = self._ours(line)
                if reply is not None and reply.number == number:
                    self._refuse_rejection(reply)
                    return reply
            if self._line.looked_ns >= due:
                raise Trouble(
                    f"no reply to {words!r} for {self._settings.reply_ms:.0f} ms (saw {seen[:60]!r}); check the cable"
                )
            self._clock.sleep_until(after_ms(self._clock.now_ns(), 0.5))

    def _ours(self, line: str) -> wire.Reply | None:
        """Read a line that is this lens's, or its iris's; once a reply had a checksum, all must."""
        reply = wire.parse_reply(line, checked_only=self._checked_only)
        ours = {0, self._settings.axis, 0 if self._iris is None else self._iris.axis}
        if reply is None or reply.device != self._settings.device or reply.axis not in ours:
            return None
        self._checked_only = self._checked_only or (reply.checked and reply.number is not None)
        return reply

    def _refuse_rejection(self, reply: wire.Reply) -> None:
        if not reply.accepted:
            words = wire.REJECTIONS.get(reply.data, "see its manual")
            raise Trouble(f"the device refused a command with {reply.data} ({words}), flag {reply.flag}; home it again")

    def _refuse_faults(self, flag: str, axis: int = 0) -> None:
        if flag.startswith("F"):
            words = wire.FAULT_WORDS.get(flag, "a fault")
            what = "the iris's axis" if self._iris is not None and axis == self._iris.axis else "the device"
            raise Trouble(f"{what} stopped itself: {words} (flag {flag}); remove the cause, home")

    # --- motion ----------------------------------------------------------------------------------------------------

    def go(self, target: int, speed_sps: float) -> Going:
        """Aim at a target at a speed: one command, whose reply ``read`` looks at."""
        if not self._referenced:
            raise LensError("lens: a Zaber device does not move before it has a reference; home it first")
        units = max(1, math.floor(speed_sps * wire.SPEED_PER_SPS + 1e-6))
        number = self._next_number()
        self._orders.add(number)
        sent = self._line.send(self._frame(f"move abs {target} {units}", number))
        motion = Motion(self.limits.acceleration_sps2, target_steps=float(target), speed_sps=units / wire.SPEED_PER_SPS)
        return Going(sent.begun_ns, sent.done_ns, [(sent.off_wire_ns, motion)])

    def stopped(self, mode: StopMode, sent: Sent, speed_sps: float) -> int:
        """Distrust the position after an abrupt stop in motion."""
        del sent
        if mode is StopMode.ABRUPT and speed_sps > 0.0:
            self._motor.referenced = False
        return 0

    # --- outputs ---------------------------------------------------------------------------------------------------

    @property
    def outputs(self) -> Sequence[str]:
        """The digital outputs, and an iris on another axis; a device without outputs, or with fewer, refuses."""
        return OUTPUTS if self._iris is None else (IRIS, *OUTPUTS)

    def switch(self, name: str, *, on: bool) -> Sent:
        """Switch a digital output, or send the iris on its way: one command, whose reply ``read`` looks at."""
        if self._iris is not None and name == IRIS:
            return self._iris.turn(opened=on)
        return self._order(0, f"io set do {name.removeprefix('do')} {int(on)}")

    def _order(self, axis: int, words: str) -> Sent:
        number = self._next_number()
        self._orders.add(number)
        return self._line.send(wire.command(self._settings.device, axis, words, number))

    # --- homing ----------------------------------------------------------------------------------------------------

    def begin_homing(self) -> None:
        """Let the device find its home sensor."""
        self._question = None
        self.asking.forget()
        self._referenced = False
        self._busy = self._exchange("home").busy

    def homing(self) -> bool:
        """Whether the device says that it is busy."""
        return self._busy

    def end_homing(self) -> None:
        """See that the device says that it is referenced."""
        flag = self._exchange("get pos").flag
        if flag in wire.NOT_REFERENCED:
            raise Trouble(f"homing ended without a reference (flag {flag}); look at the home sensor")
        self._referenced = True

    # --- queries and replies ---------------------------------------------------------------------------------------

    def ask(self) -> None:
        """Ask for the position; whether it moves and what is wrong comes with every reply."""
        self._question = self._next_number()
        self._asked_off_ns = self._line.send(self._frame("get pos", self._question)).off_wire_ns

    def read(self) -> Reading | None:
        """Take the lines that have come; a reply with another number is late, a duplicate, or an order's."""
        reading = None
        for line, behind in self._lines.feed(self._line.read()):
            reply = self._ours(line)
            if reply is None:
                continue
            self._refuse_faults(reply.flag, reply.axis)
            if reply.number is not None and reply.number == self._question:
                latest_ns = self._line.by_ns - (len(line) + 2 + behind) * self._line.byte_ns
                reading = self._position(reply, latest_ns) or reading
            elif reply.number in self._orders:
                self._orders.discard(reply.number)
                self._refuse_rejection(reply)
            else:
                self.asking.late()
        return reading

    def _position(self, reply: wire.Reply, latest_ns: int) -> Reading | None:
        self._question = None
        self.asking.answered()
        self._refuse_rejection(reply)
        if self._referenced and reply.flag in wire.NOT_REFERENCED:
            raise Trouble(f"the device has lost its reference (flag {reply.flag}): it restarted, or slipped; home it")
        try:
            steps = float(reply.data)
        except ValueError:
            return None
        self._busy = reply.busy
        limit = reply.flag == wire.LIMIT
        velocity = None if reply.busy else 0.0
        standing = limit and not reply.busy
        return Reading(steps, velocity, reply.busy, self._asked_off_ns, latest_ns, limit=limit, restart=standing)

    def believed(self, reading: Reading, report: LensReport) -> None:
        """Distrust the position when a limit sensor has ended a motion: it was not what it seemed."""
        del report
        if reading.restart and self._motor.rest_due_ns is not None:
            self._motor.referenced = False
