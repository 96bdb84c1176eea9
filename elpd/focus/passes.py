"""A pass of the lens over focus, and what its events and frames testify."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from elpd.units import SensorUs
from elpd.vision.crossing import ROI_MARGIN_PX, UNMEASURED_LAG_US, frame_witness
from elpd.vision.ruler import Ruler
from elpd.vision.track import FrameEnergy, PeakTrack

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from elpd.records import Frame, Roi
    from elpd.vision.crossing import Witness
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
class Pass:
    """One stretch of motion over focus: what was seen, when it began and was over, which way and how fast it went."""

    memory: EventMemory
    frames: Sequence[Frame]
    begun_us: SensorUs
    decided_us: SensorUs
    sign: int
    speed_um_s: float

    def testify(
        self,
        ruler: Ruler,
        roi: Roi,
        brightness: NDArray[np.float32],
        unexplained: float,
        width_um: float,
        *,
        scene_moves: bool,
    ) -> list[Witness]:
        """Return the witnesses of this pass; their positions rise with time.

        What is unknown of the photoreceptors' lag shifts the events' answers by that time multiplied by this pass's
        speed, so that passes at two speeds in one direction tell the lag, whatever the backlash is
        (``crossing.fuse``). Where the scene is known to move, its turns make mirrors, and pairs are not asked.
        """
        found = self._ask_frames(ruler, roi, scene_moves=scene_moves)
        memory = self.memory
        if not len(memory.track):
            return found
        deaf = memory.refractory()
        said = memory.ask(memory.track.times_us[-1], ruler, brightness, deaf.period_us)
        if said is None:
            return found
        speed_um_us = 1e-6 * self.speed_um_s
        strayed_um = 0.0
        if scene_moves:
            begin_us = max(self.begun_us, int(self.decided_us - 1e6 * 2.0 * width_um / self.speed_um_s))
            strayed_um = VERTEX_IN_MOTION_PER_MS * width_um * (self.decided_us - begin_us) / 1000.0
        for one in said.witnesses(UNMEASURED_LAG_US * speed_um_us, unexplained, width_um):
            if one.name == "vertex" or not scene_moves:
                shared = float(np.hypot(one.shared, deaf.sigma_us * speed_um_us))
                found.append(replace(one, sigma=float(np.hypot(one.sigma, strayed_um)), shared=shared))
        return found

    def _ask_frames(self, ruler: Ruler, roi: Roi, *, scene_moves: bool) -> list[Witness]:
        """Ask the frames, where three or more saw focus come and go."""
        track, energy = PeakTrack(), FrameEnergy(roi, ROI_MARGIN_PX, follow=scene_moves)
        for frame in self.frames:
            if self.begun_us <= frame.t_us <= self.decided_us:
                place = self.sign * ruler.position(float(frame.t_us))
                track.add(int(frame.t_us), place, energy.measure(frame.pixels))
        vertex = track.vertex() if track.passed else None
        if vertex is None:
            return []
        witness = frame_witness(vertex, float(np.median(np.diff(track.positions))))
        if scene_moves:
            witness = replace(witness, sigma=float(np.hypot(witness.sigma, FRAMES_IN_MOTION * vertex.width)))
        return [witness]


def lens_path(locate: Callable[[SensorUs], float], begin_us: int, end_us: int) -> Ruler:
    """Return the lens's path between two sensor times, finely sampled."""
    grid = np.arange(begin_us, end_us + 4 * PATH_STEP_US, PATH_STEP_US)
    return Ruler.of_path(grid.astype(np.float64), np.array([locate(SensorUs(int(when))) for when in grid]))
