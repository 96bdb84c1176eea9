"""One direction of travel, as it is judged: which way focus lies, and whether it has been passed.

The windows go to the sequential detector: that is the direction. The image that the events build is looked at tick by
tick of travel: that is the passing, because scene motion does not change sharpness, while it turns a product with a
stale picture negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.records import Direction
from elpd.units import SensorUs

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.focus.frame_track import FrameTrack
    from elpd.focus.heading import Heading
    from elpd.records import ElpSample, Frame
    from elpd.vision.memory import EventMemory

TICK_DOF = 0.5
"""Travel between two looks at the sharpness of the image that the events build."""

PATIENCE_DOF = 8.0
"""How far beyond a sign change of ELP the image's sharpness may take to agree: a curve's width and a half."""

FAR_DROP = 0.2
"""The lens goes on until log S has fallen so far: pairs that answer late would be missing otherwise, and with them the
late half of the midpoints. Stopping at half of this is 2 ms sooner and costs 0.3 um of bias."""

SLOW_SHARE = 0.2
"""Windows with less than this share of the planned travel say little: the lens starts, stops or turns."""


@dataclass(frozen=True, slots=True)
class Leg:
    """Where a direction of travel begins and what it is like."""

    sign: int
    begun_us: SensorUs
    judge_from_um: float
    """Where judging begins, times *sign*: before it, events say more about the way out."""
    speed_um_s: float
    depth_of_focus_um: float
    lit: bool = False
    """Whether a lamp flickers."""


class Course:
    """Judges one direction of travel.

    Parameters
    ----------
    leg:
        Where it begins.
    memory, frames:
        What remembers its events, and what follows its frames.
    heading:
        What judges the direction.
    """

    def __init__(self, leg: Leg, memory: EventMemory, frames: FrameTrack, heading: Heading) -> None:
        self.leg = leg
        self.frames = frames
        self.heading = heading
        self._memory = memory
        self._ticked_um = self._here_um = float("nan")
        self.samples: list[ElpSample] = []
        """The windows of this direction of travel."""
        self.passed = False
        """Whether focus has certainly been passed.

        The image has become as sharp as it gets and duller again, and its product with the reference, the ELP, has said
        that focus was ahead: by the coarse weights, which know the direction from far away.
        """
        self.decided_us: SensorUs | None = None
        """When the window that decided was complete, on the sensor's clock."""

    def feed(self, sample: ElpSample, last_us: SensorUs) -> None:
        """Take a window; everything up to *last_us* has been heard."""
        leg = self.leg
        self.samples.append(sample)
        duration_us = sample.end_us - sample.begin_us
        if sample.begin_us < leg.begun_us:
            return
        if leg.sign * sample.travel_um < SLOW_SHARE * 1e-6 * leg.speed_um_s * duration_us:
            return
        ticked = self._tick(sample, sample.position_um + 0.5 * sample.travel_um)
        if leg.sign * sample.position_um < leg.judge_from_um:
            return
        if 2 * sample.shed_us < duration_us:  # a window that was hardly looked at says nothing
            self.heading.feed(sample, self._memory, ticked=ticked)
        if self.heading.seen_ahead and not self.passed and self._seen_to_pass:
            self.passed = True
            self.decided_us = SensorUs(max(sample.end_us, last_us))

    def follow(self, sample: ElpSample) -> None:
        """Follow the image's sharpness in a window of a further pass, whose direction nobody asks.

        It has passed focus by the same test of rise and fall as a sweep.
        """
        self.samples.append(sample)
        end_um = sample.position_um + 0.5 * sample.travel_um
        if sample.begin_us >= self.leg.begun_us and self.leg.sign * end_um >= self.leg.judge_from_um:
            self._tick(sample, end_um)
            self.passed = self.passed or self._seen_to_pass

    @property
    def _seen_to_pass(self) -> bool:
        """Whether the image has become as sharp as it gets, and by far duller again."""
        return self._memory.track.drop > FAR_DROP and self._memory.peak_passed

    def see(self, frame: Frame, locate: Callable[[SensorUs], float]) -> None:
        """Take a frame, if it was exposed since this direction of travel began."""
        if frame.t_us >= self.leg.begun_us:
            self.frames.take(frame, self.leg.sign * locate(frame.t_us))

    def direction(self, locate: Callable[[SensorUs], float]) -> Direction:
        """Return where focus lies, as far as the events have said; *locate* is the lens position at a sensor time.

        Once ELP has said "ahead", a change of its mind is no reason to turn round at once: with a picture from far away
        it comes some depths of focus early, and the sharpness of the image has the say. Nor is it as long as frames get
        sharper: far from focus a lens shows some fine structure with its bright and dark exchanged, and a reference
        made of that points the wrong way. Where the scene moves, sharpness alone is asked (``vision.bearing``).
        """
        changed_us = self.heading.changed_us
        if changed_us is not None and not self.passed:
            if self.frames.sharpens:
                return Direction.APPROACHING
            beyond_um = self.leg.sign * (self._here_um - locate(SensorUs(changed_us)))
            if beyond_um < PATIENCE_DOF * self.leg.depth_of_focus_um:
                return Direction.APPROACHING
        return self.heading.direction

    def _tick(self, sample: ElpSample, end_um: float) -> bool:
        """Follow the sharpness of the events' own image: once per ``TICK_DOF`` of travel. Say whether it was time."""
        if abs(end_um - self._ticked_um) < TICK_DOF * self.leg.depth_of_focus_um:
            return False
        self._ticked_um = self._here_um = end_um
        # Under a lamp a pixel has spoken at some time in the period: at its middle, in the mean.
        self._memory.advance(sample.end_us, self.leg.sign * (sample.position_um if self.leg.lit else end_um))
        return True
