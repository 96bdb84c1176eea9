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

import threading
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from elpd.errors import LensError
from elpd.motion.trajectory import REST, Motion, Timing, Trajectory
from elpd.records import CommandStamp, LensCapabilities, LensFlag, LensReport, StopMode
from elpd.units import NS_PER_MS, NS_PER_S, NS_PER_US, HostNs, Steps, after_ms
from elpd_drivers.lenses.axis import (
    ADAPTER_LATENCY_SIGMA_US,
    ADAPTER_LATENCY_US,
    check_speed,
    check_target,
    limits_from,
    read_settings,
    run_target,
)
from elpd_drivers.lenses.grbl_handshake import GrblLensSettings, handshake
from elpd_drivers.lenses.grbl_lines import (
    ALARM_WORDS,
    CANCEL,
    ERROR_WORDS,
    RESET,
    STATUS,
    LineReader,
    Status,
    jog_line,
    parse_status,
)
from elpd_drivers.lenses.latched import LatchedPort

if TYPE_CHECKING:
    from collections.abc import Mapping

    from elpd.ports import BytePort, Clock
    from elpd.records import LensLimits, PositionEstimate

SEGMENT_S = 0.010


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
    table = read_settings(GrblLensSettings, settings, "lens")
    if port is None:
        from elpd_drivers.lenses.serial_port import SerialPort  # noqa: PLC0415  (needs pyserial, in-memory use does not)

        port = SerialPort(table.port, table.baud)
        if "latency_us" not in settings:
            table = replace(table, latency_us=ADAPTER_LATENCY_US, latency_sigma_us=ADAPTER_LATENCY_SIGMA_US)
    lens = GrblLens(table, clock, port)
    try:
        lens.connect()
    except BaseException:
        port.close()
        raise
    return lens


class GrblLens:
    """``elpd.ports.Lens`` on GRBL. Use ``open_lens``."""

    def __init__(self, settings: GrblLensSettings, clock: Clock, port: BytePort) -> None:
        self._settings, self._clock, self._port = settings, clock, LatchedPort(port)
        self._name = settings.port or "(in memory)"
        self._byte_ns = 10 * NS_PER_S // settings.baud
        self._lines = LineReader()
        self._lock = threading.Lock()
        self._line_free_ns = 0
        self._query_ns: int | None = None
        self._sampled_from_ns = 0
        self._unanswered_since_ns: int | None = None
        self._next_query_ns = 0
        self._read_ns = self._line_begun_ns = self._line_end_ns = 0
        self._unacknowledged: deque[int | None] = deque()
        self._status: Status | None = None
        self._report: LensReport | None = None
        self._wish: _Wish | None = None
        self._cruise_sps = 0.0
        self._stopping = False
        self._resetting = self._locked_by_stop = False
        self._referenced = False
        self._implausible = 0
        self._rest_due_ns: int | None = None
        self._stops = self._stops_ignored = 0
        self._limits = limits_from(settings.um_per_step, 0.0, 1.0, 1.0, 1.0)
        self._steps_per_mm = self._travel_mm = 0.0
        self._trajectory = self._new_trajectory()

    # --- what the cycle sees ---------------------------------------------------------------------------------------

    @property
    def limits(self) -> LensLimits:
        """Travel and speed that nothing exceeds: the config's, inside the board's."""
        return self._limits

    @property
    def capabilities(self) -> LensCapabilities:
        """No velocity mode, a stop that comes late, no dead-man: sweep past and return."""
        return LensCapabilities(
            native_velocity=False,
            abrupt_stop=False,
            stop_on_command=True,
            homing=True,
            stop_onset_ms=self._settings.stop_onset_ms,
            stop_onset_sigma_ms=self._settings.stop_onset_sigma_ms,
            watchdog_ms=None,
        )

    def connect(self) -> None:
        """Identify the board, stop it if it moves, read its settings, and take its first report."""
        board = handshake(self._port, self._clock, self._settings)
        self._limits, self._steps_per_mm, self._travel_mm = board.limits, board.steps_per_mm, board.travel_mm
        self._trajectory = self._new_trajectory()
        self._referenced = board.idle and self._settings.trust_position and not board.restarted
        due = after_ms(self._clock.now_ns(), 4 * self._settings.reply_ms)
        while self._poll(fuse=True) is None:
            self._wait(due, "no report after connecting; check the cable")

    def home(self, deadline: HostNs) -> LensReport:
        """Run GRBL's homing cycle (``$H``), return at rest beside the switch."""
        self._port.check()
        if self._report is not None and self._report.moving:
            self.stop(StopMode.RAMPED)
            self._await_idle(deadline)
        self._referenced, self._wish, self._rest_due_ns = False, None, None
        self._send(b"$H\n", None)
        self._query_ns = self._unanswered_since_ns = None
        while self._unacknowledged:
            self._take_lines(fuse=False)
            self._wait(deadline, "homing did not end before its deadline; check the limit switch, or allow more time")
        self._next_query_ns = 0
        report = None
        while report is None:
            report = self._poll(fuse=False)
            self._wait(deadline, "no report after homing; check the cable")
        if self._status is None or self._status.state != "Idle":
            raise self._trouble(f"homing ended in state {self._status.state if self._status else 'unknown'}")
        with self._lock:
            self._trajectory.begin(report)
        self._referenced, self._locked_by_stop = True, False
        return self._flagged(report)

    def move_to(self, target: Steps, speed_sps: float) -> CommandStamp:
        """Start an absolute move; first to standstill, if something else is under way."""
        self._port.check()
        check_target(target, self._limits)
        check_speed(speed_sps, self._limits)
        if not self._referenced:
            raise LensError(f"lens: cannot move to {target} steps, its position is unknown; home it first")
        return self._begin(_Wish(abs(speed_sps), target=int(target)), "move_to")

    def run(self, velocity_sps: float, until: HostNs) -> CommandStamp:
        """Jog towards a limit, or as far as the time until *until* allows; first to standstill, if moving otherwise."""
        self._port.check()
        check_speed(velocity_sps, self._limits)
        return self._begin(_Wish(velocity_sps, until_ns=until), "run")

    def stop(self, mode: StopMode) -> CommandStamp:
        """Write the stop byte now, from any thread. ``ABRUPT`` is a reset: the position is lost if in motion."""
        self._stops += 1
        self._wish = None
        data = RESET if mode is StopMode.ABRUPT else CANCEL
        if mode is StopMode.ABRUPT:
            self._resetting = self._locked_by_stop = True
        begun = self._clock.now_ns()
        self._port.write(data)
        done = self._clock.now_ns()
        with self._lock:
            self._note_stop(mode, begun)
        return CommandStamp(f"stop {mode.name.lower()}", begun, done)

    def poll(self) -> LensReport | None:
        """Ask when due, read what has come, take the next step of a reversal; return a new report if there is one."""
        self._port.check()
        report = self._poll(fuse=True)
        self._take_next_step()
        return None if report is None else self._flagged(report)

    def position_at(self, when: HostNs) -> PositionEstimate:
        """Return where the motor was at *when*."""
        with self._lock:
            return self._trajectory.position_at(when)

    def close(self) -> None:
        """Stop if moving, and give the port back. Idempotent."""
        try:
            if self._report is None or self._report.moving or self._rest_due_ns is not None:
                self._port.write(CANCEL)
        except LensError:
            pass  # the line is dead: the jog ends at its target
        self._port.close()

    # --- motion ----------------------------------------------------------------------------------------------------

    def _begin(self, wish: _Wish, name: str) -> CommandStamp:
        """Jog now if at rest; else cancel, and let ``poll`` jog when the motor stands."""
        now, stops = self._clock.now_ns(), self._stops
        if not self._busy():
            return self._jog(wish, name, stops)
        if wish.target is None and wish.speed_sps == self._cruise_sps and not self._stopping:
            due = self._rest_due_ns or now
            if due <= wish.until_ns:
                return CommandStamp(name, now, now)  # already running so, and ending in time
        stamp = CommandStamp(name, now, now) if self._stopping else self.stop(StopMode.RAMPED)
        self._wish = wish
        return CommandStamp(name, stamp.begun_ns, stamp.done_ns)

    def _busy(self) -> bool:
        return self._rest_due_ns is not None or bool(self._unacknowledged)

    def _jog(self, wish: _Wish, name: str, stops: int) -> CommandStamp:
        if self._status is not None and self._status.state == "Alarm":
            raise LensError("lens: GRBL is locked (Alarm), its position is unknown; home it first")
        now = self._clock.now_ns()
        with self._lock:
            steps = self._trajectory.position_at(now).steps
        target = wish.target
        if target is None:
            spare_ns = wish.until_ns - now - 15 * NS_PER_MS  # the line's own time, and the planner's
            target = run_target(steps, 0.0, wish.speed_sps, spare_ns, self._limits, referenced=self._referenced)
        if target == round(steps):
            return CommandStamp(name, now, now)
        speed_sps = abs(wish.speed_sps)
        line = jog_line(target / self._steps_per_mm - self._travel_mm, speed_sps / self._steps_per_mm * 60)
        begun = self._clock.now_ns()
        with self._lock:
            effective = self._on_wire(len(line), begun) + 2 * NS_PER_MS
            motion = Motion(self._limits.acceleration_sps2, 0.0, float(target), speed_sps, SEGMENT_S)
            number = self._trajectory.command(motion, effective, 2 * NS_PER_MS)
            self._rest_due_ns = (self._trajectory.at_rest_from() or effective) + 100 * NS_PER_MS
        self._unacknowledged.append(number)
        self._port.write(line)
        done = self._clock.now_ns()
        self._cruise_sps, self._stopping, self._stops_ignored = wish.speed_sps, False, 0
        if self._stops != stops:
            self.stop(StopMode.RAMPED)  # one came from another thread while this was on its way: it wins
        return CommandStamp(name, begun, done)

    def _note_stop(self, mode: StopMode, begun: int) -> None:
        sent = self._on_wire(1, begun)
        if not self._trajectory.known:
            return
        if mode is StopMode.ABRUPT:
            moving = self._busy() or (self._report is not None and self._report.moving)
            self._referenced = self._referenced and not moving
            self._unacknowledged.clear()
            self._trajectory.command(REST, sent + 20 * NS_PER_US, 50 * NS_PER_US)
            self._rest_due_ns = sent + 50 * NS_PER_MS
        elif not self._stopping and self._busy():
            onset_ns = round(self._settings.stop_onset_ms * NS_PER_MS)
            braking = Motion(self._limits.acceleration_sps2, segment_s=SEGMENT_S)
            ending = self._trajectory.at_rest_from()
            if ending is None or ending > sent + onset_ns:
                sigma_ns = self._settings.stop_onset_sigma_ms * NS_PER_MS
                self._trajectory.command(braking, sent + onset_ns, sigma_ns)
            self._rest_due_ns = (self._trajectory.at_rest_from() or sent + onset_ns) + 60 * NS_PER_MS
        self._stopping = True

    def _take_next_step(self) -> None:
        stops = self._stops
        if self._wish is None or self._busy():
            return
        wish, self._wish = self._wish, None
        self._jog(wish, "run", stops)

    # --- queries and replies ---------------------------------------------------------------------------------------

    def _poll(self, *, fuse: bool) -> LensReport | None:
        report = self._take_lines(fuse=fuse)
        now = self._clock.now_ns()
        if self._unanswered_since_ns is not None:
            silence_ms = (now - self._unanswered_since_ns) / NS_PER_MS
            if silence_ms > self._settings.reply_ms:
                raise self._trouble(
                    f"no valid status report for {silence_ms:.0f} ms (limit {self._settings.reply_ms:.0f}); check the "
                    "cable, or raise lens.reply_ms"
                )
        lost = self._query_ns is not None and now - self._query_ns > self._settings.reply_ms * NS_PER_MS / 3
        if lost or (self._query_ns is None and now >= self._next_query_ns):
            self._port.write(STATUS)
            with self._lock:
                self._sampled_from_ns = self._on_wire(1, now)
            self._query_ns = now
            self._next_query_ns = now + round(self._settings.query_ms * NS_PER_MS)
            if self._unanswered_since_ns is None:
                self._unanswered_since_ns = now
        return report

    def _take_lines(self, *, fuse: bool) -> LensReport | None:
        """Read and act on every complete line; return the newest report."""
        data = self._port.read_available()
        before, now = self._read_ns, self._clock.now_ns()
        self._read_ns = now
        newest = None
        for line, bytes_after in self._lines.feed(data):
            # when the line's first byte can have left the board, at the latest
            length_ns = (len(line) + 2) * self._byte_ns
            begun = now - length_ns - bytes_after * self._byte_ns
            if line.startswith("<"):
                status = parse_status(line)
                newest = (self._take_status(status, begun, fuse=fuse) if status else None) or newest
            elif line == "ok":
                # not before the last look at the port, unless it had to wait behind the line before it
                earliest = before - length_ns
                if earliest < self._line_end_ns:
                    earliest = self._line_begun_ns
                self._acknowledged(earliest, begun)
            else:
                self._heed(line)
            self._line_begun_ns, self._line_end_ns = begun, begun + length_ns
        return newest

    def _acknowledged(self, earliest: int, latest: int) -> None:
        """Take an ``ok``: the jog was planned just before it was sent."""
        if not self._unacknowledged:
            return
        number = self._unacknowledged.popleft()
        if number is None:
            return
        width = max(latest - earliest, 0)
        with self._lock:
            self._trajectory.amend(number, latest - width // 2, max(width / 12**0.5, 100 * NS_PER_US))
            if not self._stopping:
                self._rest_due_ns = (self._trajectory.at_rest_from() or latest) + 100 * NS_PER_MS
        if self._stopping:
            self._port.write(CANCEL)  # the first one may have come before there was anything to cancel

    def _heed(self, line: str) -> None:
        """Act on what the board says by itself."""
        if line.startswith("ALARM:"):
            if self._resetting:
                return
            raise self._trouble(f"GRBL raised {line} ({ALARM_WORDS.get(line[6:], 'unknown')}); clear the cause, home")
        if line.startswith("error:"):
            if self._unacknowledged:
                self._unacknowledged.popleft()
            words = ERROR_WORDS.get(line[6:], "unknown")
            raise self._trouble(f"GRBL refused a command with {line} ({words}); compare its $$ with the config")
        if "Grbl" in line or "GrblHAL" in line:
            if not self._resetting:
                raise self._trouble("the board restarted by itself (its banner came); check its supply, then home")
            self._resetting = False

    def _take_status(self, status: Status, begun: int, *, fuse: bool) -> LensReport | None:
        if self._query_ns is None:
            return None  # late or duplicate: its instant of sampling is unknown
        self._query_ns = None
        if status.state == "Alarm" and self._busy() and not self._locked_by_stop and not self._unacknowledged:
            raise self._trouble("GRBL fell into Alarm during a motion; clear the cause, home")
        moving = status.state in {"Jog", "Run", "Home", "Hold:1"}
        velocity = None if moving else 0.0
        earliest = self._sampled_from_ns
        report = LensReport(
            (status.x_mm + self._travel_mm) * self._steps_per_mm,
            HostNs(earliest),
            HostNs(max(begun, earliest)),
            velocity,
            LensFlag.MOVING if moving else LensFlag.NONE,
        )
        if fuse and not self._believe(report):
            self._next_query_ns = 0
            return None
        self._unanswered_since_ns = None
        self._status, self._report = status, report
        self._watch_motion(report)
        return report

    def _believe(self, report: LensReport) -> bool:
        """Learn from a report, unless it is impossible; raise when the impossible is confirmed."""
        with self._lock:
            if not self._trajectory.known:
                self._trajectory.begin(report)
                return True
            if self._resetting:
                return False
            surprise = self._trajectory.expect(report)
            limit = 8 * surprise.sigma_steps + 32
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

    def _watch_motion(self, report: LensReport) -> None:
        """Believe in rest when it is reported; stop again, harder each time, what should be at rest by now."""
        if self._rest_due_ns is None:
            return
        with self._lock:
            planned = self._trajectory.at_rest_from()
        if not report.moving and not self._unacknowledged and (planned is None or report.earliest_ns > planned):
            self._rest_due_ns, self._stopping, self._stops_ignored = None, False, 0
            return
        if not report.moving or report.earliest_ns < self._rest_due_ns:
            return
        self._stops_ignored += 1
        if self._stops_ignored > 3:
            raise self._trouble(f"the motor still runs after {self._stops_ignored - 1} stops; the board was reset")
        self._port.write(CANCEL)
        self._stopping = True

    def _flagged(self, report: LensReport) -> LensReport:
        flags = report.flags | (LensFlag.REFERENCED if self._referenced else LensFlag.POSITION_UNCERTAIN)
        if self._status is not None and "X" in self._status.pins:
            flags |= LensFlag.LIMIT
        if self._status is not None and self._status.state == "Alarm":
            flags |= LensFlag.ALARM
        return LensReport(report.steps, report.earliest_ns, report.latest_ns, report.velocity_sps, flags)

    def _new_trajectory(self) -> Trajectory:
        sigma_ns = round(self._settings.latency_sigma_us * NS_PER_US)
        quantum = 0.001 * self._steps_per_mm
        reply_ns = round(self._settings.latency_us * NS_PER_US)
        return Trajectory(
            Timing(reply_ns, sigma_ns, sigma_ns // 2, quantum, rest_quantum_steps=quantum, ramp_steps=1.5),
            floor_steps=0.3,
        )

    def _await_idle(self, deadline: HostNs) -> Status:
        while True:
            self._poll(fuse=self._trajectory.known)
            if self._status is not None and self._status.state in {"Idle", "Alarm"} and self._rest_due_ns is None:
                return self._status
            self._wait(deadline, "the motor did not come to rest; look at the board")

    # --- the wire --------------------------------------------------------------------------------------------------

    def _send(self, line: bytes, number: int | None) -> None:
        with self._lock:
            self._on_wire(len(line), self._clock.now_ns())
        self._unacknowledged.append(number)
        self._port.write(line)

    def _on_wire(self, count: int, begun: int) -> int:
        """Return when the last of *count* bytes written at *begun* leaves the wire, behind those before it."""
        self._line_free_ns = max(self._line_free_ns, begun) + count * self._byte_ns
        return self._line_free_ns

    def _wait(self, deadline: HostNs, why: str) -> None:
        now = self._clock.now_ns()
        if now >= deadline:
            raise self._trouble(why)
        self._clock.sleep_until(after_ms(now, 1))

    def _trouble(self, what: str) -> LensError:
        """Reset the board, latch, forget the reference; return what to raise."""
        self._wish = None
        self._referenced = False
        return self._port.trouble(what, RESET, "reset")
