"""What is made of a sweep once its stop has been sent: where focus was, and what further passes over it add.

The witnesses of ``vision.witness`` are asked after the stop, of the events that the sweep has left, and again after
every further pass. The events of the way back are counted: reports alone prove no motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from elpd.focus.course import Course
from elpd.focus.frame_track import FrameTrack
from elpd.focus.passes import NO_PLAY, Pass, Passes, Play
from elpd.units import SensorUs
from elpd.vision.sharpest import sharpest
from elpd.vision.slowness import DARK, DARK_OF_MAP
from elpd.vision.witness import WIDTHS_PER_DEPTH_OF_FOCUS

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.focus.hearing import Hearing
    from elpd.records import CameraPacket, FocusEstimate
    from elpd.vision.flicker import Flicker
    from elpd.vision.sharpest import Sharpest

LOOK_BACK_DOF = 12.0
"""Losses this far back from the decision count against it: the witnesses look no further."""

AFTERMATH_DOF = 2.0
"""Travel beyond the decision whose events still count: pixels with little contrast answer late."""

FLAT_DOF = 0.5
"""How far the parts of a region may be in focus from one another, as a standard deviation, if one answer is to do for
all: half a depth of focus."""

LATE_DOF = 3.0
"""How late the events' own image is sharpest: its pixels answer 11 to 22 um after a focus 6 um deep (natural scenes).
Too far on the way back costs less than not far enough."""

FOR_EVER = SensorUs(1 << 62)

LAG_UNEXPLAINED_LIVE = 0.3
"""Share of the lag correction that may be wrong where the picture that says which pixels are slow is a temporal map,
taken without saturation, or the newest frame: neither is as blurred as the first frame of a record."""


@dataclass(frozen=True, slots=True)
class WatchSettings:
    """What a watch needs to know of rig and taste."""

    speed_um_s: float
    depth_of_focus_um: float
    play: Play = NO_PLAY
    """Between motor and carriage."""
    frames: bool = False
    """Whether the reference is a frame, whose bright and dark are blurred, and not a temporal map."""
    background_activity_us: int = 0
    """Events of a sweep that no neighbour fired so shortly before are not heard; 0: all are."""


class Aftermath:
    """What follows one sweep.

    Parameters
    ----------
    hearing, sweep
        What hears the region, and the direction of travel that passes focus.
    settings, locate
        As of the watch.
    """

    def __init__(
        self, hearing: Hearing, sweep: Course, settings: WatchSettings, locate: Callable[[SensorUs], float]
    ) -> None:
        self._hearing = hearing
        self._settings = settings
        self._locate = locate
        self._course = sweep
        self._turned_us = FOR_EVER
        self._passes = Passes()
        self._unheard: list[CameraPacket] = []
        self.events_back = 0
        """Events in the region on the way back, from ``back_from_us`` on."""
        self.back_from_us = FOR_EVER
        self._lost = 0.0
        """What the image had lost of log S before a way to focus, at the most."""

    @property
    def scene_moves(self) -> bool:
        """Whether the scene was seen to move, while the lens stood still or when focus was passed."""
        return self._hearing.resting.moves or self._passes.scene_moves

    @property
    def flicker(self) -> Flicker | None:
        """A lamp's flicker that only the sweep has shown."""
        return self._passes.flicker

    @property
    def depths_um(self) -> tuple[float, ...]:
        """Where planes of the region are in focus, if the estimate has found several, the first met first."""
        return self._passes.depths_um

    # --- the stop, and the way back ---

    def turn(self, at_us: SensorUs) -> None:
        """Take note that the sweep ends at *at_us*: what comes later is of the way back.

        A motor that brakes late goes far beyond what is of interest; ``AFTERMATH_DOF`` of that is listened to.
        """
        decided_us = self._course.decided_us
        assert decided_us is not None, "turn() comes after the decision"
        aftermath_us = 1e6 * AFTERMATH_DOF * self._settings.depth_of_focus_um / self._settings.speed_um_s
        self._turned_us = min(at_us, SensorUs(decided_us + round(aftermath_us)))

    @property
    def peak_um(self) -> float:
        """Where the image was sharpest, in the last pass."""
        track = self._hearing.memory.track
        return self._course.leg.sign * track.positions[track.peak]

    @property
    def past_um(self) -> float:
        """How far the lens has gone since then, in that pass."""
        track = self._hearing.memory.track
        return track.positions[-1] - track.positions[track.peak]

    def sharpest(self, focus_um: float, distance_um: float) -> Sharpest | None:
        """Return the picture in focus as the last pass saw it; ``None`` if it saw less than *distance_um* around it."""
        position = self._course.leg.sign * focus_um
        return sharpest(self._hearing.memory, self._hearing.roi, position, distance_um)

    @property
    def roughly_um(self) -> float:
        """Where focus was, known at once and not to be believed: the top of the raw curve, less what it is late by."""
        return self.peak_um - self._course.leg.sign * LATE_DOF * self._settings.depth_of_focus_um

    def hear_out(self, packet: CameraPacket) -> None:
        """Take a packet after the decision: what is still of the sweep belongs to it, the rest is counted."""
        hearing = self._hearing
        if hearing.last_us < self._turned_us or hearing.lamp is not None:
            hearing.keep(packet)
        else:  # nobody waits for what it says, unless there is a second pass
            self._unheard.append(replace(packet, data=packet.data.copy(), frames=()))
        for sample in hearing.windows(packet):
            if sample.end_us <= self._turned_us:
                self._course.samples.append(sample)
            self.events_back += sample.n_on + sample.n_off if sample.begin_us >= self.back_from_us else 0

    def go_back(self, at_us: SensorUs) -> None:
        """Take note that the way back is under way at *at_us*, and that what is left of the sweep has died away."""
        self.back_from_us, self.events_back = at_us, 0

    def events_within(self, from_um: float, to_um: float) -> int:
        """Return how many events the last pass saw between two places."""
        low, high = min(from_um, to_um), max(from_um, to_um)
        return sum(one.n_on + one.n_off for one in self._course.samples if low <= one.position_um <= high)

    def return_score(self, focus_um: float) -> float | None:
        """Return by how many standard deviations the way back undid what the way out from focus had done to the pixels.

        Only under a lamp, where events cannot simply be counted; else ``None``.
        """
        lamp = self._hearing.lamp
        return None if lamp is None else lamp.return_score(self._hearing.memory, self._course.leg.sign * focus_um)

    def sharpened_again(self) -> float | None:
        """Return how much sharper the image became on the way back, as a share of what it had lost since its peak.

        The image that the events build is gone on with, and what pixels lost while deaf is put back, which a scene that
        shakes would lack at the end. ``None`` under a lamp, with several depths, or where nothing had been lost. To be
        asked once after each way, with the lens at rest; a second way is held against the first's loss if its own is
        less.
        """
        memory = self._hearing.memory
        track = memory.track
        if (self.depths_um and not self.scene_moves) or self._hearing.lamp is not None or not track.drop > 0.0:
            return None
        peak, far = (memory.sharpness(when) for when in (track.times_us[track.peak], track.times_us[-1]))
        self._lost = max(peak - far, self._lost)
        self.look()
        if self._lost <= 0.0:
            return 0.0 if self.scene_moves else None
        return (memory.sharpness(track.times_us[-1]) - far) / self._lost

    def look(self) -> None:
        """Measure how sharp the image is that all events have built."""
        self.catch_up()
        memory = self._hearing.memory
        memory.advance(self._hearing.last_us, memory.track.positions[-1])

    # --- where focus was ---

    def estimate(self) -> FocusEstimate | None:
        """Say where focus was, in um on the motor's ruler; ``None`` if no witness saw it.

        Asks the remembered events of the pass that is over, once: milliseconds, after the stop has been sent. What an
        earlier pass testified stands beside it.
        """
        course, hearing, settings = self._course, self._hearing, self._settings
        if course.decided_us is None:
            return None
        one = Pass(
            hearing.memory,
            tuple(course.frames.seen),
            course.leg.begun_us,
            max(course.decided_us, min(self._turned_us, hearing.last_us)),
            course.leg.sign,
            settings.speed_um_s,
            WIDTHS_PER_DEPTH_OF_FOCUS * settings.depth_of_focus_um,
            self.scene_moves,
        )
        if hearing.lamp is not None:
            said = one.testify_under_a_lamp(self._locate, hearing.window_us)
        else:
            dark = DARK if settings.frames else DARK_OF_MAP
            said = one.testify(self._locate, hearing.reference.brightness, LAG_UNEXPLAINED_LIVE, dark)
        look_back_us = 1e6 * LOOK_BACK_DOF * settings.depth_of_focus_um / settings.speed_um_s
        near_us = (course.decided_us - look_back_us, course.decided_us)
        self._passes.add(said, course.leg.sign, near_us, FLAT_DOF * settings.depth_of_focus_um)
        return self._passes.estimate(settings.play)

    @property
    def pairs_begin_um(self) -> float:
        """How far before focus most mirror pairs begin."""
        return self._passes.begin_um

    @property
    def flat(self) -> bool | None:
        """Whether the region of a still scene is at one depth, by passes there and back; ``None``: not known."""
        return self._passes.flat

    def take_for_moving(self) -> None:
        """Take the scene for one that moves: of what has been said of it as still only what holds then is believed."""
        self._passes.take_for_moving()

    @property
    def gap_near_crossing(self) -> bool:
        """Whether anything was lost in the last part of a pass, where the estimate comes from."""
        return self._passes.hold_any(self._hearing.gaps_us)

    # --- a further pass ---

    def catch_up(self) -> None:
        """Let the events of the way back that nobody has listened to yet go on building the image."""
        for packet in self._unheard:
            self._hearing.keep(packet)
        self._unheard = []

    def begin_again(self, sign: int, from_um: float) -> None:
        """Begin to pass focus once more, in either direction, with what has not been heard yet.

        The image is gone on with; its sharpness is followed from *from_um* on, where the play has been taken up.
        """
        self.catch_up()
        at_us = self._hearing.last_us
        self._hearing.begin_again(at_us)
        leg = replace(self._course.leg, sign=sign, begun_us=at_us, judge_from_um=sign * from_um)
        frames = FrameTrack(self._hearing.roi, follow=self.scene_moves)
        self._course = Course(leg, self._hearing.memory, frames, self._course.heading)
        self._turned_us = FOR_EVER

    def pass_again(self, packet: CameraPacket) -> None:
        """Follow the image's sharpness in a packet of the further pass."""
        self._hearing.keep(packet)
        for sample in self._hearing.windows(packet):
            self._course.follow(sample)
        for frame in packet.frames:
            self._course.see(frame, self._locate)

    @property
    def seen_again(self) -> bool:
        """Whether the further pass has seen the image become sharp, and duller again."""
        return self._course.passed

    def passed_again(self) -> None:
        """End the further pass: from here on packets are of the way back. ``estimate`` may be asked again."""
        track = self._hearing.memory.track
        at_us = SensorUs(track.times_us[-1]) if len(track) else self._hearing.last_us
        self._course.decided_us = self._turned_us = at_us
        self.go_back(self._hearing.last_us)
