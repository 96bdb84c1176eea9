"""A pass of the lens over focus, and what its events and frames testify."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from elpd.units import SensorUs
from elpd.vision.crossing import frame_witness, fuse, lamp_witness
from elpd.vision.ruler import Ruler
from elpd.vision.track import PeakTrack

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from elpd.records import FocusEstimate
    from elpd.vision.crossing import Witness
    from elpd.vision.flicker import Flicker
    from elpd.vision.memory import EventMemory

PATH_STEP_US = 250
"""The lens path is sampled this finely for the estimate: at 100 times gravity it bends by 0.03 um in that time."""

VERTEX_IN_MOTION_PER_MS = 0.003
"""What a scene that moves adds to the error of the events' vertex, in widths of the curve, for each millisecond that
the pass over the curve took: what leaves the region and enters it tilts the curve, and thresholds that differ between
pixels add up. Thirty shaken scenes strayed by 0.33 widths (root mean square) in 100 ms."""

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


@dataclass(frozen=True, slots=True)
class Pass:
    """One stretch of motion over focus: what was seen, when it began and was over, which way and how fast it went."""

    memory: EventMemory
    frames: Sequence[tuple[SensorUs, NDArray[np.float64]]]
    """Each frame's time and log S in each band."""
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

        What is unknown of the photoreceptors' lag shifts the events' answers by that time multiplied by this pass's
        speed; passes at two speeds in one direction tell the two apart, whatever the backlash is (``crossing.fuse``).
        *unexplained* is the share of the lag that may be wrong, *dark* the dark current that *brightness* does not
        show (both as in ``vision.crossing``).
        Where the scene is known to move, its turns make mirrors: pairs, and the depths they tell, are not asked.
        """
        memory = self.memory
        if not len(memory.track):
            return Testimony(tuple(self.ask_frames(locate)))
        if self.end_us > memory.track.times_us[-1]:
            memory.advance(self.end_us, self.sign * locate(self.end_us))
        deaf = memory.refractory()
        ruler = lens_path(locate, self.begun_us, self.end_us, self.sign)
        said = memory.ask(memory.track.times_us[-1], ruler, brightness, deaf.period_us, dark=dark)
        if said is None:
            return Testimony(tuple(self.ask_frames(locate)))
        speed_um_us = 1e-6 * self.speed_um_s
        witnesses = [
            replace(one, shared=float(np.hypot(one.shared, deaf.sigma_us * speed_um_us)))
            for one in said.witnesses(unexplained, self.width_um)
        ]
        if self.scene_moves:
            strayed_um = self._strayed_um()
            vertices = [one for one in witnesses if one.name == "vertex"]
            witnesses = [replace(one, sigma=float(np.hypot(one.sigma, strayed_um))) for one in vertices]
            return Testimony((*self.ask_frames(locate), *witnesses), flicker=memory.flicker())
        frames = [] if said.depths else self.ask_frames(locate)  # of several planes frames show a mixture
        return Testimony((*frames, *witnesses), said.depths, memory.flicker())

    def testify_under_a_lamp(self, locate: Callable[[SensorUs], float], window_us: float) -> Testimony:
        """Ask the curve of whole lamp periods, one point each *window_us*, and the frames."""
        vertex = self.memory.track.vertex()
        seen = [] if vertex is None else [lamp_witness(vertex, self.width_um, 1e-6 * window_us * self.speed_um_s)]
        return Testimony((*self.ask_frames(locate), *seen))

    def ask_frames(self, locate: Callable[[SensorUs], float]) -> list[Witness]:
        """Ask the frames, where three or more saw focus come and go."""
        points = [(int(when), self.sign * locate(when), one) for when, one in self.frames if when <= self.end_us]
        track = _track_of(points)
        focus = track.focus() if track.passed else None
        if focus is None:
            return []
        witness = frame_witness(focus, float(np.median(np.diff(track.positions))))
        if self.scene_moves:
            doubt = float(np.hypot(FRAMES_IN_MOTION * focus.finest.width, _jackknife(points)))
            witness = replace(witness, sigma=float(np.hypot(witness.sigma, doubt)))
        return [witness] if np.isfinite(witness.sigma) else []

    def _strayed_um(self) -> float:
        """Return what a moving scene adds to the error of the events' vertex."""
        begin_us = max(self.begun_us, int(self.end_us - 1e6 * 2.0 * self.width_um / self.speed_um_s))
        return VERTEX_IN_MOTION_PER_MS * self.width_um * (self.end_us - begin_us) / 1000.0


class Passes:
    """What the passes over focus in one direction have testified together."""

    def __init__(self) -> None:
        self._said: list[Testimony] = []
        self._near_us: list[tuple[float, float]] = []
        self.depths: tuple[float, ...] = ()
        self.flicker: Flicker | None = None

    def add(self, said: Testimony, near_us: tuple[float, float]) -> None:
        """Take what a pass says, and from when to when it was near focus."""
        self._said.append(said)
        self._near_us.append(near_us)
        self.depths = said.depths or self.depths
        self.flicker = said.flicker or self.flicker

    def hold_any(self, times_us: Sequence[int]) -> bool:
        """Say whether any of the times was near focus."""
        return any(begin <= when <= end for begin, end in self._near_us for when in times_us)

    def estimate(self, sign: int) -> FocusEstimate | None:
        """Return where focus is, on the motor's ruler, of passes whose places rose with *sign* times it."""
        found = fuse([witness for said in self._said for witness in said.witnesses])
        if found is None:
            return None
        return replace(
            found,
            method="two_crossings" if len(self._said) > 1 else found.method,
            focus_um=sign * found.focus_um,
            contributions=tuple((name, sign * at, sigma, share) for name, at, sigma, share in found.contributions),
        )


def _track_of(points: Sequence[tuple[int, float, NDArray[np.float64]]]) -> PeakTrack:
    track = PeakTrack()
    for point in points:
        track.add_bands(*point)
    return track


def _jackknife(points: Sequence[tuple[int, float, NDArray[np.float64]]]) -> float:
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
