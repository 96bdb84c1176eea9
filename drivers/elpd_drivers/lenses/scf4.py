"""A lens on motor A of a Kurokesu SCF4, over its USB serial port. Untested on hardware.

The SCF4 knows moves of so many steps and a stop; so every motion is a bounded move, and a change of speed or direction
is a stop, standstill, and the next move. What its papers leave open is found out on the device, when it is homed
(``scf4_homing``): which word makes moves relative, and what the codes of ``M240`` mean. Until then it does not move.
Moves are relative, and for that reason never sent twice: one that was lost shows in the position.

The counter has 16 bits and wraps; it is unwrapped here. It has no switches: beyond a wrong reference stands the end of
the mechanism. The light of the photo-interrupters shines into some lenses, so it burns only while homing. Delays
(``G4``), during which not even a stop is heard, are never sent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import structlog

from elpd.errors import ConfigError, LensError
from elpd.motion.commanded import Motion
from elpd.motion.readings import Timing
from elpd.records import LensCapabilities, LensLimits, StopMode
from elpd.units import NS_PER_MS, after_ms
from elpd_drivers.lenses import scf4_wire as wire
from elpd_drivers.lenses.asking import Asking
from elpd_drivers.lenses.axis import limits_from
from elpd_drivers.lenses.direct import DirectLens, Going, Latency, Reading
from elpd_drivers.lenses.iris_axis import IRIS, iris_axis
from elpd_drivers.lenses.line import Sent, Trouble, open_on_line
from elpd_drivers.lenses.lines import LineReader
from elpd_drivers.lenses.motor import Motor
from elpd_drivers.lenses.scf4_homing import Homing, Seen
from elpd_drivers.lenses.scf4_iris import Scf4Iris

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping, Sequence

    from elpd.ports import BytePort, Clock
    from elpd.records import LensReport
    from elpd_drivers.lenses.line import Line
    from elpd_drivers.lenses.scf4_homing import Found

T = TypeVar("T")
_log = structlog.get_logger()

IDENTIFICATIONS = 3
KNOWN_FIRMWARE = "EVB.1."
LONGEST_COMMAND = 12
AT_ONCE_S = 1e-4
"""How long it takes to start or stop without a ramp, as far as anybody can tell."""


@dataclass(frozen=True, slots=True)
class Scf4Settings:
    """The table ``[lens]`` for an SCF4. 0 um is where the photo-interrupter changes.

    ``pi_above`` is what the photo-interrupter reads above that. ``relative`` ("G90" or "G91") and ``speed_scale``
    (steps per second, times the code of ``M240``) are found out when the lens is homed, unless given, and then checked.
    With ``trust_position``, which needs both, an earlier session's homing is good enough, as long as the board has had
    power since. With ``iris_axis`` another motor ("B" or "C") turns a stepper iris, which is the output "iris" then:
    between ``iris_closed`` (its closed stop) and ``iris_open``, steps, at ``iris_speed_sps``. ``acceleration_um_s2`` is
    how the lens starts and stops, if not at once. ``baud`` does not matter to the board. ``latency_us`` is the usual
    time from a command's last bit to its effect, USB included, and ``latency_sigma_us`` how well that is known; unless
    given, a real port gets what USB adapters need.
    """

    port: str = ""
    baud: int = 1_000_000
    um_per_step: float = 0.3125
    min_um: float = 0.0
    max_um: float = 2500.0
    max_speed_um_s: float = 4000.0
    acceleration_um_s2: float | None = None
    pi_above: int = 0
    relative: str = ""
    speed_scale: float | None = None
    trust_position: bool = False
    query_ms: float = 4.0
    reply_ms: float = 60.0
    latency_us: float = 300.0
    latency_sigma_us: float = 87.0
    iris_axis: str | None = None
    iris_closed: int = 0
    iris_open: int = 0
    iris_speed_sps: float = 0.0


def open_lens(settings: Mapping[str, Any], clock: Clock, port: BytePort | None = None) -> DirectLens:
    """Open and identify an SCF4. Nothing moves; what was moving is stopped.

    Raises ``ConfigError`` for a wrong table, ``LensError`` if there is no SCF4, or one with another firmware.
    """

    def build(table: Scf4Settings, line: Line) -> DirectLens:
        latency = Latency.from_us(table.latency_us, table.latency_sigma_us)
        timing = Timing(latency.usual_ns, latency.sigma_ns, quantum_steps=2.0, ramp_steps=1.0)
        motor = Motor(timing)
        controller = Scf4Controller(table, clock, line, motor, latency)
        return DirectLens(controller, line, motor, clock, latency, poll_ms=table.query_ms / 2)

    return open_on_line(Scf4Settings, settings, clock, port, build)


@dataclass(frozen=True, slots=True)
class _Wish:
    """A move that waits for standstill; ``stops`` is how many stops there were before."""

    target: int
    code: int
    stops: int


class Scf4Controller:
    """``direct.Controller`` for an SCF4. Use ``open_lens``."""

    abrupt_is_ramped = True

    def __init__(self, settings: Scf4Settings, clock: Clock, line: Line, motor: Motor, latency: Latency) -> None:
        self._settings, self._clock, self._line, self._motor = settings, clock, line, motor
        self._latency = latency
        self.limits = _limits(settings)
        self.asking = Asking(settings.query_ms, settings.reply_ms)
        self.stop_bytes: Mapping[StopMode, bytes] = dict.fromkeys(StopMode, wire.STOP)
        self.trouble_bytes = wire.STOP
        self.last_resort = wire.RESET_DRIVER
        # a move may wait for its speed to be set, and for standstill
        self.command_ns = LONGEST_COMMAND * line.byte_ns + round(4 * settings.query_ms * NS_PER_MS)
        self._relative, self._speed_scale = settings.relative, settings.speed_scale
        self._code: int | None = None
        self._lines = LineReader()
        self._count: int | None = None
        self._wish: _Wish | None = None
        self._braked_ns = 0
        self._asked_off_ns = 0
        self._errand: Generator[None, Seen, Found] | None = None
        self._trusted = False
        self._iris_axis = iris_axis(settings, wire.LENS_MOTOR, wire.MOTORS)
        self._iris = None if self._iris_axis is None else Scf4Iris(line, self._iris_axis)

    @property
    def capabilities(self) -> LensCapabilities:
        """Bounded moves only; a stop as soon as it is read, with the ramp that the config says; no dead-man."""
        return LensCapabilities(
            native_velocity=False,
            abrupt_stop=self._settings.acceleration_um_s2 is None,
            stop_on_command=True,
            homing=True,
            stop_onset_ms=(self._latency.usual_ns + len(wire.STOP) * self._line.byte_ns) / NS_PER_MS,
            stop_onset_sigma_ms=self._latency.sigma_ns / NS_PER_MS,
            watchdog_ms=None,
        )

    # --- connecting ------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Identify the board, stop motor A, and initialise the board unless an earlier session's work is trusted."""
        self._identify()
        was_moving = self._await_status().moving
        self._line.send(wire.STOP)
        due = after_ms(self._clock.now_ns(), 20 * self._settings.reply_ms)
        while (status := self._await_status()).moving:
            if self._clock.now_ns() >= due:
                raise LensError(f"lens port {self._line.name}: the motor does not stop; switch the board off and on")
        low, high = (wire.HOMED_COUNT + end for end in (self.limits.min_steps, self.limits.max_steps))
        inside = low <= status.count <= high and low > 0 and high < wire.WRAP
        self._trusted = self._settings.trust_position and inside and not was_moving
        if self._trusted:
            self._say(self._relative)
            self._set_speed(self._code_for(self.limits.max_speed_sps))
        else:
            self._line.send(wire.INITIALIZE)
            self._await(lambda line: True if line == "OK" else None, "$B2")
            self._relative, self._speed_scale = "", None
        self._count = None
        if self._iris is not None:
            self._iris.forget()

    def referenced(self) -> bool:
        """Whether an earlier session has homed the lens, and is trusted to have."""
        return self._trusted

    def _identify(self) -> None:
        for attempts_left in reversed(range(IDENTIFICATIONS)):
            self._line.read()
            self._line.send(wire.VERSION)
            try:
                firmware, model = self._await(wire.parse_version, "$S")
            except Trouble as trouble:
                if attempts_left == 0:
                    raise LensError(
                        f"lens port {self._line.name}: no answer from an SCF4: {trouble}; check its power, and that "
                        "this is its port"
                    ) from None
                continue
            if not firmware.startswith(KNOWN_FIRMWARE):
                raise LensError(
                    f"lens port {self._line.name}: {model} with firmware {firmware} answered, this driver knows "
                    f"{KNOWN_FIRMWARE}x; ask for support of it, with that line"
                )
            return

    def _await_status(self) -> wire.Status:
        self._line.send(wire.STATUS)
        return self._await(wire.parse_status, "!1")

    def _await(self, reads: Callable[[str], T | None], what: str) -> T:
        """Wait for a line that *reads* can read. Raises ``Trouble`` if none comes."""
        due = after_ms(self._clock.now_ns(), self._settings.reply_ms)
        seen = ""
        while True:
            for line, _ in self._lines.feed(self._line.read()):
                seen = line
                if (value := reads(line)) is not None:
                    return value
            if self._line.looked_ns >= due:
                raise Trouble(
                    f"no reply to {what} for {self._settings.reply_ms:.0f} ms (saw {seen[:60]!r}); check the cable"
                )
            self._clock.sleep_until(after_ms(self._clock.now_ns(), 0.5))

    # --- motion ----------------------------------------------------------------------------------------------------

    def go(self, target: int, speed_sps: float) -> Going:
        """Move now, if at rest; else stop, and move when that has come about, which ``believed`` sees."""
        if self._speed_scale is None or not self._relative:
            raise LensError("lens: how this SCF4 counts and how fast it is are found out by homing; home it first")
        wish = _Wish(target, self._code_for(speed_sps), self._motor.stops)
        if self._motor.under_way:
            sent = self._line.send(wire.STOP)
            self._braked_ns = sent.off_wire_ns + self._latency.usual_ns + 3 * self._latency.sigma_ns
            self._wish = wish
            return Going(sent.begun_ns, sent.done_ns, [(sent.off_wire_ns, Motion(self.limits.acceleration_sps2))])
        self._braked_ns = 0
        now = self._clock.now_ns()
        sent_now = self._take_step(wish)
        if sent_now is None:
            return Going(now, now, [])
        return Going(sent_now[0].begun_ns, sent_now[0].done_ns, [(sent_now[0].off_wire_ns, sent_now[1])])

    def stopped(self, mode: StopMode, sent: Sent, speed_sps: float) -> int:
        """Forget the move that waits."""
        del mode, sent, speed_sps
        self._wish = None
        return 0

    def _take_step(self, wish: _Wish) -> tuple[Sent, Motion] | None:
        """Move, unless there already. At rest only: the way is counted from where the motor stands."""
        self._set_speed(wish.code)
        assert self._count is not None, "a motor that rests was seen to"
        assert self._speed_scale is not None, "go has seen to it"
        self._wish = None
        way = wish.target - (self._count - wire.HOMED_COUNT)
        if way == 0:
            return None
        speed_sps = self._speed_scale / wish.code
        motion = Motion(self.limits.acceleration_sps2, target_steps=float(wish.target), speed_sps=speed_sps)
        return self._line.send(wire.order(f"G0 A{way}")), motion

    def _set_speed(self, code: int) -> None:
        """Have the speed set before anything else is said; the reply takes about a millisecond."""
        if code == self._code:
            return
        self._say(f"M240 A{code}")
        self._await(lambda line: True if line == "OK" else None, "M240")
        self._code = code
        if self.asking.open:  # what had been asked was answered before
            self.asking.answered()
            self.asking.soon()

    def _code_for(self, speed_sps: float) -> int:
        assert self._speed_scale is not None, "asked for before it was known"
        wanted = math.ceil(self._speed_scale / speed_sps - 1e-6)
        return min(max(wanted, wire.FASTEST_CODE), wire.SLOWEST_CODE)

    def _say(self, text: str) -> None:
        self._line.send(wire.order(text))

    # --- outputs ---------------------------------------------------------------------------------------------------

    @property
    def outputs(self) -> Sequence[str]:
        """A stepper iris on another motor, if there is one."""
        return () if self._iris is None else (IRIS,)

    def switch(self, name: str, *, on: bool) -> Sent:
        """Send the iris on its way, while the lens rests."""
        del name
        assert self._iris is not None, "there is no other output"
        assert self._iris_axis is not None, "they come together"
        if self._speed_scale is None or not self._relative:
            raise LensError("lens: how this SCF4 counts and how fast it is are found out by homing; home it first")
        if self._motor.under_way:
            raise LensError("lens: an SCF4's iris is turned while the lens rests only; wait until it stands")
        sent = self._iris.turn(self._code_for(self._iris_axis.speed_sps), self._relative, opened=on)
        now = self._clock.now_ns()
        return Sent(now, now, now) if sent is None else sent

    # --- homing ----------------------------------------------------------------------------------------------------

    def begin_homing(self) -> None:
        """Begin with the steps of ``Homing``, which ``read`` goes on with at each reading."""
        self._wish, self._code = None, None
        self.asking.forget()
        self._errand = Homing(
            self._say,
            self._recount,
            self.limits,
            interrupter_above=bool(self._settings.pi_above),
            relative=self._settings.relative,
            speed_scale=self._settings.speed_scale,
        ).run()
        next(self._errand)

    def homing(self) -> bool:
        """Whether there are steps left."""
        return self._errand is not None

    def end_homing(self) -> None:
        """Set the speed to the usual one, so that the next move need not wait."""
        self._set_speed(self._code_for(self.limits.max_speed_sps))

    def _recount(self) -> None:
        self._count = None

    # --- queries and replies ---------------------------------------------------------------------------------------

    def ask(self) -> None:
        """Ask for everything there is."""
        again = self.asking.open
        sent = self._line.send(wire.STATUS)
        if again:
            self.asking.asked_again()  # the answer may be to the first one, and as old
        else:
            self._asked_off_ns = sent.off_wire_ns

    def read(self) -> Reading | None:
        """Take the lines that have come; a status that nobody waits for is late, or a duplicate."""
        reading = None
        for line, behind in self._lines.feed(self._line.read()):
            if wire.refusal(line):
                raise Trouble(f"the board refused a command with {line[:60]!r}; home it again")
            status = wire.parse_status(line)
            if status is None or not self.asking.open:
                continue
            if self._iris is not None:
                self._iris.heed(line, self._asked_off_ns)
            self.asking.answered()
            latest_ns = max(self._line.by_ns - (len(line) + 2 + behind) * self._line.byte_ns, self._asked_off_ns)
            near = status.count if self._count is None else self._count
            count = wire.unwrapped(status.count, near)
            reading = Reading(
                float(count - wire.HOMED_COUNT),
                None if status.moving else 0.0,
                status.moving,
                self._asked_off_ns,
                latest_ns,
            )
            if self._errand is not None:
                self._count = count
                self._go_on(Seen(count, status.interrupter, status.moving, self._asked_off_ns, latest_ns))
        return reading

    def believed(self, reading: Reading, report: LensReport) -> None:
        """Take the count; let the move set out that waits for standstill."""
        del report
        if self._errand is not None:
            return
        self._count = round(reading.steps) + wire.HOMED_COUNT
        wish, stops = self._wish, self._motor.stops
        if wish is None or reading.moving or reading.earliest_ns < self._braked_ns or wish.stops != stops:
            return
        sent = self._take_step(wish)
        if sent is None:
            return
        self._motor.command(sent[1], sent[0].off_wire_ns + self._latency.usual_ns, self._latency.sigma_ns)
        if self._motor.stops != stops:
            self._line.send(wire.STOP)  # one came from another thread while this was on its way: it wins

    def _go_on(self, seen: Seen) -> None:
        assert self._errand is not None, "only while homing"
        try:
            self._errand.send(seen)
        except StopIteration as ended:
            found: Found = ended.value
            self._relative, self._speed_scale, self._errand = found.relative, found.speed_scale, None
            if not self._settings.trust_position:
                _log.warning(
                    "homing found out; with these in [lens] the lens needs to be homed once after power-up only",
                    trust_position=True,
                    relative=found.relative,
                    speed_scale=round(found.speed_scale),
                )


def _limits(settings: Scf4Settings) -> LensLimits:
    """Read the limits, and refuse what contradicts the board or itself."""
    ramp_um_s2 = settings.acceleration_um_s2
    if ramp_um_s2 is None:
        ramp_um_s2 = settings.max_speed_um_s / AT_ONCE_S
    limits = limits_from(settings.um_per_step, settings.min_um, settings.max_um, settings.max_speed_um_s, ramp_um_s2)
    if limits.max_steps - limits.min_steps > wire.LONGEST_MOVE:
        raise ConfigError(
            f"lens: a travel of {limits.max_steps - limits.min_steps} steps (lens.min_um to lens.max_um) is more than "
            f"the {wire.LONGEST_MOVE} that one move of an SCF4 can make; narrow it"
        )
    if not limits.min_steps <= 0 <= limits.max_steps:
        raise ConfigError("lens: min_um to max_um does not contain 0, the edge of the photo-interrupter; correct it")
    if settings.relative not in {"", "G90", "G91"} or settings.pi_above not in {0, 1}:
        raise ConfigError("lens: relative is G90 or G91 (or empty, to find out), pi_above is 0 or 1; correct them")
    scale = settings.speed_scale
    if scale is not None and not limits.max_speed_sps <= scale / wire.FASTEST_CODE:
        raise ConfigError(
            f"lens.max_speed_um_s is {settings.max_speed_um_s:g}; with lens.speed_scale {scale:g} the fastest is "
            f"{scale / wire.FASTEST_CODE * settings.um_per_step:g}"
        )
    if settings.trust_position and (scale is None or not settings.relative):
        raise ConfigError("lens.trust_position needs lens.relative and lens.speed_scale; homing checks what you give")
    return limits
