"""One picture of the scene, whatever it came from, and how it becomes weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from elpd.focus import stored_map
from elpd.records import TemporalImage
from elpd.units import SensorUs
from elpd.vision.pictures import read_picture
from elpd.vision.reference import check_size, reference_from_frame, reference_from_temporal_image
from elpd.vision.track import USUAL_THRESHOLD, frame_levels

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.records import Geometry, Roi
    from elpd.vision.pictures import Picture as GreyPicture
    from elpd.vision.reference import Reference


@dataclass(frozen=True, slots=True)
class Picture:
    """A temporal map, or a grey image that is linear in light (``pixels``); one of the two is there."""

    log_image: NDArray[np.float32]
    valid: NDArray[np.bool_]
    map: TemporalImage | None = None
    pixels: NDArray[Any] | None = None

    @classmethod
    def of_map(cls, image: TemporalImage) -> Picture:
        """Take a temporal map."""
        return cls(image.log_intensity, image.valid, map=image)

    @classmethod
    def of_frame(cls, pixels: NDArray[Any]) -> Picture:
        """Take a frame; saturated and black pixels are not valid."""
        top = np.iinfo(pixels.dtype).max
        log_image = np.log(pixels.astype(np.float32) + np.float32(0.01 * top))
        return cls(log_image, np.asarray((pixels > 0) & (pixels < top)), pixels=pixels)

    @classmethod
    def of_file(cls, path: Path, geometry: Geometry) -> Picture:
        """Read an image of the whole sensor or a stored map. Raises ``FormatError`` or ``UsageError`` (wrong size)."""
        if path.suffix == ".npz":
            stored = stored_map.load(path).image
            check_size(stored.log_intensity.shape, geometry, str(path))
            return cls.of_map(stored)
        image = read_picture(path)
        check_size(image.pixels.shape, geometry, str(path))
        return cls.of_image(image)

    @classmethod
    def of_image(cls, image: GreyPicture) -> Picture:
        """Take what a file held: linear grey, or the log intensity that ``write_log_png`` wrote."""
        if not image.is_log:
            return cls.of_frame(image.pixels)
        log_image = np.ascontiguousarray(image.pixels, np.float32)
        valid = np.ones(log_image.shape, np.bool_)
        return cls.of_map(TemporalImage(log_image, valid, SensorUs(0), 1.0, 0, 0, float("nan")))

    def levels(self) -> NDArray[np.float32]:
        """Return its log brightness in contrast thresholds, (height, width); what is not valid is as around it."""
        if self.pixels is not None and self.map is None:
            return frame_levels(self.pixels)
        around = cv2.medianBlur(
            np.where(self.valid, self.log_image, np.float32(np.median(self.log_image[self.valid]))), 5
        )
        return np.asarray(np.where(self.valid, self.log_image, around) / np.float32(USUAL_THRESHOLD), np.float32)

    def reference(self, roi: Roi) -> Reference:
        """Make the weights over a region."""
        if self.map is not None:
            return reference_from_temporal_image(self.map, roi)
        assert self.pixels is not None, "a picture is a map or an image"
        return reference_from_frame(self.pixels, roi)
