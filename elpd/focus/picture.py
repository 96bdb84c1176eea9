"""One picture of the scene, whatever it came from, and how it becomes weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.vision.reference import check_size, load_image, reference_from_frame, reference_from_temporal_image

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.records import Geometry, Roi, TemporalImage
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
        """Read an image of the whole sensor. Raises ``FormatError`` or ``UsageError`` (wrong size)."""
        pixels = load_image(path)
        check_size(pixels.shape, geometry, str(path))
        return cls.of_frame(pixels)

    def reference(self, roi: Roi) -> Reference:
        """Make the weights over a region."""
        if self.map is not None:
            return reference_from_temporal_image(self.map, roi)
        assert self.pixels is not None, "a picture is a map or an image"
        return reference_from_frame(self.pixels, roi)
