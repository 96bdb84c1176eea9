"""What every phase of a cycle stands on: one way to wait, one way to rest, one set of counters.

Waiting is reading: while a lens moves or settles the camera goes on delivering, and whoever sleeps instead loses events
in its ring. So every wait of a cycle is ``Stage.read`` until a deadline, and the lens is polled each time round.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.errors import CameraError, LensError
from elpd.events.edges import EdgeReader
from elpd.focus.delays import Delays
from elpd.focus.shake import Shake
from elpd.ports import Latency, TakesMarks, TriggerInput
from elpd.timebase import SensorClock
from elpd.units import NS_PER_MS, HostNs, SensorUs, Steps, after_ms

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.focus.shedding import Shedding
    from elpd.ports import RigParts
    from elpd.records import CameraPacket, Frame, LensReport, Trigger

READ_TIMEOUT_S = 0.002
"""One turn of a wait; the lens is polled at least this often."""

REST_LIMIT_MS = 1500.0
"""No lens this is for rings or brakes longer; past it the lens does not obey."""

SET_OUT_MS = 100.0
"""A lens that was told to move and has not stirred for so long does not mean to."""

REPORT_UM = 1.0
"""Some controllers (GRBL) report micrometres, not steps."""

SILENCE_MS = 200.0
"""Outside a sweep a camera may take this long to speak (bias changes, windows) before it counts as lost."""


class Stage:
    """The rig during one cycle, with the sensor's clock, the newest frame and the counters."""

    def __init__(self, parts: RigParts) -> None:
        self.parts = parts
        self.scale = parts.scale
        latency_us = parts.camera.min_latency_us if isinstance(parts.camera, Latency) else 0.0
        self.sensor_clock = SensorClock(latency_us)
        self.frame: Frame | None = None
        self.report: LensReport | None = None
        self.packets = 0
        self.lost_events = 0
        self.lost_at_rest = 0
        """Of those, how many before the sensor at rest was known: they are missing in no sweep."""
        self.last_packet_ns = parts.clock.now_ns()
        self._heard = True
        self.listener: Callable[[CameraPacket], object] | None = None
        """Hears every packet that is read while a phase waits."""
        wired = isinstance(parts.lens, TakesMarks) and parts.lens.mark_channel is not None
        self._edges = EdgeReader() if wired else None
        self.marks = 0 if wired else None
        """How many position marks were believed; ``None`` where none are wired."""
        self.delays = Delays()
        """How old packets were."""
        self.shake = Shake()
        """What the camera's gyroscope says of the rig, where it has one."""
        self.shedding: Shedding | None = None
        """Lets packets go while too much waits; only a sweep cannot wait."""
        self.interrupt: Callable[[], None] | None = None
        """Asked before every read; raises to end the phase."""

    # --- time and place ---

    def now_ns(self) -> HostNs:
        """Return the host's time."""
        return self.parts.clock.now_ns()

    def to_um(self, steps: float) -> float:
        """Convert steps to um on the motor's ruler."""
        return self.scale.to_um(steps)

    def to_steps(self, um: float) -> Steps:
        """Convert um on the motor's ruler to the nearest step."""
        return self.scale.to_steps(um)

    @property
    def um_per_step(self) -> float:
        """How long a step is where the motor is now."""
        return self.scale.um_per_step_at(self.here_um()) if self.scale.table else self.scale.um_per_step

    def position_um(self, when: SensorUs) -> float:
        """Return where the motor was at a sensor time."""
        return self.to_um(self.parts.lens.position_at(self.sensor_clock.to_host(when)).steps)

    def here_um(self) -> float:
        """Return where the motor is now."""
        return self.to_um(self.parts.lens.position_at(self.now_ns()).steps)

    # --- waiting ---

    def read(self, timeout_s: float = READ_TIMEOUT_S) -> CameraPacket | None:
        """Read one packet, poll the lens once, keep the counters.

        Raises ``CameraError`` after 200 ms of silence, ``LensError`` from the lens, and whatever ``interrupt`` does.
        """
        if self.interrupt is not None:
            self.interrupt()
        packet = self.parts.camera.read(timeout_s)
        report = self.parts.lens.poll()
        if report is not None:
            self.report = report
        if packet is None:
            now = self.now_ns()
            silent_ms = (now - self.last_packet_ns) / NS_PER_MS
            if silent_ms > SILENCE_MS and self._heard:
                # Whoever was so far behind was this side: it has only now caught up with what had gathered.
                self.last_packet_ns = now
            elif silent_ms > SILENCE_MS:
                raise CameraError(
                    f"camera: no data for {silent_ms:.0f} ms (limit {SILENCE_MS:.0f}); check its cable and power"
                )
            self._heard = False
            return None
        self._heard = True
        if self.shedding is not None:
            packet = self.shedding.take(packet)
        self.packets += 1
        self.last_packet_ns = packet.received_ns
        self.lost_events += packet.lost_events
        if packet.complete_until_us is not None:
            self.sensor_clock.saw(packet.complete_until_us, packet.received_ns)
            self.delays.received(self.sensor_clock.to_host(packet.complete_until_us), packet.received_ns)
        if packet.frames:
            self.frame = packet.frames[-1]
        if packet.imu:
            self.shake.hear(packet.imu)
        if self._edges is not None:
            self._mark(self._edges.of(packet))
        if self.listener is not None:
            self.listener(packet)
        return packet

    def listen_for_marks(self) -> None:
        """Let the camera stamp the lens's position marks, where they are wired."""
        if self._edges is not None and isinstance(self.parts.camera, TriggerInput):
            self.parts.camera.enable_trigger(on=True)

    def _mark(self, edges: tuple[Trigger, ...]) -> None:
        """Tell the lens at what times it was at places it knows; before the camera has told its time nobody knows."""
        lens = self.parts.lens
        assert isinstance(lens, TakesMarks), "edges are read for such a lens only"
        if not self.sensor_clock.known:
            return
        for edge in edges:
            if edge.id == lens.mark_channel:
                self.marks = (self.marks or 0) + lens.mark(self.sensor_clock.to_host(edge.t_us))

    def rest(self, limit_ms: float, target: Steps | None = None) -> LensReport:
        """Wait until the lens rests; return the report that says so.

        One report of no motion at *target* says so, or two in a row of no motion at the same place. Of a lens that was
        sent elsewhere they must be so far apart that it is not just about to set out.
        Raises ``LensError`` if the lens is still moving after *limit_ms*.
        """
        deadline = after_ms(self.now_ns(), limit_ms)
        asked_ns = self.now_ns()
        before: LensReport | None = None
        while self.now_ns() < deadline:
            self.read()
            report = self.report
            if report is None or report is before or report.earliest_ns < asked_ns:
                continue
            if report.moving or before is None or report.steps != before.steps:
                before = report
            off_steps = 0.0 if target is None else abs(report.steps - target)
            if not report.moving and target is not None and off_steps < 1.0:
                return report
            near = self.to_um(off_steps) < REPORT_UM
            apart_ns = 0 if near else SET_OUT_MS * NS_PER_MS
            if not report.moving and report is not before and report.earliest_ns - before.earliest_ns >= apart_ns:
                return report
        where = "nowhere" if self.report is None else f"{self.to_um(self.report.steps):.1f} um"
        raise LensError(
            f"lens: not at rest within {limit_ms:.0f} ms (last report: {where}); "
            "check that it obeys STOP and that nothing else drives it"
        )

    def wait_ms(self, ms: float) -> None:
        """Let time pass, reading on."""
        until = after_ms(self.now_ns(), ms)
        while self.now_ns() < until:
            self.read(min(READ_TIMEOUT_S, (until - self.now_ns()) / 1e9))

    def within_limits_um(self, um: float) -> float:
        """Return the place nearest to *um* that the lens may go to."""
        limits = self.parts.lens.limits
        return min(max(um, self.to_um(limits.min_steps)), self.to_um(limits.max_steps))

    def send(self, target_um: float, speed_um_s: float) -> None:
        """Let the lens set out to a place; where its steps are short, no faster than it can step."""
        speed_sps = min(speed_um_s / self.um_per_step, self.parts.lens.limits.max_speed_sps)
        self.parts.lens.move_to(self.to_steps(target_um), speed_sps)

    def travel_limit_ms(self, target_um: float, speed_um_s: float) -> float:
        """Return how long the way from here to a place may take: three times what it should, ramps allowed for."""
        ramps_s = 2 * speed_um_s / max(self.to_um(self.parts.lens.limits.acceleration_sps2), 1.0)
        return 300.0 + 3000.0 * (abs(target_um - self.here_um()) / speed_um_s + ramps_s)

    def move(self, target_um: float, speed_um_s: float) -> LensReport:
        """Go to a place and wait until at rest there. The wait is bounded by the way and the speed."""
        limit_ms = self.travel_limit_ms(target_um, speed_um_s)
        self.send(target_um, speed_um_s)
        return self.rest(limit_ms, self.to_steps(target_um))

    def hear(self, limit_ms: float) -> None:
        """Read until the camera has spoken of the time after now: what follows may be judged by its silence.

        Raises ``CameraError`` if it has not within *limit_ms*.
        """
        begun_ns = self.now_ns()
        until = after_ms(begun_ns, limit_ms)
        while self.now_ns() < until:
            packet = self.read()
            if packet is None:
                continue
            spoken_us = packet.complete_until_us
            if self.sensor_clock.known and (spoken_us is None or self.sensor_clock.to_host(spoken_us) >= begun_ns):
                return
        raise CameraError(
            f"camera: it has not said how things are now for {self.elapsed_ms(begun_ns):.0f} ms (limit {limit_ms:.0f}; "
            f"its last packet came {(self.now_ns() - self.last_packet_ns) / NS_PER_MS:.0f} ms ago); "
            "check its cable and power"
        )

    def learn_time(self) -> None:
        """Read until the camera has told its time, which ties its stamps to the host's; at once where it has.

        Raises ``CameraError`` if it has not within 200 ms.
        """
        if not self.sensor_clock.known:
            self.hear(SILENCE_MS)

    def newest_frame(self, limit_ms: float) -> Frame | None:
        """Wait for a frame that was exposed after now; ``None`` if none came."""
        begun_us = None
        until = after_ms(self.now_ns(), limit_ms)
        while self.now_ns() < until:
            packet = self.read()
            if packet is None:
                continue
            if begun_us is None and self.sensor_clock.known:
                begun_us = self.sensor_clock.to_sensor(self.now_ns())
            for frame in packet.frames:
                if begun_us is not None and frame.t_us - frame.exposure_us // 2 >= begun_us:
                    return frame
        return None

    def elapsed_ms(self, since: HostNs) -> float:
        """Return the milliseconds since an instant."""
        return (self.now_ns() - since) / NS_PER_MS
