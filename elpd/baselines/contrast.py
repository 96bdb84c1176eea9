"""Frame contrast: the classical focus measures, over the whole stack of frames.

Tenengrad (Krotkov 1988: the energy of the Sobel gradient) and the variance of the Laplacian (Pech-Pacheco 2000), each
inside the region of interest; the highest frame and its neighbours give focus by a parabola in lens position. This is
the best that contrast autofocus can do when all frames are free; `search` counts what they cost. Its resolution is
the frame rate: at 50 fps and 0.8 um/ms frames are 16 um apart. It needs the complete stack of frames.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from elpd.baselines.rates import vertex
from elpd.baselines.stack import Estimate, FocusStack, no_answer

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from elpd.records import Roi

    FocusMeasure = Callable[[NDArray[np.uint8], Roi], float]


def tenengrad(pixels: NDArray[np.uint8] | NDArray[np.float32], roi: Roi) -> float:
    """Return the mean squared Sobel gradient of *pixels* (height, width) inside *roi*."""
    window = _cut(pixels, roi)
    dx = cv2.Sobel(window, cv2.CV_32F, 1, 0, ksize=3)
    dy = cv2.Sobel(window, cv2.CV_32F, 0, 1, ksize=3)
    return float(np.mean(np.square(dx, dtype=np.float64) + np.square(dy, dtype=np.float64)))


def laplacian_variance(pixels: NDArray[np.uint8], roi: Roi) -> float:
    """Return the variance of the 4-neighbour Laplacian of *pixels* (height, width) inside *roi*."""
    return float(np.var(cv2.Laplacian(_cut(pixels, roi), cv2.CV_32F), dtype=np.float64))


def estimate_tenengrad(stack: FocusStack) -> Estimate:
    """Return the vertex of Tenengrad over all frames."""
    return _highest(stack, tenengrad)


def estimate_laplacian_variance(stack: FocusStack) -> Estimate:
    """Return the vertex of the variance of the Laplacian over all frames."""
    return _highest(stack, laplacian_variance)


def _highest(stack: FocusStack, measure: FocusMeasure) -> Estimate:
    if len(stack.frames) < 3:
        return no_answer("fewer than three frames", frames=len(stack.frames))
    values = np.array([measure(frame.pixels, stack.roi) for frame in stack.frames])
    if values.max() == values.min():
        return no_answer("every frame has the same contrast")
    peak = int(np.argmax(values))
    index = vertex(values, peak)
    positions = np.array([stack.lens_um(frame.t_us) for frame in stack.frames])
    position_um = float(np.interp(index, np.arange(values.size), positions))
    at_end = peak in (0, values.size - 1)
    details = {"frames": len(stack.frames), "peak_at_end": at_end}
    return Estimate(stack.time_at_um(position_um), float(stack.end_us), details)


def _cut(pixels: NDArray[Any], roi: Roi) -> NDArray[Any]:
    return np.ascontiguousarray(pixels[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width])
