"""Taking the evidence on a live rig: rest, then there and back at two speeds, then pictures before and after a move.

The lens goes to and fro around where it stands, which should be in focus. Nothing is timed: every wait reads, every
move waits for the lens's own report of rest, and where the lens was is asked of its trajectory as soon as a motion is
over.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.calibrate.evidence import NO_EVENTS, Columns, Evidence, Pass, Rest, Step, Sweeps
from elpd.errors import UsageError
from elpd.events.stream import PacketDecoder
from elpd.focus.stage import REST_LIMIT_MS
from elpd.ports import Biases, HardwareRoi
from elpd.records import BiasSet
from elpd.units import SensorUs
from elpd.vision.ruler import Ruler

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from elpd.focus.stage import Stage
    from elpd.records import CameraPacket, Frame

SHARES_OF_SPEED = (1.0 / 8.0, 1.0 / 4.0)
"""The two speeds, of the sweep's: slow, so that lag and deafness are small against the width of the peak."""

ROUNDS = 3
"""There-and-backs that count, at each speed."""

STILL_FRAMES = 6
SETTLE_MS = 30.0
"""After a motion: the slowest photoreceptor has followed."""

FRAME_WAIT_MS = 200.0
PATH_STEP_US = 500
LEAST_REACH_DOF = 8.0
MOST_EVENTS = 1 << 26
"""A gigabyte of events: a sensor that sends more is seeing something else."""


class Capture:
    """Collects what a stage hears, and moves its lens.

    Parameters
    ----------
    stage
        With a running camera, biased by the caller or not at all.
    speed_um_s
        The speed at which this rig focuses.
    depth_of_focus_um, reach_um
        The lens goes *reach_um* to either side of where it stands.
    progress
        Told in a few words what is going on.
    """

    def __init__(
        self,
        stage: Stage,
        *,
        speed_um_s: float,
        depth_of_focus_um: float,
        reach_um: float,
        progress: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._stage = stage
        self._speed_um_s = speed_um_s
        self._depth_of_focus_um = depth_of_focus_um
        self._progress = progress
        self._decoder = PacketDecoder(stage.parts.camera.geometry)
        self._pieces: list[Columns] = []
        self._frames: list[Frame] = []
        self._count = 0
        self._reach_um = reach_um
        self._low_um = self._middle_um = self._high_um = stage.here_um()

    def _find_room(self) -> None:
        """Fix the ends of the way. Raises ``UsageError`` if there is not enough of it on either side."""
        stage, reach_um = self._stage, self._reach_um
        limits = stage.parts.lens.limits
        low, high = stage.to_um(limits.min_steps), stage.to_um(limits.max_steps)
        self._low_um, self._high_um = max(low, self._middle_um - reach_um), min(high, self._middle_um + reach_um)
        least_um = LEAST_REACH_DOF * self._depth_of_focus_um
        if min(self._middle_um - self._low_um, self._high_um - self._middle_um) < least_um:
            raise UsageError(
                f"the lens stands at {self._middle_um:.0f} um and may go from {low:.0f} to {high:.0f}, {reach_um:.0f} "
                f"to either side were asked for; at least {least_um:.0f} um ({LEAST_REACH_DOF:.0f} depths of focus) "
                "are needed on both sides of focus; aim at something nearer or further, or raise --reach-um"
            )

    def take(
        self, rest_s: float, brightness: NDArray[np.float32] | None, doubt: float = 0.0, black: float | None = None
    ) -> Evidence:
        """Take everything; *brightness*, its *doubt* and *black* as in ``Evidence``.

        Raises ``UsageError`` where the lens has no room, ``DeviceError`` from the rig.
        """
        self._find_room()
        stage = self._stage
        self._settle()
        stage.listener = self._keep
        try:
            rest = self._rest(rest_s)
            lost = stage.lost_events
            sweeps = tuple(self._sweeps(share * self._speed_um_s) for share in SHARES_OF_SPEED)
            steps = tuple(self._steps()) if stage.frame is not None else ()
        finally:
            stage.listener = None
        missing = {}
        if stage.lost_events > lost:
            missing["sweeps"] = missing["steps"] = _lost_on_the_way(stage.lost_events - lost)
            sweeps, steps = (), ()
        geometry = stage.parts.camera.geometry
        return Evidence(geometry, rest, sweeps, steps, brightness, doubt, black, None, stage.lost_events, missing)

    def sweeps_alone(self) -> Evidence:
        """Take the there-and-backs only. Raises as ``take`` does."""
        self._find_room()
        stage = self._stage
        self._settle()
        stage.listener = self._keep
        try:
            lost = stage.lost_events
            sweeps = tuple(self._sweeps(share * self._speed_um_s) for share in SHARES_OF_SPEED)
        finally:
            stage.listener = None
        missing = {}
        if stage.lost_events > lost:
            sweeps, missing = (), {"sweeps": _lost_on_the_way(stage.lost_events - lost)}
        return Evidence(stage.parts.camera.geometry, None, sweeps, lost_events=stage.lost_events, missing=missing)

    def rest_alone(self, rest_s: float, missing: dict[str, str]) -> Evidence:
        """Take what can be had without moving the lens. Raises ``DeviceError`` from the rig."""
        self._settle()
        self._stage.listener = self._keep
        try:
            rest = self._rest(rest_s)
        finally:
            self._stage.listener = None
        lost = self._stage.lost_events
        return Evidence(self._stage.parts.camera.geometry, rest, lost_events=lost, missing=missing)

    def _settle(self) -> None:
        stage, camera = self._stage, self._stage.parts.camera
        if isinstance(camera, HardwareRoi):
            camera.set_window(None)
        if isinstance(camera, Biases):
            camera.apply_biases(BiasSet.FOCUS)
        stage.rest(REST_LIMIT_MS)
        stage.wait_ms(SETTLE_MS)

    # --- parts ---

    def _rest(self, rest_s: float) -> Rest:
        self._progress(f"rest, {rest_s:g} s")
        begin_us = self._now_us()
        self._stage.wait_ms(1000.0 * rest_s)
        end_us = self._now_us()
        return Rest(self._taken(begin_us, end_us), begin_us, end_us)

    def _sweeps(self, speed_um_s: float) -> Sweeps:
        self._progress(f"there and back at {speed_um_s:.0f} um/s")
        self._go(self._low_um, speed_um_s)
        self._go(self._high_um, speed_um_s)
        self._go(self._low_um, speed_um_s)
        self._drop()
        begin_us = self._now_us()
        passes, paths = [], []
        for _ in range(ROUNDS):
            for target_um, sign in ((self._high_um, 1), (self._low_um, -1)):
                from_us = self._now_us()
                self._go(target_um, speed_um_s)
                to_us = self._now_us()
                passes.append(Pass(from_us, to_us, sign))
                paths.append(self._path(from_us, to_us))
        end_us = self._now_us()
        t_us, um = (np.concatenate(part) for part in zip(*paths, strict=True))
        kept = np.concatenate([[True], np.diff(t_us) > 0])
        path = Ruler.of_path(t_us[kept], um[kept])
        return Sweeps(speed_um_s, self._taken(begin_us, end_us), path, begin_us, end_us, tuple(passes))

    def _steps(self) -> list[Step]:
        """Take pictures in focus and beside it, and the events of the way between."""
        steps = []
        for share in SHARES_OF_SPEED:
            speed_um_s = share * self._speed_um_s
            self._progress(f"pictures before and after moves at {speed_um_s:.0f} um/s")
            self._go(self._low_um, speed_um_s)
            before = self._still()
            for target_um in (self._middle_um, self._low_um, self._middle_um, self._low_um):
                self._drop()
                begin_us = self._now_us()
                self._go(target_um, speed_um_s)
                end_us = self._now_us()
                after = self._still()
                if before is not None and after is not None:
                    events = self._taken(begin_us, end_us)
                    steps.append(Step(before, after, events, 1e-6 * (end_us - begin_us), speed_um_s))
                before = after
        self._go(self._middle_um, self._speed_um_s)
        return steps

    def _still(self) -> NDArray[Any] | None:
        """Return a stack of frames of the lens at rest, ``None`` if the camera sends no more."""
        self._frames.clear()
        self._stage.wait_ms(SETTLE_MS)
        since_us = self._now_us()
        waited = 0
        while waited < STILL_FRAMES:
            waited += 1
            self._stage.newest_frame(FRAME_WAIT_MS)
            fresh = [one for one in self._frames if one.t_us - one.exposure_us >= since_us]
            if len(fresh) >= STILL_FRAMES:
                break
        return np.stack([one.pixels for one in fresh]) if len(fresh) >= 2 else None

    # --- below ---

    def _go(self, target_um: float, speed_um_s: float) -> None:
        self._stage.move(target_um, speed_um_s)
        self._stage.wait_ms(SETTLE_MS)

    def _now_us(self) -> int:
        self._stage.learn_time()
        return int(self._stage.sensor_clock.to_sensor(self._stage.now_ns()))

    def _path(self, begin_us: int, end_us: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        grid = np.arange(begin_us, end_us, PATH_STEP_US, dtype=np.float64)
        return grid, np.array([self._stage.position_um(SensorUs(int(when))) for when in grid])

    def _keep(self, packet: CameraPacket) -> None:
        t_us, x, y, on = self._decoder.feed(packet)
        self._frames.extend(packet.frames)
        if t_us.size:
            self._pieces.append(Columns(t_us.copy(), x.copy(), y.copy(), on.copy()))
            self._count += t_us.size
        if self._count > MOST_EVENTS:
            raise UsageError(
                f"{self._count} events in one part of the calibration (limit {MOST_EVENTS}); "
                "lower --reach-um, or aim at less texture"
            )

    def _drop(self) -> None:
        self._pieces, self._count = [], 0
        self._frames.clear()

    def _taken(self, begin_us: int, end_us: int) -> Columns:
        """Return what came between two times and forget it, after having heard of the second."""
        self._stage.hear(REST_LIMIT_MS)
        every = NO_EVENTS
        if self._pieces:
            every = Columns(*(np.concatenate(part) for part in zip(*self._pieces, strict=True)))
            every = every.chosen(np.argsort(every.t_us, kind="stable"))
        self._drop()
        return every.between(begin_us, end_us)


def _lost_on_the_way(events: int) -> str:
    return (
        f"{events} events were lost on the way from the camera; close what else uses the machine, "
        "or aim at less texture"
    )
