"""The sharpness of a sweep's frames over the region, frame by frame."""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from elpd.vision.crossing import ROI_MARGIN_PX
from elpd.vision.track import RISE, FrameEnergy, PeakTrack

if TYPE_CHECKING:
    from collections.abc import Iterable

    from elpd.records import Frame, Roi
    from elpd.units import SensorUs
    from elpd.vision.track import Sharpness

SIGMAS_OF_CHANGE = 3.0
"""Beyond chance in one of seven hundred cycles that find no focus either way."""


class FrameTrack:
    """Follows log S of the frames of one pass; with *follow* the region goes with its scene."""

    def __init__(self, roi: Roi, *, follow: bool) -> None:
        self._energy = FrameEnergy(roi, ROI_MARGIN_PX, follow=follow)
        self._track = PeakTrack()
        self.seen: list[tuple[SensorUs, Sharpness]] = []
        """Each frame's time and how sharp it is."""

    def take(self, frame: Frame, place: float) -> None:
        """Take a frame that was exposed with the lens at *place*, which rises along the pass."""
        sharpness = self._energy.measure(frame.pixels)
        self.seen.append((frame.t_us, sharpness))
        self._track.add_sharpness(int(frame.t_us), place, sharpness)

    @property
    def sharpens(self) -> bool:
        """Whether the newest frame is the sharpest, by more than noise could make it."""
        track = self._track
        return len(track) > 1 and track.drop == 0.0 and track.rise > RISE


def show_change(passes: Iterable[FrameTrack]) -> bool:
    """Say whether what frames show changes as the lens goes: that of a lens that stands still does not.

    Sharpness that changes is alike in neighbours, noise is not: von Neumann's ratio (Ann. Math. Stat. 12, 1941), the
    sum of squared successive differences over that of deviations from the mean, is 2 for n independent values, with
    a standard deviation of 2/sqrt(n) at the most.
    """
    steps = spread = 0.0
    count = 0
    for one in passes:
        values = np.array([sharpness.bands[0] for _, sharpness in one.seen])
        if values.size:
            steps += float(np.square(np.diff(values)).sum())
            spread += float(np.square(values - values.mean()).sum())
            count += values.size
    return spread > 0.0 and steps / spread < 2.0 - SIGMAS_OF_CHANGE * 2.0 / sqrt(count)
