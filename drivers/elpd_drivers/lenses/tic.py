"""A lens on a Pololu Tic (T-series), over its TTL serial port.

Every motion is a *target position* under a speed limit, also the ones that ``run`` asks for: the board itself then
ends the motion inside the limits, even if this program dies in the middle of it, and its command timeout (the
"watchdog") ends it sooner. Speed changes and reversals in flight are the same command with another target, and the
board ramps through zero by itself. A stop is one byte (halt and hold), written at once from any thread.

After an abrupt halt the Tic says "position uncertain", because a halt may cost steps. Below the motor's start-stop
speed it does not, so the driver confirms the position it read at rest; above, the lens counts as unreferenced.

The time at which a position was sampled lies between the query's last byte on the wire and the reply's first one;
``elpd.motion.trajectory`` makes positions at any instant of it.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from elpd.errors import LensError
from elpd.motion.trajectory import REST, Motion, Timing, Trajectory
from elpd.records import CommandStamp, LensCapabilities, LensFlag, LensReport, StopMode
from elpd.units import NS_PER_MS, NS_PER_S, NS_PER_US, HostNs, after_ms
from elpd_drivers.lenses import tic_wire as wire
from elpd_drivers.lenses.axis import (
    ADAPTER_LATENCY_SIGMA_US,
    ADAPTER_LATENCY_US,
    check_speed,
    check_target,
    limits_from,
    read_settings,
    run_target,
)
from elpd_drivers.lenses.latched import LatchedPort
from elpd_drivers.lenses.tic_wire import crc7, encode, long_word, parse_reply, reply_length

if TYPE_CHECKING:
    from collections.abc import Mapping

    from elpd.ports import BytePort, Clock
    from elpd.records import LensLimits, PositionEstimate
    from elpd.units import Steps

IDENTIFICATIONS = 3
"""How often to ask who is there, before what answers counts as no Tic."""

LOOK_AHEAD_NS = 2 * NS_PER_MS
"""What a question and its answer take on the wire, and a little."""


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


def open_lens(settings: Mapping[str, Any], clock: Clock, port: BytePort | None = None) -> TicLens:
    """Open, identify and energize a Tic. Nothing moves; what was moving is halted.

    Raises ``ConfigError`` for a wrong table, ``LensError`` if there is no Tic.
    """
    table = read_settings(TicSettings, settings, "lens")
    if port is None:
        from elpd_drivers.lenses.serial_port import SerialPort  # noqa: PLC0415  (needs pyserial, in-memory use does not)

        port = SerialPort(table.port, table.baud)
        if "latency_us" not in settings:
            table = replace(table, latency_us=ADAPTER_LATENCY_US, latency_sigma_us=ADAPTER_LATENCY_SIGMA_US)
    lens = TicLens(table, clock, port)
    try:
        lens.connect()
    except BaseException:
        port.close()
        raise
    return lens


@dataclass(frozen=True, slots=True)
class _Query:
    sent_ns: int
    sampled_from_ns: int


class TicLens:
    """``elpd.ports.Lens`` on a Tic. Use ``open_lens``."""

    def __init__(self, settings: TicSettings, clock: Clock, port: BytePort) -> None:
        self._settings, self._clock, self._port = settings, clock, LatchedPort(port)
        self._limits = limits_from(
            settings.um_per_step,
            settings.min_um,
            settings.max_um,
            settings.max_speed_um_s,
            settings.acceleration_um_s2,
        )
        self._ramp_to_rest = Motion(self._limits.acceleration_sps2, rounding_steps=0.3)
        self._byte_ns = 10 * NS_PER_S // settings.baud
        sigma_ns = round(settings.latency_sigma_us * NS_PER_US)
        self._latency_ns, self._sigma_ns = round(settings.latency_us * NS_PER_US), sigma_ns
        self._trajectory = Trajectory(Timing(self._latency_ns, sigma_ns, sigma_ns, quantum_steps=1.0, ramp_steps=0.3))
        self._lock = threading.Lock()
        self._line_free_ns = 0
        self._received = bytearray()
        self._query: _Query | None = None
        self._unanswered_since_ns: int | None = None
        self._next_query_ns = 0
        self._report: LensReport | None = None
        self._status = 0
        self._errors = 0
        self._referenced = False
        self._halted_softly = False
        self._speed_sps = 0.0
        self._rest_due_ns: int | None = None
        self._rest_from_ns = 0
        self._look_ns: int | None = None
        self._stops = self._stops_ignored = 0
        self._implausible = 0
        self._stop_bytes = {
            StopMode.ABRUPT: self._frame(wire.HALT_AND_HOLD),
            StopMode.RAMPED: self._frame(wire.SET_TARGET_VELOCITY, long_word(0)),
        }
        get = self._frame(wire.GET_VARIABLE, bytes((0x22, 8)))
        self._query_head = len(self._frame(wire.RESET_TIMEOUT) + get)
        self._query_bytes = self._frame(wire.RESET_TIMEOUT) + get + self._frame(wire.GET_VARIABLE, bytes((0x01, 3)))
        self._reply_length = reply_length(crc=settings.crc_responses)

    # --- what the cycle sees ---------------------------------------------------------------------------------------

    @property
    def limits(self) -> LensLimits:
        """Travel and speed that nothing exceeds."""
        return self._limits

    @property
    def capabilities(self) -> LensCapabilities:
        """True velocity, a halt at once, a dead-man in the board."""
        return LensCapabilities(
            native_velocity=True,
            abrupt_stop=True,
            stop_on_command=True,
            homing=True,
            stop_onset_ms=(self._latency_ns + self._byte_ns) / NS_PER_MS,
            stop_onset_sigma_ms=self._sigma_ns / NS_PER_MS,
            watchdog_ms=self._settings.watchdog_ms,
        )

    def connect(self) -> None:
        """Identify the board, halt it if it moves, set its ramps, and take its first report."""
        self._identify()
        acceleration = long_word(round(self._limits.acceleration_sps2 * 100))
        setup = [(wire.SET_MAX_ACCELERATION, acceleration), (wire.SET_MAX_DECELERATION, acceleration)]
        setup.append((wire.SET_STARTING_SPEED, long_word(0)))
        for command, data in setup:
            self._send(self._frame(command, data))
        if any(self._ask(0x26, 4)):
            self._send(self._stop_bytes[StopMode.ABRUPT])
        self._send(self._frame(wire.ENERGIZE) + self._frame(wire.EXIT_SAFE_START))
        self._await_report(after_ms(self._clock.now_ns(), 4 * self._settings.reply_ms))
        self._referenced = not self._status & wire.UNCERTAIN

    def _identify(self) -> None:
        """See that a Tic answers; where what another session had asked for arrives first, ask again.

        Raises ``LensError`` after the last attempt.
        """
        for attempts_left in reversed(range(IDENTIFICATIONS)):
            self._port.read_available()
            try:
                state = self._ask(0x00, 9)
                step_mode = self._ask(0x49, 1)[0]
                supply_mv = int.from_bytes(self._ask(0x33, 2), "little")
            except LensError:
                if attempts_left == 0:
                    raise
                self._clock.sleep_until(after_ms(self._clock.now_ns(), self._settings.reply_ms))
            else:
                break
        if state[0] not in wire.OPERATION_STATES or step_mode > 9 or not 2_000 <= supply_mv <= 60_000:
            raise LensError(
                f"lens port {self._settings.port or '(in memory)'}: what answered is not a Tic: operation state "
                f"{state[0]}, step mode {step_mode}, supply {supply_mv} mV; check lens.board, baud and CRC settings"
            )

    def home(self, deadline: HostNs) -> LensReport:
        """Run to the reverse limit switch; position 0 is where it lets go."""
        self._port.check()
        self._prepare()
        self._referenced = self._halted_softly = False
        self._send(self._frame(wire.EXIT_SAFE_START) + self._frame(wire.GO_HOME, b"\0"))
        self._rest_due_ns = None
        seen, patience = False, after_ms(self._clock.now_ns(), 4 * self._settings.reply_ms)
        while True:
            now = self._clock.now_ns()
            if now >= deadline:
                raise self._trouble(
                    "homing did not end before its deadline; check the limit switch, or allow more time"
                )
            report = self._poll(fuse=False)
            homing = bool(self._status & wire.HOMING)
            seen = seen or homing
            if report and seen and not homing and not report.moving:
                break
            if not seen and now >= patience:
                raise self._trouble("the Tic did not start to home; set up a reverse limit switch in its settings")
            self._clock.sleep_until(after_ms(now, self._settings.query_ms))
        if self._status & wire.UNCERTAIN:
            raise self._trouble("homing ended without a certain position; look at the limit switch")
        self._referenced = True
        with self._lock:
            self._trajectory.begin(report)
        return self._flagged(report)

    def move_to(self, target: Steps, speed_sps: float) -> CommandStamp:
        """Start an absolute move."""
        stops = self._stops
        self._port.check()
        check_target(target, self._limits)
        check_speed(speed_sps, self._limits)
        if not self._referenced:
            raise LensError(f"lens: cannot move to {target} steps, its position is unknown; home it first")
        return self._go(target, abs(speed_sps), "move_to", stops)

    def run(self, velocity_sps: float, until: HostNs) -> CommandStamp:
        """Run at a signed velocity, ending at *until* or the limit: a target position that says both."""
        stops = self._stops
        self._port.check()
        check_speed(velocity_sps, self._limits)
        with self._lock:
            now = self._clock.now_ns()
            steps = self._trajectory.position_at(now).steps
            moving_sps = self._trajectory.velocity_at(now)
        spare_ns = until - now - self._latency_ns - 3 * self._sigma_ns - 14 * self._byte_ns
        target = run_target(steps, moving_sps, velocity_sps, spare_ns, self._limits, referenced=self._referenced)
        return self._go(target, abs(velocity_sps), "run", stops)

    def stop(self, mode: StopMode) -> CommandStamp:
        """Write the stop byte(s) now, from any thread; the books are kept afterwards."""
        self._stops += 1
        data = self._stop_bytes[mode]
        begun = self._clock.now_ns()
        self._port.write(data)
        done = self._clock.now_ns()
        with self._lock:
            effective = self._on_wire(len(data), begun) + self._latency_ns
            motion = REST if mode is StopMode.ABRUPT else self._ramp_to_rest
            if self._trajectory.known:
                speed = abs(self._trajectory.velocity_at(HostNs(effective)))
                if mode is StopMode.ABRUPT:
                    safe = speed * self._settings.um_per_step <= self._settings.start_stop_um_s
                    self._halted_softly = self._referenced = self._referenced and safe
                self._trajectory.command(motion, effective, self._sigma_ns)
                self._expect_rest(effective, 20 * NS_PER_MS)
        return CommandStamp(f"stop {mode.name.lower()}", begun, done)

    def poll(self) -> LensReport | None:
        """Ask when due, read what has come, return the newest report if there is a new one."""
        self._port.check()
        report = self._poll(fuse=True)
        return None if report is None else self._flagged(report)

    def position_at(self, when: HostNs) -> PositionEstimate:
        """Return where the motor was at *when*."""
        with self._lock:
            return self._trajectory.position_at(when)

    def close(self) -> None:
        """Halt if moving, and give the port back. Idempotent."""
        try:
            if self._report is None or self._report.moving or self._rest_due_ns is not None:
                self._port.write(self._stop_bytes[StopMode.ABRUPT])
        except LensError:
            pass  # the line is dead: the command timeout stops the motor
        self._port.close()

    # --- motion ----------------------------------------------------------------------------------------------------

    def _go(self, target: int, speed_sps: float, name: str, stops: int) -> CommandStamp:
        self._prepare()
        aim = self._frame(wire.SET_TARGET_POSITION, long_word(target))
        limit = self._frame(wire.SET_MAX_SPEED, long_word(max(1, round(speed_sps * 10_000))))
        motion = Motion(self._limits.acceleration_sps2, target_steps=float(target), speed_sps=speed_sps)
        # in motion the target goes first: another speed limit alone would accelerate towards the old target
        steps: list[tuple[bytes, Motion | None]]
        steps = [(aim, replace(motion, speed_sps=self._speed_sps)), (limit, motion)]
        if self._speed_sps == speed_sps:
            steps = [(aim, motion)]
        elif self._rest_due_ns is None:
            steps = [(limit, None), (aim, motion)]
        begun = self._clock.now_ns()
        self._port.write(b"".join(data for data, _ in steps))
        done = self._clock.now_ns()
        self._speed_sps = speed_sps
        with self._lock:
            for data, planned in steps:
                effective = self._on_wire(len(data), begun) + self._latency_ns
                if planned is not None:
                    self._trajectory.command(planned, effective, self._sigma_ns)
            self._expect_rest(effective, 50 * NS_PER_MS)
            self._stops_ignored = 0
        if self._stops != stops:
            self.stop(StopMode.ABRUPT)  # one came from another thread while this was on its way: it wins
        return CommandStamp(name, begun, done)

    def _expect_rest(self, effective: int, grace_ns: int) -> None:
        """Note when the motion ends by the model, when to look whether it has, and when it must have."""
        self._rest_from_ns = max(self._trajectory.at_rest_from() or effective, effective)
        self._look_ns = self._rest_from_ns + 3 * self._sigma_ns
        self._rest_due_ns = self._rest_from_ns + grace_ns

    def _prepare(self) -> None:
        """Clear what keeps an idle Tic from moving: its command timeout and the safe start that follows."""
        idle = self._report is None or self._clock.now_ns() - self._report.latest_ns > 200 * NS_PER_MS
        if self._errors or idle:
            self._send(self._frame(wire.ENERGIZE) + self._frame(wire.EXIT_SAFE_START))
            self._errors = 0

    # --- queries and replies ---------------------------------------------------------------------------------------

    def _poll(self, *, fuse: bool) -> LensReport | None:
        report = None
        now = self._clock.now_ns()
        self._received += self._port.read_available()
        if self._query and len(self._received) >= self._reply_length:
            report = self._parse(now, fuse=fuse)
        if self._unanswered_since_ns is not None:
            silence_ms = (now - self._unanswered_since_ns) / NS_PER_MS
            if silence_ms > self._settings.reply_ms:
                raise self._trouble(
                    f"no valid reply for {silence_ms:.0f} ms (limit {self._settings.reply_ms:.0f}); check the cable "
                    "and the CRC settings, or raise lens.reply_ms"
                )
        lost = self._query is not None and now - self._query.sent_ns > self._settings.reply_ms * NS_PER_MS / 4
        if lost or (self._query is None and self._due(now)):
            self._received.clear()
            begun = self._clock.now_ns()
            self._port.write(self._query_bytes)
            with self._lock:
                end = self._on_wire(len(self._query_bytes), begun)
            self._query = _Query(begun, end - (len(self._query_bytes) - self._query_head) * self._byte_ns)
            self._next_query_ns = begun + round(self._settings.query_ms * NS_PER_MS)
            if self._unanswered_since_ns is None:
                self._unanswered_since_ns = begun
        return report

    def _due(self, now: int) -> bool:
        """Ask at regular intervals, and as soon as the motor should rest: then somebody waits for the answer."""
        if self._look_ns is None or self._look_ns - now > LOOK_AHEAD_NS:
            return now >= self._next_query_ns
        if now < self._look_ns:
            return False  # an answer from before the rest would only keep the line from the one after it
        self._look_ns = None
        return True

    def _parse(self, now: int, *, fuse: bool) -> LensReport | None:
        query, self._query = self._query, None
        reply = parse_reply(bytes(self._received), crc=self._settings.crc_responses)
        self._received.clear()
        if reply is None or query is None or abs(reply.velocity_sps) > 2 * self._limits.max_speed_sps:
            return None  # the silence limit counts on; the next query resynchronises
        position, velocity, status, errors = reply.position, reply.velocity_sps, reply.flags, reply.errors
        latest = max(now - self._reply_length * self._byte_ns, query.sampled_from_ns)
        flags = LensFlag.MOVING if velocity else LensFlag.NONE
        # a moving motor is half a step beyond the last one that it made, on average
        steps = position + (0.5 if velocity > 0 else -0.5 if velocity < 0 else 0.0)
        report = LensReport(steps, HostNs(query.sampled_from_ns), HostNs(latest), velocity, flags)
        if fuse and not self._believe(report, status):
            self._next_query_ns = now
            return None
        self._unanswered_since_ns = None
        self._status, self._errors, self._report = status, errors, report
        self._watch_errors(errors, report)
        self._watch_reference(report, position)
        self._watch_motion(report)
        return report

    def _believe(self, report: LensReport, status: int) -> bool:
        """Learn from a report, unless it is impossible; raise when the impossible is confirmed."""
        with self._lock:
            if not self._trajectory.known or (status & (wire.FORWARD_LIMIT | wire.REVERSE_LIMIT) and not report.moving):
                self._trajectory.begin(report)
                self._implausible = 0
                return True
            surprise = self._trajectory.expect(report)
            limit = 8 * surprise.sigma_steps + 16
            if abs(surprise.steps) <= limit:
                self._implausible = 0
                self._trajectory.observe(report)
                return True
        self._implausible += 1
        if self._implausible >= 3:
            raise self._trouble(
                f"the controller reports a position {surprise.steps:+.0f} steps from where it must be "
                f"(limit {limit:.0f}), {self._implausible} times in a row; home it again"
            )
        return False

    def _watch_errors(self, errors: int, report: LensReport) -> None:
        """Raise for what a person must look at; an idle Tic's timeout is cleared before the next motion."""
        under_way = self._rest_due_ns is not None and report.latest_ns < self._rest_due_ns
        serious = errors & ~wire.RECOVERABLE
        if serious or (errors and under_way and not report.moving):
            words = ", ".join(word for bit, word in wire.ERROR_WORDS.items() if errors & bit)
            raise self._trouble(f"the Tic stopped itself: {words} (error bits {errors:#06x}); remove the cause, home")

    def _watch_reference(self, report: LensReport, position: int) -> None:
        if not self._status & wire.UNCERTAIN:
            return
        if not self._halted_softly:
            self._referenced = self._referenced and self._rest_due_ns is not None and report.moving
            return
        if not report.moving and report.earliest_ns > self._rest_from_ns:
            self._send(self._frame(wire.HALT_AND_SET_POSITION, long_word(position)))
            self._halted_softly = False

    def _watch_motion(self, report: LensReport) -> None:
        """See that what should be at rest by now is; else stop again, harder each time."""
        if self._rest_due_ns is None or report.earliest_ns < self._rest_due_ns:
            return
        if not report.moving:
            self._rest_due_ns, self._stops_ignored = None, 0
            return
        self._stops_ignored += 1
        if self._stops_ignored > 3:
            self._port.write(self._frame(wire.DEENERGIZE))
            raise self._trouble(
                f"the motor still runs at {report.velocity_sps or 0.0:.0f} steps/s after "
                f"{self._stops_ignored - 1} stops; its driver was switched off"
            )
        self._port.write(self._stop_bytes[StopMode.ABRUPT])

    def _flagged(self, report: LensReport) -> LensReport:
        flags = report.flags
        if self._referenced:
            flags |= LensFlag.REFERENCED
        if self._status & (wire.FORWARD_LIMIT | wire.REVERSE_LIMIT):
            flags |= LensFlag.LIMIT
        if not self._referenced:
            flags |= LensFlag.POSITION_UNCERTAIN
        return LensReport(report.steps, report.earliest_ns, report.latest_ns, report.velocity_sps, flags)

    # --- the wire --------------------------------------------------------------------------------------------------

    def _frame(self, command: int, data: bytes = b"") -> bytes:
        settings = self._settings
        return encode(command, data, device_number=settings.device_number, crc=settings.crc_commands)

    def _send(self, data: bytes) -> None:
        begun = self._clock.now_ns()
        self._port.write(data)
        with self._lock:
            self._on_wire(len(data), begun)

    def _on_wire(self, count: int, begun: int) -> int:
        """Return when the last of *count* bytes written at *begun* leaves the wire, behind those before it."""
        self._line_free_ns = max(self._line_free_ns, begun) + count * self._byte_ns
        return self._line_free_ns

    def _ask(self, offset: int, length: int) -> bytes:
        """Read variables, waiting for the reply within the limit."""
        self._received.clear()
        self._send(self._frame(wire.GET_VARIABLE, bytes((offset, length))))
        due = after_ms(self._clock.now_ns(), self._settings.reply_ms)
        expected = length + self._settings.crc_responses
        while True:
            self._received += self._port.read_available()
            now = self._clock.now_ns()
            if len(self._received) >= expected:
                break
            if now >= due:
                raise LensError(
                    f"lens port {self._settings.port or '(in memory)'}: no answer from a Tic within "
                    f"{self._settings.reply_ms:.0f} ms (received {bytes(self._received)!r}); check power, cable, baud "
                    f"({self._settings.baud}), device number and CRC settings"
                )
            self._clock.sleep_until(after_ms(now, 0.5))
        raw = bytes(self._received)
        self._received.clear()
        if len(raw) != expected or (self._settings.crc_responses and crc7(raw[:length]) != raw[length]):
            raise LensError(
                f"lens port {self._settings.port or '(in memory)'}: what answered is not a Tic: {raw[:40]!r} where "
                f"{expected} bytes were due; check lens.board, baud and CRC settings"
            )
        return raw[:length]

    def _await_report(self, due: HostNs) -> LensReport:
        while True:
            report = self._poll(fuse=True)
            if report is not None:
                return report
            now = self._clock.now_ns()
            if now >= due:
                raise self._trouble("no report after connecting; check the cable")
            self._clock.sleep_until(after_ms(now, 0.5))

    def _trouble(self, what: str) -> LensError:
        """Halt, latch, forget the reference; return what to raise."""
        self._referenced = False
        return self._port.trouble(what, self._stop_bytes[StopMode.ABRUPT], "halt")
