"""What a sweep's events say while it runs.

What is heard of the region (``hearing``) is judged direction by direction (``course``); once focus has been passed and
the stop has been sent, ``aftermath`` says where it was.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

from elpd.focus.aftermath import Aftermath, WatchSettings
from elpd.focus.course import Course, Leg
from elpd.focus.frame_track import FrameTrack
from elpd.focus.heading import Heading
from elpd.focus.hearing import Hearing
from elpd.focus.shedding import Shedding
from elpd.vision.meter import TRAVEL_PER_DEPTH_OF_FOCUS
from elpd.vision.resting import SIGMAS_OF_MOTION, order

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from elpd.records import CameraPacket, Direction, ElpSample, Frame, Geometry, Roi, SensorProfile
    from elpd.units import SensorUs
    from elpd.vision.flicker import Flicker
    from elpd.vision.reference import Reference
    from elpd.vision.resting import Resting
    from elpd.vision.saturation import RateWatch


class Rereference(Protocol):
    """How a newer frame becomes the reference."""

    def __call__(self, frame: Frame, /) -> Reference:
        """Return the weights of *frame* over the region."""
        ...


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
    sensor
        What a calibration knows of the sensor.
    picture
        Makes the first picture: log brightness in contrast thresholds, (height, width) of the sensor.
    """

    def __init__(
        self,
        reference: Reference,
        roi: Roi,
        geometry: Geometry,
        settings: WatchSettings,
        locate: Callable[[SensorUs], float],
        rereference: Rereference | None = None,
        sensor: SensorProfile | None = None,
        picture: Callable[[], NDArray[np.float32]] | None = None,
    ) -> None:
        self.roi = roi
        self._settings = settings
        self._locate = locate
        self._rereference = rereference
        self._hearing = Hearing(
            reference,
            roi,
            geometry,
            window_um=TRAVEL_PER_DEPTH_OF_FOCUS * settings.depth_of_focus_um,
            speed_um_s=settings.speed_um_s,
            locate=locate,
            sensor=sensor,
            picture=picture,
            support_us=settings.background_activity_us,
        )
        self.shedding = Shedding(roi)
        """What of a sweep is not looked at when there is too much of it."""
        self._course: Course | None = None
        self._after: Aftermath | None = None
        self.events = 0
        """Events in the region since this direction of travel began."""

    # --- before a sweep ---

    def rest(self, packet: CameraPacket) -> None:
        """Learn from a packet of a sensor that sees nothing move."""
        self._hearing.rest(packet)

    def armed(self) -> None:
        """Close the lesson of the resting sensor."""
        self._hearing.armed()

    def under_a_lamp(self, lamp: Flicker, speed_um_s: float) -> None:
        """Judge only whole periods of a lamp that flickers, of a sweep that is slow enough for them."""
        self._settings = replace(self._settings, speed_um_s=speed_um_s)
        self._hearing.under_a_lamp(lamp, speed_um_s)

    @property
    def resting(self) -> Resting:
        """What the sensor says at rest."""
        return self._hearing.resting

    @property
    def rate(self) -> RateWatch:
        """Whether the read-out is full."""
        return self._hearing.rate

    @property
    def reference(self) -> Reference:
        """The weights that the region is judged by: the first picture's, or the newest frame's."""
        return self._hearing.reference

    @property
    def lit(self) -> bool:
        """Whether the sensor at rest has shown that the scene is in the light: a lamp flickers."""
        return self._hearing.lamp is not None

    @property
    def scene_moves(self) -> bool:
        """Whether the scene was seen to move, while the lens stood still or when focus was passed."""
        return self.resting.moves if self._after is None else self._after.scene_moves

    @property
    def motion_suspected(self) -> bool:
        """Whether the resting sensor said more than noise does, too little for certainty."""
        return self.resting.unrest is not None

    @property
    def resting_rate_hz(self) -> float:
        """Events per second that noise makes in the region: what it sends at rest, unless the scene moved."""
        return 0.0 if self.scene_moves else 1e6 * self._hearing.rest_rate.events_per_us

    @property
    def resting_events(self) -> int:
        """How many events the resting rate was learnt from."""
        return self.resting.events

    @property
    def events_in_cycle(self) -> int:
        """Events in the region since the watch was armed."""
        return self._hearing.events

    # --- during a sweep ---

    def begin(self, sign: int, at_us: SensorUs, turned_at_um: float | None = None) -> None:
        """Begin a direction of travel: everything is judged afresh.

        *turned_at_um* is where a reversal was commanded. Until the lens has come back there the events say more about
        the way out (photoreceptors lag, comparators have hysteresis) than about the way back, and are not judged; and
        the verdict that led here was certain, so the opposite one must be more certain still.
        """
        hearing, settings = self._hearing, self._settings
        hearing.begin(at_us)
        leg = Leg(
            sign,
            at_us,
            float("-inf") if turned_at_um is None else sign * turned_at_um,
            settings.speed_um_s,
            settings.depth_of_focus_um,
            lit=self.lit,
        )
        heading = Heading.of_sweep(hearing.rest_rate, hearing.resting, again=turned_at_um is not None)
        self._course = Course(leg, hearing.memory, FrameTrack(self.roi, follow=self.scene_moves), heading)
        self._after = Aftermath(hearing, self._course, settings, self._locate)
        self.events = 0

    def feed(self, packet: CameraPacket) -> list[ElpSample]:
        """Judge one packet; return the windows it closed."""
        course = self._under_way
        self._hearing.keep(packet)
        samples = []
        for heard in self._hearing.windows(packet):
            sample = heard
            if self.shedding.shed_us:
                sample = replace(heard, shed_us=self.shedding.within(heard.begin_us, heard.end_us))
            samples.append(sample)
            self.events += sample.n_on + sample.n_off
            course.feed(sample, self._hearing.last_us)
            self._hearing.undoing = course.passed
        for frame in packet.frames:
            course.see(frame, self._locate)
            if self._rereference is not None:
                self._hearing.rereference(self._rereference(frame))
        return samples

    @property
    def sees_a_scene(self) -> bool:
        """Whether the events of this direction lie together by their sign, as noise alone never does."""
        return order(self._hearing.memory.change()) > SIGMAS_OF_MOTION

    @property
    def frames(self) -> FrameTrack:
        """The frames of this direction of travel."""
        return self._under_way.frames

    @property
    def passed(self) -> bool:
        """Whether focus has certainly been passed."""
        return self._under_way.passed

    @property
    def decided_us(self) -> SensorUs | None:
        """When the window that decided was complete, on the sensor's clock."""
        return self._under_way.decided_us

    @property
    def direction(self) -> Direction:
        """Where focus lies, as far as the events have said (``Course.direction``)."""
        return self._under_way.direction(self._locate)

    @property
    def score(self) -> float:
        """The running evidence in standard deviations: positive while focus is ahead, negative once it is behind."""
        return self._under_way.heading.score

    # --- between and after sweeps ---

    def count(self, packet: CameraPacket) -> None:
        """Count the region's events of a packet that is not judged."""
        self._hearing.count(packet)

    def follow(self, packet: CameraPacket) -> None:
        """Count the region's events, and let them go on building their image, while the lens goes where it is sent."""
        self._hearing.follow(packet)

    @property
    def after(self) -> Aftermath:
        """What is made of the sweep, once focus has been passed."""
        assert self._after is not None, "begin() comes first"
        return self._after

    @property
    def depths_um(self) -> tuple[float, ...]:
        """Where planes of the region are in focus, if the estimate has found several, the first met first."""
        return () if self._after is None else self._after.depths_um

    @property
    def _under_way(self) -> Course:
        assert self._course is not None, "begin() comes first"
        return self._course
