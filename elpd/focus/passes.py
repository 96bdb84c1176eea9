"""A pass of the lens over focus, and what its events and frames testify."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from elpd.units import SensorUs
from elpd.vision.drift import find_drift
from elpd.vision.image_parts import spread_of
from elpd.vision.pair_focus import PAIRS_REACH
from elpd.vision.relief import Parts, is_flat
from elpd.vision.ruler import Ruler
from elpd.vision.track import PeakTrack
from elpd.vision.witness import frame_witness, fuse, lamp_witness

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from elpd.focus.settings import CycleSettings
    from elpd.records import FocusEstimate
    from elpd.vision.flicker import Flicker
    from elpd.vision.image_parts import ImageParts
    from elpd.vision.memory import EventMemory
    from elpd.vision.refractory import Refractory
    from elpd.vision.track import Sharpness
    from elpd.vision.witness import EventWitnesses, Witness

PATH_STEP_US = 250
"""The lens path is sampled this finely for the estimate: at 100 times gravity it bends by 0.03 um in that time."""

VERTEX_IN_MOTION = 0.012
VERTEX_PER_PX = 0.012
"""What a scene that moves adds to the error of the events' vertex, as a tilt of log S over one width of the curve, in a
picture whose edges point in all directions: at all, because pixels follow motion as late as focus, and for each pixel
that it goes, because of what leaves the region and enters it. The variance is in inverse proportion to the picture's
isotropy: bricks and a rocket's tower stray three times as far as gravel."""

LEAST_ISOTROPY = 0.1
"""Below it all edges of a picture point one way, and what is motion and what is blur nobody can tell: noise makes 0.08
of bars, a rocket's tower has 0.2."""

APART = 1.25
"""How far parts of a region that moves scatter where it is not at one depth, over what they may in a still one: two
planes 15 um apart have 2.5 (depth of focus 6 um)."""

FRAMES_IN_MOTION = 0.05
"""What scene motion adds to the error of the frames' vertex, in widths of the curve: the scene has depth and ends, and
exposures smear it by what the hand does then."""


@dataclass(frozen=True, slots=True)
class Testimony:
    """What a pass says: its witnesses, on a path that rises with time, and what else came to light."""

    witnesses: tuple[Witness, ...] = ()
    depths: tuple[float, ...] = ()
    """Where planes of the region are in focus, if there are several, the first met first."""
    flicker: Flicker | None = None
    deaf: Refractory | None = None
    """How long pixels are deaf after an event, by its events."""
    scene_moves: bool = False
    """Whether the scene moved while it was passed over."""
    if_it_moves: tuple[Witness, ...] = ()
    """What is left of a scene that was taken for still, should it turn out to move."""
    picture: NDArray[np.float32] | None = None
    """Such a scene at its sharpest, (height, width) in thresholds: where it lay in this pass."""
    parts: Parts | None = None
    """Where the parts of such a region turned."""
    begin_um: float = 0.0
    """How far before focus most of its pairs began."""
    image_parts: ImageParts | None = None
    """Where the parts of the region are sharpest, which tells depths where the scene moves."""


@dataclass(frozen=True, slots=True)
class _Frames:
    """Frames of a pass, their parabola as a witness, and its width."""

    points: list[tuple[int, float, Sharpness]]
    witness: Witness
    width: float


@dataclass(frozen=True, slots=True)
class Pass:
    """One stretch of motion over focus: what was seen, when it began and was over, which way and how fast it went."""

    memory: EventMemory
    frames: Sequence[tuple[SensorUs, Sharpness]]
    """Each frame's time and how sharp it is."""
    begun_us: SensorUs
    end_us: SensorUs
    sign: int
    speed_um_s: float
    width_um: float
    """The width that the curve of log S has in this optical system."""
    scene_moves: bool

    def testify(
        self, locate: Callable[[SensorUs], float], brightness: NDArray[np.float32], unexplained: float, dark: float
    ) -> Testimony:
        """Ask the events and frames of this pass.

        *unexplained* is the share of the lag that may be wrong, *dark* the dark current that *brightness* does not
        show (as in ``vision.witness`` and ``vision.slowness``).
        Where the scene moves, its turns make mirrors: pairs, and what they tell of depths and lag, are not asked.
        """
        memory = self.memory
        if not len(memory.track):
            return Testimony(tuple(self.ask_frames(locate)))
        if self.end_us > memory.track.times_us[-1]:
            memory.advance(self.end_us, self.sign * locate(self.end_us))
        deaf = memory.refractory()
        ruler = lens_path(locate, self.begun_us, self.end_us, self.sign)
        said = memory.ask(memory.track.times_us[-1], ruler, brightness, deaf, dark=dark)
        if said is None:
            return Testimony(tuple(self.ask_frames(locate)), deaf=deaf)
        undated_um = 1e-6 * self.speed_um_s * deaf.sigma_us
        frames = self._fit_frames(locate)
        moved = (*self._frames_in_motion(frames), *self._in_motion(said, undated_um))
        if self.scene_moves or (not said.depths and said.drift.seen):
            return Testimony(moved, (), memory.flicker(), deaf, scene_moves=True, image_parts=said.parts)
        witnesses = [
            replace(one, shared=float(np.hypot(one.shared, undated_um)), dated_per_us=1e-6 * self.speed_um_s)
            for one in said.witnesses(unexplained, self.width_um)
        ]
        seen = [] if said.depths or frames is None else [frames.witness]  # of several planes frames show a mixture
        told = Testimony(
            (*seen, *witnesses), said.depths, memory.flicker(), deaf, False, moved, memory.sharpest(),
            image_parts=said.parts,
        )  # fmt: skip
        if said.turns is None:
            return told
        return replace(told, parts=Parts.of(said.turns, PAIRS_REACH * self.width_um), begin_um=said.turns.begin)

    def _in_motion(self, said: EventWitnesses, undated_um: float) -> list[Witness]:
        """Return what the events' image says of a scene that moves, whose turns tell nothing of the lag."""
        vertex = said.vertex(width=self.width_um)
        if said.image is None or vertex is None or said.drift.isotropy < LEAST_ISOTROPY:
            return []
        lag = said.expected_lag
        # A tilt of a parabola moves its vertex by the square of its width.
        tilt = (VERTEX_IN_MOTION + VERTEX_PER_PX * said.drift.px) / sqrt(said.drift.isotropy)
        strayed_um = tilt * said.image.finest.width**2 / self.width_um
        late = vertex.with_lag(lag.at, float(np.hypot(lag.sigma, undated_um)))
        sigma = float(np.hypot(vertex.sigma, strayed_um))
        return [replace(late, sigma=sigma, dated_per_us=1e-6 * self.speed_um_s)]

    def testify_under_a_lamp(self, locate: Callable[[SensorUs], float], window_us: float) -> Testimony:
        """Ask the curve of whole lamp periods, one point each *window_us*, and the frames."""
        vertex = self.memory.track.vertex()
        seen = [] if vertex is None else [lamp_witness(vertex, self.width_um, 1e-6 * window_us * self.speed_um_s)]
        return Testimony((*self.ask_frames(locate), *seen))

    def ask_frames(self, locate: Callable[[SensorUs], float]) -> list[Witness]:
        """Ask the frames, where three or more saw focus come and go."""
        frames = self._fit_frames(locate)
        if self.scene_moves:
            return self._frames_in_motion(frames)
        return [] if frames is None else [frames.witness]

    def _fit_frames(self, locate: Callable[[SensorUs], float]) -> _Frames | None:
        points = [(int(when), self.sign * locate(when), one) for when, one in self.frames if when <= self.end_us]
        track = _track_of(points)
        focus = track.focus() if track.passed else None
        if focus is None:
            return None
        witness = frame_witness(focus, float(np.median(np.diff(track.positions))))
        return _Frames(points, witness, focus.finest.width) if np.isfinite(witness.sigma) else None

    @staticmethod
    def _frames_in_motion(frames: _Frames | None) -> list[Witness]:
        """Return what frames say of a scene that moves, if one of them does not carry it all."""
        if frames is None:
            return []
        doubt = float(np.hypot(FRAMES_IN_MOTION * frames.width, _jackknife(frames.points)))
        sigma = float(np.hypot(frames.witness.sigma, doubt))
        return [replace(frames.witness, sigma=sigma)] if np.isfinite(sigma) else []


@dataclass(frozen=True, slots=True)
class Play:
    """How far the carriage lies behind the motor after a turn, and one standard error."""

    um: float
    sigma_um: float

    @classmethod
    def up_to(cls, most_um: float) -> Play:
        """Return what is known of a play of which only an upper bound is: evenly anything below it."""
        return cls(0.5 * most_um, most_um / sqrt(12.0))

    @classmethod
    def known(cls, settings: CycleSettings) -> Play:
        """Return what a rig's settings say of its play: what was measured, or no more than the bound."""
        if settings.measured_play_um is not None:
            return cls(*settings.measured_play_um)
        return cls.up_to(settings.backlash_um)


NO_PLAY = Play(0.0, 0.0)


class Passes:
    """What the passes over focus have testified together; the direction of the first, the sweep, is the ruler's."""

    def __init__(self) -> None:
        self._said: list[tuple[Testimony, int]] = []
        self._near_us: list[tuple[float, float]] = []
        self.depths_um: tuple[float, ...] = ()
        """Where planes of the region are in focus, if a pass told several, on the motor's ruler."""
        self.flicker: Flicker | None = None
        self.scene_moves = False
        """Whether any of them saw the scene move."""
        self.deaf: Refractory | None = None
        """How long pixels are deaf after an event, by all that they have sent so far."""
        self.begin_um = 0.0
        """How far before focus most pairs begin, as far as has been seen."""
        self._flat_within_um = 0.0
        self.flat: bool | None = None
        """Whether the region of a scene that stands still is at one depth; ``None`` where that is not known."""

    def add(self, said: Testimony, sign: int, near_us: tuple[float, float], flat_within_um: float = 0.0) -> None:
        """Take what a pass of direction *sign* says, and from when to when it was near focus.

        A region counts as flat if its parts are in focus at one place to a standard deviation of *flat_within_um*.
        """
        self._said.append((said, sign))
        self._flat_within_um = flat_within_um
        self._near_us.append(near_us)
        self.depths_um = tuple(sign * at for at in said.depths) or self.depths_um
        self.flicker = said.flicker or self.flicker
        if said.scene_moves or self._moved_between():
            self.take_for_moving()
        self.deaf = said.deaf or self.deaf
        self.begin_um = max(self.begin_um, said.begin_um)
        self.flat = None if self.scene_moves or self.depths_um else self._told_flat(flat_within_um)

    def _told_flat(self, within_um: float) -> bool | None:
        there, back = (
            [said.parts for said, sign in self._said if said.parts is not None and sign == way]
            for way in (self.sign, -self.sign)
        )
        return is_flat(there, back, within_um)

    def _moved_between(self) -> bool:
        """Say whether the newest pass met the scene elsewhere than an earlier one did."""
        *earlier, newest = (said.picture for said, _ in self._said)
        return newest is not None and any(
            find_drift(np.stack([one, newest])).seen_between for one in earlier if one is not None
        )

    def take_for_moving(self) -> None:
        """Believe of what was said of a scene that was taken for still only what holds where it moves."""
        self._said = [
            (said if said.scene_moves else Testimony(said.if_it_moves, image_parts=said.image_parts), sign)
            for said, sign in self._said
        ]
        self.scene_moves = True

    @property
    def sign(self) -> int:
        """Direction of the sweep; 0 before it is over."""
        return self._said[0][1] if self._said else 0

    def hold_any(self, times_us: Sequence[int]) -> bool:
        """Say whether any of the times was near focus."""
        return any(begin <= when <= end for begin, end in self._near_us for when in times_us)

    def _of_one_lag(self) -> list[tuple[Witness, int]]:
        """Return all witnesses, each with the direction of its pass.

        Where there is more than one pass, those of one kind have the same lag taken off, their mean: what is common to
        passes there and back cancels, and what each measured of the lag by itself would not. Of a flat region, pairs
        that turn elsewhere are late, or noise.
        """
        said = [(one, sign) for testimony, sign in self._said for one in testimony.witnesses]
        if len(self._said) < 2:
            return said
        evened = []
        # The longer events are listened to, the better it is known how long pixels are deaf.
        said = [(one if self.deaf is None else one.if_deaf_for(self.deaf), sign) for one, sign in said]
        for one, sign in said:
            alike = [other for other, _ in said if other.name == one.name]
            freed, shared = (float(np.mean([getattr(other, key) for other in alike])) for key in ("freed", "shared"))
            even = one.with_lag(freed, shared)
            evened.append((replace(even, astray=even.apart) if self.flat else even, sign))
        return evened

    def estimate(self, play: Play) -> FocusEstimate | None:
        """Return where focus is, on the motor's ruler, while the carriage is pushed in the sweep's direction."""
        sweep = self.sign
        found = fuse(
            [one if sign == sweep else one.on_the_way_back(play.um, play.sigma_um) for one, sign in self._of_one_lag()]
        )
        if found is None:
            return None
        found = self._of_the_first_depth(found) if self.scene_moves else found
        return replace(
            found,
            method="two_crossings" if len(self._said) > 1 else found.method,
            focus_um=sweep * found.focus_um,
            contributions=tuple((name, sweep * at, sigma, share) for name, at, sigma, share in found.contributions),
        )

    def _of_the_first_depth(self, found: FocusEstimate) -> FocusEstimate:
        """Return what was found in a scene that moves, for the first of two depths if its parts tell of such.

        Parts that lie further apart than that, but not at two places, are in the error.
        """
        there, back = (
            [said.image_parts for said, sign in self._said if said.image_parts is not None and sign == way]
            for way in (self.sign, -self.sign)
        )
        spread = spread_of(there, back)
        if spread is None:
            return found
        self.depths_um = ()
        if spread.sigma < APART * self._flat_within_um or not spread.certain:
            return found
        if spread.groups is None:
            return replace(found, sigma_um=float(np.hypot(found.sigma_um, spread.sigma)))
        depths = tuple(found.focus_um + one for one in spread.groups)
        self.depths_um = tuple(self.sign * one for one in depths)
        return replace(found, focus_um=depths[0])


def _track_of(points: Sequence[tuple[int, float, Sharpness]]) -> PeakTrack:
    track = PeakTrack()
    for point in points:
        track.add_sharpness(*point)
    return track


def _jackknife(points: Sequence[tuple[int, float, Sharpness]]) -> float:
    """Return the frames' standard error by leaving each point out in turn; infinite where one point carries it all.

    What motion does to a few frames is not scatter about a parabola: three points always lie on one.
    """
    left = [_track_of([*points[:k], *points[k + 1 :]]).focus() for k in range(len(points))]
    places = np.array([focus.at for focus in left if focus is not None])
    if places.size < len(points):
        return float("inf")
    return float(np.sqrt((places.size - 1) * np.var(places)))


def lens_path(locate: Callable[[SensorUs], float], begin_us: int, end_us: int, sign: int) -> Ruler:
    """Return the lens's path between two sensor times of a pass in the direction *sign*, finely sampled.

    Where a model is put right by what was reported it may step back by as much as it is unsure; the lens did not.
    """
    grid = np.arange(begin_us, end_us + 4 * PATH_STEP_US, PATH_STEP_US, dtype=np.float64)
    path = np.array([locate(SensorUs(int(when))) for when in grid])
    return Ruler.of_path(grid, sign * np.maximum.accumulate(sign * path))
