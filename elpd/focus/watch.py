"""What a sweep's events say, while it runs and after it stopped.

While the lens moves two things are computed. Packets go through the fused kernel into ELP windows and windows into the
sequential detector: that is the direction. And the region's events build their own image, whose sharpness is followed
tick by tick of travel: that is the passing, because scene motion does not change sharpness, while it turns a product
with a stale picture negative. After the stop has been sent the witnesses of ``vision.crossing`` are asked where focus
was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from elpd.events.stream import PacketDecoder
from elpd.focus.passes import Pass, lens_path
from elpd.focus.resting import RestingScene
from elpd.records import Direction, ElpSample
from elpd.units import SensorUs
from elpd.vision.bearing import Bearing
from elpd.vision.crossing import (
    LAG_UNEXPLAINED,
    ROI_MARGIN_PX,
    WIDTHS_PER_DEPTH_OF_FOCUS,
    fuse,
)
from elpd.vision.detector import Detector
from elpd.vision.elp import ElpWindows
from elpd.vision.memory import EventMemory
from elpd.vision.meter import TRAVEL_PER_DEPTH_OF_FOCUS

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.records import CameraPacket, FocusEstimate, Frame, Geometry, Roi
    from elpd.vision.reference import Reference

REST_WINDOW_US = 1000
LOOK_BACK_DOF = 12.0
"""Losses this far back from the decision count against it: the witnesses look no further."""

TICK_DOF = 0.5
"""Travel between two looks at the sharpness of the image that the events build."""

PATIENCE_DOF = 8.0
"""How far beyond a sign change of ELP the image's sharpness may take to agree: a curve's width and a half."""

LAG_UNEXPLAINED_BY_MAP = 0.15
"""Share of the lag correction that may be wrong where a temporal map, taken through a small aperture and without
saturation, says which pixels are slow."""

FAR_DROP = 0.2
"""Fall of log sharpness beyond the peak before the stop: pixels with little contrast or light answer late, and their
answers are worth the few micrometres."""

SIGMAS_OF_PROBE = 5.0
"""What turns the first direction round: a false one costs a turn, and every micrometre the wrong way counts."""

SIGMAS_AFTER_REVERSAL = 9.0
"""A false reversal costs the most: the second needs this many standard deviations."""

SLOW_SHARE = 0.2
"""Windows with less than this share of the planned travel say little: the lens starts, stops or turns."""


class Rereference(Protocol):
    """How a newer frame becomes the reference."""

    def __call__(self, frame: Frame, /) -> Reference:
        """Return the weights of *frame* over the region."""
        ...


@dataclass(frozen=True, slots=True)
class WatchSettings:
    """What a watch needs to know of rig and taste."""

    speed_um_s: float
    depth_of_focus_um: float
    frames: bool = False
    """Whether the reference is a frame, whose bright and dark are blurred, and not a temporal map."""


class Watch:
    """Watches one region during a cycle.

    Parameters
    ----------
    reference
        Weights over the whole sensor, zero outside the region.
    roi, geometry
        The region and the sensor.
    settings
        Speed and depth of focus, which set the windows.
    locate
        Lens position in um at a sensor time.
    rereference
        Makes weights of a newer frame, for cameras that have frames.
    """

    def __init__(
        self,
        reference: Reference,
        roi: Roi,
        geometry: Geometry,
        settings: WatchSettings,
        locate: Callable[[SensorUs], float],
        rereference: Rereference | None = None,
    ) -> None:
        self._reference = reference
        self.roi = roi
        self._geometry = geometry
        self._settings = settings
        self._locate = locate
        self._rereference = rereference
        self._window_us = max(
            20, round(1e6 * TRAVEL_PER_DEPTH_OF_FOCUS * settings.depth_of_focus_um / settings.speed_um_s)
        )
        inside = np.zeros((geometry.height, geometry.width), np.bool_)
        inside[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width] = True
        self._inside = inside
        self._resting_windows = ElpWindows(reference.weights, inside, window_us=REST_WINDOW_US, rate_cap=True)
        self._resting = RestingScene(roi, geometry)
        self._windows: ElpWindows | None = None
        self._bearing: Bearing | None = None
        self._detector = Detector()
        self._decoder = PacketDecoder(geometry)
        self._memory = EventMemory(roi, geometry)
        self._ticked_um = self._here_um = float("nan")
        self._passed = False
        self._gaps_us: list[int] = []
        self._last_us = SensorUs(0)
        self._sign = 1
        self._begun_us = SensorUs(0)
        self._judge_from = float("-inf")
        self._samples: list[ElpSample] = []
        self._frames: list[Frame] = []
        self._passes: list[Pass] = []
        self.decided_us: SensorUs | None = None
        """When the window that decided was complete, on the sensor's clock."""
        self.events = 0
        """Events in the region since this direction of travel began."""
        self.events_in_cycle = 0
        """Events in the region since the watch was armed."""

    # --- before and during a sweep ---

    def rest(self, packet: CameraPacket) -> None:
        """Learn from a packet of a sensor that sees nothing move."""
        for row in self._resting_windows.feed(packet):
            duration_us = int(row["end_us"] - row["begin_us"])
            self._resting.take_window(int(row["elp"]), int(row["n_on"] + row["n_off"]), duration_us)
        self._resting.take(self._decoder.feed(packet), packet.frames)

    def armed(self) -> None:
        """Close the lesson of the resting sensor."""
        self._resting.close()

    @property
    def scene_moves(self) -> bool:
        """Whether the scene moved while the lens stood still."""
        return self._resting.moves

    @property
    def frame_period_us(self) -> float | None:
        """Time from one frame to the next, as seen so far; ``None`` if there were not two."""
        times = [int(frame.t_us) for frame in (*self._resting.frames, *self._frames)]
        return float(np.median(np.diff(times))) if len(times) > 1 else None

    @property
    def resting_rate_hz(self) -> float:
        """Events per second that noise makes in the region: what it sends at rest, unless the scene moved."""
        return 0.0 if self.scene_moves else 1e6 * self._resting.rate.events_per_us

    @property
    def resting_events(self) -> int:
        """How many events the resting rate was learnt from."""
        return self._resting.events

    def begin(self, sign: int, at_us: SensorUs, turned_at_um: float | None = None) -> None:
        """Begin a direction of travel: everything is judged afresh.

        *turned_at_um* is where a reversal was commanded. Until the lens has come back there the events say more about
        the way out (photoreceptors lag, comparators have hysteresis) than about the way back, and are not judged; and
        the verdict that led here was certain, so the opposite one must be more certain still.
        """
        self._memory = self._resting.image_at_start() if self._windows is None else self._gone_on_with()
        if self.scene_moves:
            self._bearing = Bearing(
                ROI_MARGIN_PX, pictured=self._memory.picture is not None, again=turned_at_um is not None
            )
        self._ticked_um = self._here_um = float("nan")
        self._passed = False
        if self._windows is None:
            self._windows = ElpWindows(self._reference.weights, self._inside, window_us=self._window_us, rate_cap=True)
        self._detector = Detector(
            self._resting.rate, recede_sigmas=SIGMAS_OF_PROBE if turned_at_um is None else SIGMAS_AFTER_REVERSAL
        )
        self._sign = sign
        self._judge_from = float("-inf") if turned_at_um is None else sign * turned_at_um
        self._begun_us = at_us
        self._samples = []
        self._frames = []
        self._passes = []
        self._gaps_us = []
        self.decided_us = None
        self.events = 0

    def feed(self, packet: CameraPacket) -> list[ElpSample]:
        """Judge one packet; return the windows it closed."""
        assert self._windows is not None, "begin() comes before feed()"
        self.keep(packet)
        samples = []
        needed_um = SLOW_SHARE * 1e-6 * self._settings.speed_um_s
        for row in self._windows.feed(packet):
            sample = self._located(row)
            samples.append(sample)
            self.events += sample.n_on + sample.n_off
            duration_us = sample.end_us - sample.begin_us
            if sample.begin_us < self._begun_us or self._sign * sample.travel_um < needed_um * duration_us:
                continue
            ticked = self._tick(sample, sample.position_um + 0.5 * sample.travel_um)
            if self._sign * sample.position_um < self._judge_from:
                continue
            self._detector.feed(sample)
            seen = self._detector.direction is Direction.APPROACHING or self._detector.mutation is not None
            if self._bearing is not None:
                if ticked:
                    self._bearing.look(self._memory.image())
                seen = self._bearing.direction is Direction.APPROACHING
            if seen and not self._passed and self._memory.peak_passed and self._memory.track.drop > FAR_DROP:
                self._passed = True
                self.decided_us = SensorUs(max(sample.end_us, self._last_us))
                self._keep_pass(self._settings.speed_um_s)
        self._samples += samples
        self.events_in_cycle += sum(sample.n_on + sample.n_off for sample in samples)
        for frame in packet.frames:
            self._take_frame(frame)
        return samples

    def keep(self, packet: CameraPacket) -> None:
        """Remember a packet's events for the estimate."""
        if packet.complete_until_us is not None:
            self._last_us = packet.complete_until_us
        if packet.gap_before:
            self._gaps_us.append(int(self._last_us))
        events = self._decoder.feed(packet)
        first = int(np.searchsorted(events.t, self._begun_us, side="left"))
        # A motor that brakes late goes far beyond what is of interest.
        take = self._memory.skim if self._passed else self._memory.add
        take(events.t[first:], events.x[first:], events.y[first:], events.p[first:])

    def _tick(self, sample: ElpSample, end_um: float) -> bool:
        """Follow the sharpness of the events' own image: once per ``TICK_DOF`` of travel. Say whether it was time."""
        if abs(end_um - self._ticked_um) < TICK_DOF * self._settings.depth_of_focus_um:
            return False
        self._ticked_um = self._here_um = end_um
        self._memory.advance(sample.end_us, self._sign * end_um)
        return True

    @property
    def passed(self) -> bool:
        """Whether focus has certainly been passed.

        The image has become as sharp as it gets and duller again, and its product with the reference, the ELP, has said
        that focus was ahead: by the coarse weights, which know the direction from far away.
        """
        return self._passed

    @property
    def direction(self) -> Direction:
        """Where focus lies, as far as the events have said.

        Once ELP has said "ahead", a change of its mind is no reason to turn round at once: with a picture from far away
        it comes some depths of focus early, and the sharpness of the image has the say.
        """
        if self._bearing is not None:
            return self._bearing.direction
        mutation = self._detector.mutation
        if mutation is not None and not self._passed:
            beyond_um = self._sign * (self._here_um - self._locate(SensorUs(mutation.decided_us)))
            if beyond_um < PATIENCE_DOF * self._settings.depth_of_focus_um:
                return Direction.APPROACHING
        return self._detector.direction

    @property
    def score(self) -> float:
        """The running evidence in standard deviations: positive while focus is ahead, negative once it is behind."""
        rally, drawdown = self._detector.approach_score, self._detector.recede_score
        return -drawdown if drawdown > rally else rally

    # --- after the stop ---

    def estimate(self) -> FocusEstimate | None:
        """Say where focus was, in um on the motor's ruler; ``None`` if no witness saw it.

        Asks the remembered events: milliseconds, after the stop has been sent.
        """
        if self.decided_us is None:
            return None
        unexplained = LAG_UNEXPLAINED if self._settings.frames else LAG_UNEXPLAINED_BY_MAP
        width_um = WIDTHS_PER_DEPTH_OF_FOCUS * self._settings.depth_of_focus_um
        witnesses = [
            witness
            for one in self._passes
            for witness in one.testify(
                lens_path(self._locate, one.begun_us, one.decided_us),
                self.roi,
                self._reference.brightness,
                unexplained,
                width_um,
                scene_moves=self.scene_moves,
            )
        ]
        found = fuse(witnesses)
        if found is None:
            return None
        sign = self._sign
        return replace(
            found,
            method="two_crossings" if len(self._passes) > 1 else found.method,
            focus_um=sign * found.focus_um,
            contributions=tuple((name, sign * at, sigma, share) for name, at, sigma, share in found.contributions),
        )

    @property
    def peak_um(self) -> float:
        """Where the image was sharpest, in the last pass."""
        track = self._memory.track
        return self._sign * track.positions[track.peak]

    @property
    def gap_near_crossing(self) -> bool:
        """Whether anything was lost in the last part of a pass, where the estimate comes from."""
        reach_um = LOOK_BACK_DOF * self._settings.depth_of_focus_um
        return any(
            one.decided_us - 1e6 * reach_um / one.speed_um_s <= gap <= one.decided_us
            for one in self._passes
            for gap in self._gaps_us
        )

    def events_within(self, from_um: float, to_um: float) -> int:
        """Return how many events the sweep saw between two places."""
        low, high = min(from_um, to_um), max(from_um, to_um)
        return sum(one.n_on + one.n_off for one in self._samples if low <= one.position_um <= high)

    def count(self, packet: CameraPacket) -> None:
        """Count the region's events of a packet that is not judged (the way back)."""
        assert self._windows is not None, "begin() comes before count()"
        for row in self._windows.feed(packet):
            self.events_in_cycle += int(row["n_on"] + row["n_off"])

    # --- a second pass ---

    def follow(self, packet: CameraPacket) -> None:
        """Let the region's events go on building their image, and count them, while the lens goes where it is sent."""
        assert self._windows is not None, "begin() comes before follow()"
        self.keep(packet)
        for row in self._windows.feed(packet):
            self.events_in_cycle += int(row["n_on"] + row["n_off"])

    def begin_again(self, speed_um_s: float, at_us: SensorUs, from_um: float) -> None:
        """Begin to pass focus a second time, in the same direction, at another speed.

        The image is gone on with; its sharpness is followed from *from_um* on, where the play has been taken up.
        """
        self._memory = self._gone_on_with()
        self._ticked_um = self._here_um = float("nan")
        self._begun_us, self._judge_from, self._passed = at_us, self._sign * from_um, False
        self._frames = []
        self._speed_again_um_s = speed_um_s

    def pass_again(self, packet: CameraPacket) -> None:
        """Follow the image's sharpness in a packet of the second pass."""
        assert self._windows is not None, "begin() comes before pass_again()"
        self.keep(packet)
        self._frames += packet.frames
        for row in self._windows.feed(packet):
            sample = self._located(row)
            self.events_in_cycle += sample.n_on + sample.n_off
            end_um = sample.position_um + 0.5 * sample.travel_um
            if sample.begin_us >= self._begun_us and self._sign * end_um >= self._judge_from:
                self._tick(sample, end_um)

    def passed_again(self) -> None:
        """End the second pass: what it saw testifies beside the first's."""
        self.decided_us = self._last_us
        self._keep_pass(self._speed_again_um_s)
        self._passed = True

    # --- pieces ---

    def _gone_on_with(self) -> EventMemory:
        """Return a new memory that goes on with the image so far.

        Built anew, it would begin with the negative of what the scene looked like where the lens turned, perhaps close
        to focus, and when the scene moves the difference of two sharp pictures is sharpest anywhere.
        """
        return EventMemory(self.roi, self._geometry, before=self._memory)

    def _keep_pass(self, speed_um_s: float) -> None:
        assert self.decided_us is not None
        self._passes.append(
            Pass(self._memory, tuple(self._frames), self._begun_us, self.decided_us, self._sign, speed_um_s)
        )

    def _located(self, row: Any) -> ElpSample:
        begin, end = SensorUs(int(row["begin_us"])), SensorUs(int(row["end_us"]))
        from_um, to_um = self._locate(begin), self._locate(end)
        return ElpSample(
            begin,
            end,
            int(row["elp"]),
            int(row["energy"]),
            int(row["n_on"]),
            int(row["n_off"]),
            int(row["n_capped"]),
            0.5 * (from_um + to_um),
            to_um - from_um,
        )

    def _take_frame(self, frame: Frame) -> None:
        self._frames.append(frame)
        if self._rereference is not None and self._windows is not None:
            self._reference = self._rereference(frame)
            self._windows.set_weights(self._reference.weights, self._inside)
