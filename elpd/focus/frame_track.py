"""The sharpness of a sweep's frames over the region, frame by frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.vision.crossing import ROI_MARGIN_PX
from elpd.vision.track import RISE, FrameEnergy, PeakTrack

if TYPE_CHECKING:
    from elpd.records import Frame, Roi
    from elpd.units import SensorUs
    from elpd.vision.track import Sharpness


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
