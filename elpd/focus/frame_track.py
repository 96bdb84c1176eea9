"""The sharpness of a sweep's frames over the region, frame by frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.vision.crossing import ROI_MARGIN_PX
from elpd.vision.track import RISE, FrameEnergy, PeakTrack

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from elpd.records import Frame, Roi
    from elpd.units import SensorUs


class FrameTrack:
    """Follows log S of the frames of one pass; with *follow* the region goes with its scene."""

    def __init__(self, roi: Roi, *, follow: bool) -> None:
        self._energy = FrameEnergy(roi, ROI_MARGIN_PX, follow=follow)
        self._track = PeakTrack()
        self.seen: list[tuple[SensorUs, NDArray[np.float64]]] = []
        """Each frame's time and log S in each band."""

    def take(self, frame: Frame, place: float) -> None:
        """Take a frame that was exposed with the lens at *place*, which rises along the pass."""
        bands = self._energy.measure(frame.pixels)
        self.seen.append((frame.t_us, bands))
        self._track.add_bands(int(frame.t_us), place, bands)

    @property
    def sharpens(self) -> bool:
        """Whether the newest frame is the sharpest, by more than noise could make it."""
        track = self._track
        return len(track) > 1 and track.drop == 0.0 and track.rise > RISE
