"""An image becomes a table of weights, one per pixel of the sensor.

The Event Laplacian Product is linear, so all that an event needs to know about the picture is one number, the weight of
its pixel. The paper weights by the Laplacian of the newest frame. Here the weight is a Laplacian of Gaussian, divided
by the local brightness, because events answer to log intensity and ``d(log I)/dt ∝ ∇²I / I`` (facts of the field: a
plain Laplacian lets the bright corner of a picture vote alone). Its scale is the finest at which the picture stands out
of its own noise and still has its share of structure. A frame blurred tenfold has neither in a 3x3 Laplacian; worse, a
lens far out of focus *inverts* fine contrast (its transfer function has negative lobes), which points the wrong way.

Weights have zero mean inside the ROI, so that an imbalance between ON and OFF noise cancels, are clipped at a high
percentile, so that no single pixel decides, are zero where the picture is invalid, and are scaled to ``int16``, so that
sums over events are exact.

A picture without structure above its own noise is refused before anything moves (``Reference.textured``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.errors import FormatError, UsageError
from elpd.vision.pictures import decode_grey

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.records import Geometry, Roi, TemporalImage

FULL_SCALE = 4096
"""The largest weight. Its square times 2^38 events still fits the 63 bits of an energy sum."""

_SCALES_PX = (1.0, 1.5, 2.2, 3.3, 5.0)
_CLIP_PERCENTILE = 99.0
_SIGNAL_TO_NOISE = 4.0
_SHARE_OF_STRUCTURE = 0.5
_COARSER = 3
"""Steps from the finest scale that has structure to the one that is still there far from focus: 3.3 times coarser."""

_TEXTURE_SIGMAS = 6.0
_QUANTISATION_VARIANCE = 1.0 / 12.0


@dataclass(frozen=True, slots=True)
class Reference:
    """A weight table and what is known of the picture behind it.

    Attributes
    ----------
    weights:
        (height, width) of the whole sensor, ``int16``, zero outside the ROI and where the picture is invalid.
    texture:
        How many standard deviations the picture's structure stands above what noise alone would show.
    scale_px:
        Standard deviation of the Laplacian of Gaussian that made the weights.
    brightness:
        Linear intensity relative to the brightest parts of the ROI, (height, width) ``float32``: how fast a pixel's
        photoreceptor is, and how much its events are worth when energies are summed.
    """

    weights: NDArray[np.int16]
    texture: float
    scale_px: float
    brightness: NDArray[np.float32]

    @property
    def textured(self) -> bool:
        """Whether there is anything to focus on: structure six standard deviations above noise."""
        return self.texture > _TEXTURE_SIGMAS


def reference_from_frame(pixels: NDArray[np.generic], roi: Roi, *, mask: NDArray[np.bool_] | None = None) -> Reference:
    """Make the weight table of a frame.

    Parameters
    ----------
    pixels:
        (height, width), 8 or 16 bit or float, linear in light (a gamma of two changes weights by a factor, no sign).
    roi:
        Where to focus; must fit the frame.
    mask:
        (height, width), false where a pixel is not to be believed.
    """
    image = np.ascontiguousarray(pixels, dtype=np.float32)
    if image.ndim != 2:
        raise UsageError(f"a reference is a grey image of two dimensions; this one has shape {image.shape}")
    top = full_scale(pixels) or float("inf")
    valid = (image < top) if mask is None else (mask & (image < top))
    step = _QUANTISATION_VARIANCE if full_scale(pixels) else 0.0
    ground = max(float(image.mean()) * 0.02, 1.0 if step else 1e-6)
    return _build(image, ground, roi, valid, step)


def reference_from_temporal_image(picture: TemporalImage, roi: Roi) -> Reference:
    """Make the weight table of a picture taken by opening the aperture (its log is already what events see)."""
    image = np.ascontiguousarray(picture.log_intensity, dtype=np.float32)
    return _build(image, None, roi, picture.valid, 0.0)


def load_image(path: Path) -> NDArray[np.generic]:
    """Read a grey image of 8 or 16 bit from PNG, JPEG, TIFF or PGM. Raises ``FormatError``."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror}); give an existing PNG or JPEG image") from None
    return decode_grey(data, path)


def full_scale(pixels: NDArray[np.generic]) -> float | None:
    """Return the largest value that integer pixels can have; ``None`` for floats."""
    return None if pixels.dtype.kind == "f" else float(2 ** (8 * pixels.dtype.itemsize) - 1)


def check_size(shape: tuple[int, ...], geometry: Geometry, name: str) -> None:
    """Raise ``UsageError`` unless a picture is as large as the sensor."""
    if shape != (geometry.height, geometry.width):
        raise UsageError(
            f"{name}: {shape[1]}x{shape[0]} pixels, but the sensor has {geometry.width}x{geometry.height}; "
            "a reference must show the whole sensor"
        )


def _build(
    image: NDArray[np.float32], ground: float | None, roi: Roi, valid: NDArray[np.bool_], step_variance: float
) -> Reference:
    """Find the scale, filter, balance, clip and quantise. ``ground`` is None for pictures that are logs already."""
    inside = (slice(roi.y, roi.y + roi.height), slice(roi.x, roi.x + roi.width))
    usable = np.zeros(image.shape, dtype=bool)
    usable[inside] = cv2.erode(valid.astype(np.uint8), np.ones((3, 3), np.uint8))[inside] > 0
    filled = np.where(valid, image, np.float32(np.median(image[valid]) if valid.any() else 0.0)).astype(np.float32)
    noise_variance = max(_white_noise_variance(filled[inside]), step_variance)

    texture = 0.0
    responses = [_laplacian_of_gaussian(filled, scale_px) for scale_px in _SCALES_PX]
    structure = np.zeros(len(_SCALES_PX))
    for k, scale_px in enumerate(_SCALES_PX):
        energy = float(np.mean(np.square(responses[k][usable], dtype=np.float64))) if usable.any() else 0.0
        floor = noise_variance * _noise_gain(scale_px) + 1e-12
        excess = energy / floor - 1.0
        independent = max(1.0, usable.sum() / (4.0 * np.pi * scale_px**2))
        texture = max(texture, excess * np.sqrt(independent / 2.0))
        # Scale-normalised, a sharp natural picture has equal energy at all scales; a blurred one lacks the fine ones.
        structure[k] = scale_px**4 * (energy - floor) if excess > _SIGNAL_TO_NOISE else 0.0
    best = int(np.argmax(structure >= _SHARE_OF_STRUCTURE * structure.max())) if structure.max() > 0.0 else -1
    chosen, response = _SCALES_PX[best], responses[best]
    brightness = _relative_brightness(filled, ground, usable)
    coarse = responses[min(best + _COARSER, len(responses) - 1)] if best >= 0 else response
    if ground is not None:
        local = cv2.GaussianBlur(filled, (0, 0), 2.0 * chosen) + np.float32(ground)
        response, coarse = response / local, coarse / local
    # Near focus events follow the fine structure; far from it only the coarse is left of the picture.
    weights = _quantise(_unit(response, usable) + _unit(coarse, usable), usable)
    return Reference(weights, float(texture), chosen, brightness)


def _unit(response: NDArray[np.float32], usable: NDArray[np.bool_]) -> NDArray[np.float32]:
    spread = float(np.sqrt(np.mean(np.square(response[usable], dtype=np.float64)))) if usable.any() else 0.0
    return np.asarray(response / np.float32(spread), dtype=np.float32) if spread > 0.0 else response


def _quantise(response: NDArray[np.float32], usable: NDArray[np.bool_]) -> NDArray[np.int16]:
    table = np.zeros(response.shape, dtype=np.int16)
    if not usable.any():
        return table
    inside = response[usable].astype(np.float64)
    limit = float(np.percentile(np.abs(inside), _CLIP_PERCENTILE))
    if limit <= 0.0:
        return table
    # Clipping moves the mean, so balance after it; what rounding leaves is below one part in ten thousand.
    clipped = np.clip(inside / limit, -1.0, 1.0)
    clipped -= clipped.mean()
    table[usable] = np.rint(clipped * (FULL_SCALE / 2)).astype(np.int16)
    return table


def _relative_brightness(
    image: NDArray[np.float32], ground: float | None, usable: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return linear intensity over that of the brightest parts, capped there, so that one lamp is no yardstick."""
    linear = np.exp(image - np.float32(image.max())) if ground is None else image
    top = float(np.percentile(linear[usable], _CLIP_PERCENTILE)) if usable.any() else 0.0
    if top <= 0.0:
        return np.ones_like(image)
    return np.asarray(np.minimum(linear / np.float32(top), 1.0), dtype=np.float32)


def _laplacian_of_gaussian(image: NDArray[np.float32], scale_px: float) -> NDArray[np.float32]:
    smooth = cv2.GaussianBlur(image, (0, 0), scale_px, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(cv2.Laplacian(smooth, cv2.CV_32F, ksize=1, borderType=cv2.BORDER_REFLECT_101), np.float32)


def _noise_gain(scale_px: float) -> float:
    """Return the variance that white noise of unit variance has after the filter: the kernel's sum of squares."""
    impulse = np.zeros((65, 65), dtype=np.float32)
    impulse[32, 32] = 1.0
    return float(np.sum(np.square(_laplacian_of_gaussian(impulse, scale_px), dtype=np.float64)))


def _white_noise_variance(image: NDArray[np.float32]) -> float:
    """Estimate noise from what no blurred picture contains (Immerkaer 1996), by the median, which edges do not move."""
    if min(image.shape) < 3:
        return 0.0
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    residue = cv2.filter2D(image, cv2.CV_32F, mask)[1:-1, 1:-1]
    spread = float(np.median(np.abs(residue))) / 0.6745 / 6.0
    return spread * spread
