"""A recorded sweep, shown to the detector as if it were happening.

Events and frames are handed over in the order of time and nothing looks ahead: a recording cut at ``decided_us`` gives
the same answer. The parts are those of the live cycle (meter, detector, witnesses); what is different is that no lens
has to be stopped, so the search may go on past the sign mutation until focus is known as well as it is going to be,
and reports when that was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from elpd.focus import guards
from elpd.focus.settings import MAX_SIGMA_DOF
from elpd.records import Direction, FocusEstimate, Outcome
from elpd.vision.crossing import ROI_MARGIN_PX
from elpd.vision.detector import Detector
from elpd.vision.filters import PixelCap
from elpd.vision.memory import MIN_EVENTS, EventMemory
from elpd.vision.meter import TRAVEL_PER_DEPTH_OF_FOCUS, Meter, Windows, WindowsByEvents, WindowsByTravel
from elpd.vision.reference import Reference, check_size, reference_from_frame
from elpd.vision.track import FrameEnergy, PeakTrack
from elpd.vision.witness import WIDTHS_PER_DEPTH_OF_FOCUS, Witness, frame_witness, fuse

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.record.layouts import RecordedSweep
    from elpd.records import ElpSample, Roi, SensorProfile
    from elpd.vision.ruler import Ruler

_PIECE = 1 << 18
_RETRY_EVERY = 4

_PATIENCE_US = 60_000
_RESTLESS = 4.0
"""In a scene that moves (windows scatter more than twice as widely as still ones), frames are the better witness: they
are waited for a little longer than the slowest usual frame rate would take."""

_FRAMES_AFTER_US = 50_000
"""Frames this long after the last event still belong to the record; later ones show what no event has seen."""
_START_US = 1_000
"""A frame this shortly after the first event still shows what the events began from."""

_PATIENT_DROP = 0.2
"""Frames that have passed their peak wait this long, in log S, for ELP to change its sign too."""


@dataclass(frozen=True, slots=True)
class Detection:
    """What was found in a recorded sweep; times in microseconds of the sensor's clock, ``None`` where unknown."""

    outcome: Outcome
    reason: str
    direction: Direction
    direction_decided_us: int | None = None
    elp_crossing_us: int | None = None
    focus_us: int | None = None
    sigma_us: int | None = None
    decided_us: int | None = None
    method: str = "crossing"
    events: int = 0
    windows: int = 0
    focus: FocusEstimate | None = None
    warnings: tuple[str, ...] = ()
    depths_us: tuple[int, ...] = ()
    """When the lens passed the focus of each plane of the region, if several were seen, in order."""


class SweepSearch:
    """Looks for focus in one recorded sweep.

    Parameters
    ----------
    sweep:
        Events and frames.
    roi:
        Where to focus; must fit the sensor.
    ruler:
        Where the lens was.
    depth_of_focus_um:
        Sets the windows' travel and the limit of confidence, where the ruler is in micrometres.
    begin_us:
        Earlier events are not part of the sweep.
    reference:
        A picture that is there from the start.
    sensor:
        What a calibration knows of the sensor.
    max_sigma_dof:
        The standard error, in depths of focus that the caller told, above which there is no FOCUSED.
    """

    def __init__(
        self,
        sweep: RecordedSweep,
        roi: Roi,
        ruler: Ruler,
        *,
        depth_of_focus_um: float | None = None,
        begin_us: int | None = None,
        reference: Reference | None = None,
        sensor: SensorProfile | None = None,
        max_sigma_dof: float = MAX_SIGMA_DOF,
    ) -> None:
        self._sweep = sweep
        self._max_sigma_dof = max_sigma_dof
        self._roi = roi
        self._ruler = ruler
        self._depth_of_focus_um = depth_of_focus_um if ruler.in_um else None
        self._begin_us = int(sweep.t_us[0]) if begin_us is None else begin_us
        self._reference = reference
        self._sharpest = reference
        """Which picture tells bright pixels from dark ones: blur hides how dark the dark ones are."""
        self._start: NDArray[np.float32] | None = None
        windows: Windows = WindowsByEvents.for_roi(roi)
        if self._depth_of_focus_um is not None:
            windows = WindowsByTravel(ruler, TRAVEL_PER_DEPTH_OF_FOCUS * self._depth_of_focus_um)
        cap = PixelCap(sweep.geometry.height, sweep.geometry.width)
        for x, y in sensor.hot_pixels if sensor is not None else ():
            cap.silence(x, y)
        self._meter = Meter(roi, windows, self._begin_us, ruler, cap)
        self._detector = Detector()
        self._frames = PeakTrack()
        self._frame_energy = FrameEnergy(roi, ROI_MARGIN_PX, follow=True)
        self._first = int(np.searchsorted(sweep.t_us, self._begin_us, side="left"))
        self._memory = EventMemory(roi, sweep.geometry, sensor=sensor)
        self._attempts = 0
        self._attempts_until = 0
        self._width: float | None = None
        self._doubtful: Detection | None = None
        self._blank = 0
        """Frames so far without structure, none with."""

    def run(self) -> Detection:
        """Go through the recording until focus is found or it ends."""
        if self._reference is not None:
            if not self._reference.textured:
                return self._flat(self._begin_us)
            self._meter.set_reference(self._reference)
        done = self._first
        last_us = int(self._sweep.t_us[-1]) + _FRAMES_AFTER_US
        for frame in self._sweep.frames:
            if frame.t_us > last_us:
                break
            until = int(np.searchsorted(self._sweep.t_us, frame.t_us, side="left"))
            found = self._events(done, max(done, until), frame.t_us if frame.t_us > self._begin_us else None)
            if found is None:
                done = max(done, until)
                found = self._frame(frame.t_us, frame.load())
            if found is not None:
                return found
        found = self._events(done, self._sweep.t_us.size, None)
        return found or self._ended()

    def _events(self, begin: int, end: int, complete_until_us: int | None) -> Detection | None:
        """Show events ``begin .. end`` piece by piece; *complete_until_us* is the frame that comes after them."""
        sweep = self._sweep
        for start in range(begin, max(end, begin + 1), _PIECE):
            part = slice(start, min(start + _PIECE, end))
            events = sweep.t_us[part], sweep.x[part], sweep.y[part], sweep.on[part]
            self._memory.add(*events)
            promise_us = complete_until_us if part.stop == end else None
            for sample in self._meter.feed(*events, promise_us):
                self._detector.feed(sample)
                self._memory.advance(sample.end_us, self._ruler.position(sample.end_us))
                if self._detector.samples >= self._attempts_until:
                    found = self._attempt(sample.end_us)
                    if found is not None:
                        return self._closed_by(found, sample, complete_until_us)
        return None

    def _closed_by(self, found: Detection, sample: ElpSample, complete_until_us: int | None) -> Detection:
        """Date a decision to the event or frame that closed its window: what a cut recording must still hold."""
        after = int(np.searchsorted(self._sweep.t_us, sample.end_us, side="left"))
        closing = int(self._sweep.t_us[after]) if after < self._sweep.t_us.size else sample.end_us
        if complete_until_us is not None:
            closing = min(closing, complete_until_us)
        return replace(found, decided_us=closing)

    def _frame(self, t_us: int, pixels: NDArray[np.generic]) -> Detection | None:
        check_size(pixels.shape, self._sweep.geometry, f"frame of {t_us} us")
        reference = reference_from_frame(pixels, self._roi)
        if self._reference is None and not reference.textured:
            self._blank += 1  # too dark, or too far out of focus yet: the events go on without it
        else:
            self._blank = 0
            self._reference = reference
            self._meter.set_reference(reference)
            if self._sharpest is None or reference.scale_px <= self._sharpest.scale_px:
                self._sharpest = reference
        if not len(self._frames) and t_us <= self._begin_us + _START_US:
            self._start = reference.brightness
        if t_us < self._begin_us:
            return None
        exposed = self._ruler.position(t_us - self._sweep.frame_age_us)
        self._frames.add_sharpness(t_us, exposed, self._frame_energy.measure(pixels))
        found = self._attempt(t_us)
        return None if found is None else replace(found, decided_us=t_us)

    def _frames_are_coming(self, now_us: int) -> bool:
        """Whether there are frames often enough to draw a curve: three so far, and none has failed to come.

        Frames without any structure draw none: they do not keep the events from answering.
        """
        times = self._frames.times_us
        return not self._blank and len(times) >= 3 and now_us - times[-1] <= 2.0 * float(np.median(np.diff(times)))

    def _frames_are_too_coarse(self) -> bool:
        """Whether frames have seen focus go by and yet have no vertex: the lens is too fast for them to draw a top."""
        return self._frames.passed and self._frames.focus() is None

    def _frames_may_come(self, now_us: int) -> bool:
        """Whether a camera that has sent one frame or two may yet show that it sends more."""
        times = self._frames.times_us
        return 0 < len(times) < 3 and now_us - times[-1] < _PATIENCE_US and self._detector.overdispersion > _RESTLESS

    def _attempt(self, now_us: int) -> Detection | None:
        witnesses: list[Witness] = []
        if self._frames_are_coming(now_us) and not self._frames_are_too_coarse():
            if not self._frames.passed or self._frames.times_us[-1] != now_us:
                return None
            vertex = self._frames.focus()
            if vertex is None or (self._detector.likely_crossing_us is None and self._frames.drop < _PATIENT_DROP):
                return None
            spacing = float(np.median(np.abs(np.diff(self._frames.positions))))
            witnesses.append(frame_witness(vertex, spacing))
        elif not self._image_peak_passed() or self._frames_may_come(now_us):
            return None
        # An attempt costs many windows' worth of work, so the longer it goes on in vain, the rarer it gets.
        self._attempts += 1
        self._attempts_until = self._detector.samples + max(_RETRY_EVERY, self._attempts)
        brightness = None if self._sharpest is None else self._sharpest.brightness
        said, self._width = self._memory.witnesses(now_us, self._ruler, brightness, self._start)
        if self._memory.depths:
            witnesses = []  # of several planes frames show a mixture
        witnesses += said
        estimate = fuse(witnesses)
        if estimate is None:
            return None
        # A depth of focus that was told is kept to as in a cycle; one that is read off the curve is itself rough.
        limit = self._width_of(witnesses) / WIDTHS_PER_DEPTH_OF_FOCUS
        if self._depth_of_focus_um is not None:
            limit = self._max_sigma_dof * self._depth_of_focus_um
        return self._decide(estimate, limit, now_us)

    def _image_peak_passed(self) -> bool:
        """Whether the events' own image has peaked, and ELP says so too, unless the fall is beyond doubt."""
        if not self._memory.peak_passed:
            return False
        agreed = self._reference is None or self._detector.mutation is not None
        return agreed or self._memory.track.drop > _PATIENT_DROP

    def _width_of(self, witnesses: list[Witness]) -> float:
        frames = self._frames.focus() if witnesses and witnesses[0].name == "frames" else None
        if frames is not None:
            return frames.finest.width
        return self._width or float("inf")

    def _decide(self, estimate: FocusEstimate, limit: float, now_us: int) -> Detection | None:
        found = self._report(Outcome.FOCUSED, "", estimate, now_us)
        if estimate.sigma_um > limit:
            self._doubtful = replace(
                found,
                outcome=Outcome.LOW_CONFIDENCE,
                reason=f"the witnesses leave one standard deviation of {found.sigma_us} us, more than the depth of "
                "focus allows; sweep more slowly, or give frames or a larger region",
            )
            return None
        if found.direction is not Direction.APPROACHING and self._on_the_first_way(now_us):
            # Without a picture the direction is only known once focus has gone by; and shaking may have misled ELP.
            found = replace(found, direction=Direction.APPROACHING, direction_decided_us=now_us)
        names = ", ".join(f"{name} {weight:.0%}" for name, _, _, weight in estimate.contributions)
        return self._warned(replace(found, reason=f"focus was passed; measured by {names}"), now_us)

    def _warned(self, found: Detection, now_us: int) -> Detection:
        """Add what the events of the sweep warn of."""
        depths_us = tuple(round(self._ruler.time_of(at, now_us)) for at in self._memory.depths)
        told = guards.of_late_lamp(self._memory.flicker())
        if depths_us:
            times = ", ".join(str(one) for one in depths_us)
            told.append(f"the region holds several depths, in focus at {times} us; the first met is reported")
        return replace(found, warnings=tuple(told), depths_us=depths_us)

    def _on_the_first_way(self, now_us: int) -> bool:
        """Whether the lens has not turned yet: a focus that was passed then lay ahead, whatever ELP said first."""
        set_out_us, _, _ = self._ruler.stretch(now_us)
        _, until_us, sign = self._ruler.stretch(self._begin_us)
        return set_out_us <= self._begin_us or (sign == 0.0 and set_out_us <= until_us)

    def _report(self, outcome: Outcome, reason: str, estimate: FocusEstimate | None, now_us: int | None) -> Detection:
        detector = self._detector
        direction, direction_us = self._direction()
        focus_us = sigma_us = None
        if estimate is not None and now_us is not None:
            focus = self._ruler.time_of(estimate.focus_um, now_us)
            speed = self._ruler.speed_at(focus) or float("nan")
            focus_us, sigma_us = round(focus), max(1, round(estimate.sigma_um / speed))
        crossing_us = detector.crossing_us if estimate is None else detector.likely_crossing_us
        return Detection(
            outcome,
            reason,
            direction,
            direction_us,
            crossing_us,
            focus_us,
            sigma_us,
            now_us,
            "crossing" if estimate is None else estimate.method,
            detector.events,
            detector.samples,
            estimate,
        )

    def _direction(self) -> tuple[Direction, int | None]:
        first = self._detector.first
        return (Direction.UNKNOWN, None) if first is None else (first.direction, first.decided_us)

    def _flat(self, t_us: int | None) -> Detection:
        return self._report(
            Outcome.NO_TEXTURE,
            "the reference shows no structure above its own noise; choose a region with texture, or add light",
            None,
            t_us,
        )

    def _ended(self) -> Detection:
        detector = self._detector
        if self._doubtful is not None:
            return self._doubtful
        if self._blank:
            return self._flat(None)
        if detector.events < MIN_EVENTS:
            return self._report(
                Outcome.TOO_FEW_EVENTS,
                f"{detector.events} events in the region (at least {MIN_EVENTS} are needed); "
                "add light or contrast, lower the sensor's thresholds, or enlarge the region",
                None,
                None,
            )
        if detector.direction is Direction.RECEDING and detector.mutation is None:
            reason = "focus lay behind from the start; sweep the other way"
        elif detector.direction is Direction.APPROACHING:
            reason = "focus was ahead but not reached; sweep further"
        else:
            reason = "nothing in the events pointed to focus in this sweep; sweep over a longer range"
        return self._report(Outcome.NO_CROSSING, reason, None, None)
