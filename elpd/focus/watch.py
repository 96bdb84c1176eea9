"""What a sweep's events say, while it runs and after it stopped.

While the lens moves only what decides is computed: packets go through the fused kernel into ELP windows, windows into
the sequential detector. Packets are kept as they came (a copy of their bytes, bounded). After the stop has been sent
there is time: the kept packets are decoded, cut to the region, put on the lens's path, and the witnesses of
``vision.crossing`` are asked where focus was.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from elpd.events.stream import PacketDecoder
from elpd.records import Direction, ElpSample
from elpd.units import SensorUs
from elpd.vision.crossing import (
    FLANK,
    LAG_UNEXPLAINED,
    ROI_MARGIN_PX,
    UNMEASURED_LAG_US,
    WIDTHS_PER_DEPTH_OF_FOCUS,
    EventStretch,
    Witness,
    ask_events,
    frame_witness,
    fuse,
)
from elpd.vision.detector import SIGMAS, Detector, RestingRate
from elpd.vision.elp import ElpWindows
from elpd.vision.filters import PixelCap
from elpd.vision.meter import TRAVEL_PER_DEPTH_OF_FOCUS
from elpd.vision.refractory import refractory_period_us
from elpd.vision.track import EventEnergy, FrameEnergy, PeakTrack

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from elpd.records import CameraPacket, FocusEstimate, Frame, Geometry, Roi
    from elpd.vision.reference import Reference

REST_WINDOW_US = 1000
KEEP_BYTES = 256 * 1024 * 1024
PATH_STEP_US = 250
"""The lens path is sampled this finely for the estimate: at 100 times gravity it bends by 0.03 um in that time."""

MIN_EVENTS = 1_000
TICKS_PER_DEPTH_OF_FOCUS = 4
LOOK_BACK_DOF = 12.0
"""The curve of sharpness is drawn this far back from the stop: a peak is five depths of focus wide."""

LAG_UNEXPLAINED_BY_MAP = 0.15
"""Share of the lag correction that may be wrong where a temporal map, taken through a small aperture and without
saturation, says which pixels are slow."""

FAR_DROP = 0.6
"""How far down the far side of the peak the witnesses look, in log S: about as far as the flank this side."""

SIGMAS_AFTER_REVERSAL = 9.0
"""A false reversal costs the most: the second needs this many standard deviations (``facts/detection.md`` §6)."""

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
        self._roi = roi
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
        self._resting = ElpWindows(reference.weights, inside, window_us=REST_WINDOW_US, rate_cap=True)
        self._rest_sums = [0, 0, 0]  # elp, events, us
        self._windows: ElpWindows | None = None
        self._rest = RestingRate()
        self._detector = Detector()
        self._fine_windows: ElpWindows | None = None
        self._fine_detector = Detector()
        self._decoder = PacketDecoder(geometry)
        self._kept: deque[CameraPacket] = deque()
        self._kept_bytes = 0
        self._gaps_us: list[int] = []
        self._last_us = SensorUs(0)
        self._sign = 1
        self._begun_us = SensorUs(0)
        self._judge_from = float("-inf")
        self._samples: list[ElpSample] = []
        self._frames: list[Frame] = []
        self.decided_us: SensorUs | None = None
        """When the window that decided was complete, on the sensor's clock."""
        self.events = 0
        """Events in the region since this direction of travel began."""
        self.events_in_cycle = 0
        """Events in the region since the watch was armed."""

    # --- before and during a sweep ---

    def rest(self, packet: CameraPacket) -> None:
        """Learn from a packet of a sensor that sees nothing move."""
        for row in self._resting.feed(packet):
            self._rest_sums[0] += int(row["elp"])
            self._rest_sums[1] += int(row["n_on"] + row["n_off"])
            self._rest_sums[2] += int(row["end_us"] - row["begin_us"])
        self._decoder.feed(packet)

    def armed(self) -> None:
        """Close the lesson of the resting sensor."""
        elp, events, us = self._rest_sums
        if us > 0:
            self._rest = RestingRate(elp / us, events / us)

    @property
    def resting_rate_hz(self) -> float:
        """Events per second that the region sends at rest."""
        return 1e6 * self._rest.events_per_us

    def begin(self, sign: int, at_us: SensorUs, turned_at_um: float | None = None) -> None:
        """Begin a direction of travel: everything is judged afresh.

        *turned_at_um* is where a reversal was commanded. Until the lens has come back there the events say more about
        the way out (photoreceptors lag, comparators have hysteresis) than about the way back, and are not judged; and
        the verdict that led here was certain, so the opposite one must be more certain still.
        """
        for packet in self._kept:  # the decoder's registers must not miss what lies between the directions
            self._decoder.feed(packet)
        self._kept.clear()
        self._kept_bytes = 0
        if self._windows is None:
            options: dict[str, Any] = {"window_us": self._window_us, "rate_cap": True}
            self._windows = ElpWindows(self._reference.weights, self._inside, **options)
            self._fine_windows = ElpWindows(self._reference.fine, self._inside, **options)
        self._detector = Detector(self._rest, recede_sigmas=SIGMAS if turned_at_um is None else SIGMAS_AFTER_REVERSAL)
        self._fine_detector = Detector()
        self._sign = sign
        self._judge_from = float("-inf") if turned_at_um is None else sign * turned_at_um
        self._begun_us = at_us
        self._samples = []
        self._frames = []
        self._gaps_us = []
        self.decided_us = None
        self.events = 0

    def feed(self, packet: CameraPacket) -> list[ElpSample]:
        """Judge one packet; return the windows it closed."""
        assert self._windows is not None, "begin() comes before feed()"
        assert self._fine_windows is not None
        self.keep(packet)
        samples = []
        needed_um = SLOW_SHARE * 1e-6 * self._settings.speed_um_s
        fine_rows = self._fine_windows.feed(packet)
        for row, fine in zip(self._windows.feed(packet), fine_rows, strict=True):
            sample = self._located(row)
            samples.append(sample)
            self.events += sample.n_on + sample.n_off
            duration_us = sample.end_us - sample.begin_us
            if sample.begin_us < self._begun_us or self._sign * sample.travel_um < needed_um * duration_us:
                continue
            if self._sign * sample.position_um < self._judge_from:
                continue
            self._detector.feed(sample)
            self._fine_detector.feed(replace(sample, elp=int(fine["elp"]), energy=int(fine["energy"])))
            if self.passed and self.decided_us is None:
                self.decided_us = SensorUs(max(sample.end_us, self._last_us))
        self._samples += samples
        self.events_in_cycle += sum(sample.n_on + sample.n_off for sample in samples)
        for frame in packet.frames:
            self._take_frame(frame)
        return samples

    def keep(self, packet: CameraPacket) -> None:
        """Keep a copy for the estimate; the oldest go when there are too many."""
        if packet.complete_until_us is not None:
            self._last_us = packet.complete_until_us
        if packet.gap_before:
            self._gaps_us.append(int(self._last_us))
        copy = replace(packet, data=packet.data.copy(), frames=(), triggers=())
        self._kept.append(copy)
        self._kept_bytes += copy.data.nbytes
        while self._kept_bytes > KEEP_BYTES:
            oldest = self._kept.popleft()
            self._kept_bytes -= oldest.data.nbytes
            self._decoder.feed(oldest)

    @property
    def passed(self) -> bool:
        """Whether the sign mutation is certain: focus has been passed.

        The fine weights see it first, near focus; they have no say before the coarse ones know that focus was ahead,
        because far from focus a lens inverts fine contrast.
        """
        if self._detector.mutation is not None:
            return True
        return self._detector.direction is Direction.APPROACHING and self._fine_detector.mutation is not None

    @property
    def direction(self) -> Direction:
        """Where focus lies, as far as the events have said."""
        return self._detector.direction

    @property
    def score(self) -> float:
        """The running evidence in standard deviations: positive while focus is ahead, negative once it is behind."""
        rally, drawdown = self._detector.approach_score, self._detector.recede_score
        return -drawdown if drawdown > rally else rally

    # --- after the stop ---

    def estimate(self) -> FocusEstimate | None:
        """Say where focus was, in um on the motor's ruler; ``None`` if no witness saw it.

        Decodes what was kept: milliseconds, after the stop has been sent.
        """
        stretch = self._stretch()
        if stretch is None:
            return None
        track = self._draw(stretch)
        if track is None:
            return None
        peak_um, end_um = track.positions[track.peak], self._far_side(track)
        said = ask_events(
            _until(stretch, end_um), track.positions[track.flank(FLANK)], peak_um, end_um, self._brightness()
        )
        unmeasured_lag_um = 1e-6 * UNMEASURED_LAG_US * self._settings.speed_um_s
        unexplained = LAG_UNEXPLAINED if self._settings.frames else LAG_UNEXPLAINED_BY_MAP
        width_um = WIDTHS_PER_DEPTH_OF_FOCUS * self._settings.depth_of_focus_um
        found = fuse([*self._ask_frames(), *said.witnesses(unmeasured_lag_um, unexplained, width_um)])
        if found is None:
            return None
        sign = self._sign
        return replace(
            found,
            focus_um=sign * found.focus_um,
            contributions=tuple((name, sign * at, sigma, share) for name, at, sigma, share in found.contributions),
        )

    @property
    def gap_near_crossing(self) -> bool:
        """Whether anything was lost in the last part of the sweep, where the estimate comes from."""
        if not self._gaps_us or self.decided_us is None:
            return False
        look_back_us = 1e6 * LOOK_BACK_DOF * self._settings.depth_of_focus_um / self._settings.speed_um_s
        return any(self.decided_us - look_back_us <= gap <= self.decided_us for gap in self._gaps_us)

    def events_within(self, from_um: float, to_um: float) -> int:
        """Return how many events the sweep saw between two places."""
        low, high = min(from_um, to_um), max(from_um, to_um)
        return sum(one.n_on + one.n_off for one in self._samples if low <= one.position_um <= high)

    def count(self, packet: CameraPacket) -> None:
        """Count the region's events of a packet that is not judged (the way back)."""
        assert self._windows is not None, "begin() comes before count()"
        for row in self._windows.feed(packet):  # fine windows rest: they are not judged any more
            self.events_in_cycle += int(row["n_on"] + row["n_off"])

    # --- pieces ---

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
        if self._fine_windows is not None:
            self._fine_windows.set_weights(self._reference.fine, self._inside)

    def _stretch(self) -> EventStretch | None:
        """Decode the kept packets: the region's events while the lens moved the right way, on its path."""
        roi, geometry = self._roi, self._geometry
        left, top = max(0, roi.x - ROI_MARGIN_PX), max(0, roi.y - ROI_MARGIN_PX)
        right = min(geometry.width, roi.x + roi.width + ROI_MARGIN_PX)
        bottom = min(geometry.height, roi.y + roi.height + ROI_MARGIN_PX)
        parts: list[tuple[NDArray[Any], ...]] = []
        while self._kept:
            events = self._decoder.feed(self._kept.popleft())
            inside = (events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)
            parts.append(
                (events.t[inside], events.x[inside] - left, events.y[inside] - top, events.p[inside])
            )
        self._kept_bytes = 0
        if not parts:
            return None
        t_us, x, y, on = (np.concatenate(column) for column in zip(*parts, strict=True))
        height, width = bottom - top, right - left
        moving = self._moving(t_us)
        keep = PixelCap(height, width).keep(t_us, x.astype(np.uint16), y.astype(np.uint16)) & moving
        t_us = np.ascontiguousarray(t_us[keep])
        if t_us.size < MIN_EVENTS:
            return None
        x, y = x[keep].astype(np.uint16), y[keep].astype(np.uint16)
        deaf_us = refractory_period_us(t_us, x, y, (height, width))
        return EventStretch(
            t_us,
            x,
            y,
            on[keep].astype(np.uint8),
            self._sign * self._path(t_us + round(deaf_us)),
            height,
            width,
            ROI_MARGIN_PX,
        )

    def _moving(self, t_us: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Mark the events of the stretch in which the lens moved in the direction of this sweep."""
        grid, path_um = self._grid(int(t_us[0]), int(t_us[-1])) if t_us.size else (np.zeros(1), np.zeros(1))
        forward = self._sign * np.diff(path_um) > SLOW_SHARE * 1e-6 * self._settings.speed_um_s * PATH_STEP_US
        steps = np.flatnonzero(forward)
        if steps.size == 0:
            return np.zeros(t_us.size, np.bool_)
        last = int(steps[-1])
        first = last
        while first > 0 and forward[first - 1]:
            first -= 1
        return np.asarray((t_us >= max(grid[first], self._begun_us)) & (t_us < grid[last + 1]))

    def _path(self, t_us: NDArray[np.int64]) -> NDArray[np.float64]:
        grid, path_um = self._grid(int(t_us[0]), int(t_us[-1]))
        return np.asarray(np.interp(t_us, grid, path_um))

    def _grid(self, begin_us: int, end_us: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        grid = np.arange(begin_us - PATH_STEP_US, end_us + 2 * PATH_STEP_US, PATH_STEP_US)
        path_um = np.array([self._locate(SensorUs(int(when))) for when in grid])
        return grid.astype(np.float64), path_um

    def _draw(self, stretch: EventStretch) -> PeakTrack | None:
        """Draw the curve of log sharpness of the image that the events built, over the last part of the sweep."""
        step_um = self._settings.depth_of_focus_um / TICKS_PER_DEPTH_OF_FOCUS
        end_um = float(stretch.position[-1])
        begin_um = max(float(stretch.position[0]), end_um - LOOK_BACK_DOF * self._settings.depth_of_focus_um)
        if end_um - begin_um < 4 * step_um:
            return None
        ticks_um = np.arange(begin_um, end_um + 0.5 * step_um, step_um)
        ends = np.searchsorted(stretch.position, ticks_um, side="right")
        energy = EventEnergy(stretch.height, stretch.width, stretch.margin)
        track = PeakTrack()
        taken = 0
        for tick_um, until in zip(ticks_um, ends, strict=True):
            part = slice(taken, int(until))
            energy.add(stretch.x[part], stretch.y[part], stretch.on[part])
            taken = int(until)
            track.add(int(stretch.t_us[max(0, taken - 1)]), float(tick_um), energy.measure())
        return track if track.positions[track.peak] > track.positions[track.flank(FLANK)] else None

    @staticmethod
    def _far_side(track: PeakTrack) -> float:
        """Return where the far side of the peak has said enough: what comes later only blurs the answer."""
        top = track.values[track.peak]
        for value, position in zip(track.values[track.peak :], track.positions[track.peak :], strict=True):
            if value < top - FAR_DROP:
                return position
        return track.positions[-1]

    def _ask_frames(self) -> list[Witness]:
        """Ask the frames of this sweep, where three or more saw focus come and go."""
        track = PeakTrack()
        energy = FrameEnergy(self._roi, ROI_MARGIN_PX)
        for frame in self._frames:
            if frame.t_us >= self._begun_us:
                track.add(int(frame.t_us), self._sign * self._locate(frame.t_us), energy.measure(frame.pixels))
        vertex = track.vertex() if track.passed else None
        if vertex is None:
            return []
        return [frame_witness(vertex, float(np.median(np.diff(track.positions))))]

    def _brightness(self) -> NDArray[np.float32]:
        roi, geometry = self._roi, self._geometry
        left, top = max(0, roi.x - ROI_MARGIN_PX), max(0, roi.y - ROI_MARGIN_PX)
        right = min(geometry.width, roi.x + roi.width + ROI_MARGIN_PX)
        bottom = min(geometry.height, roi.y + roi.height + ROI_MARGIN_PX)
        return np.ascontiguousarray(self._reference.brightness[top:bottom, left:right])


def _until(stretch: EventStretch, end_um: float) -> EventStretch:
    """Cut a stretch off at a position."""
    count = int(np.searchsorted(stretch.position, end_um, side="right"))
    return replace(
        stretch,
        t_us=stretch.t_us[:count],
        x=stretch.x[:count],
        y=stretch.y[:count],
        on=stretch.on[:count],
        position=stretch.position[:count],
    )
