"""Where a picture of the scene lies when its scene has moved on, told by what moves.

Between a map and the sweep a hand goes some pixels unseen: the sensor has other biases, or nobody listens. But while
the scene moves a sensor at rest shows the picture's *gradient*, in the direction of motion and at the place where the
picture now is: ``events ≈ -d·∇L``. So the events of a few milliseconds are explained by the two components of the
gradient, at every displacement at once (three Fourier transforms), and the displacement that explains them best is
where the picture lies. What a hand may have done in the meantime is the prior, and the answer is the posterior's mean:
where events tell nothing, it is no displacement. A map is made while the aperture opens, so it is sharper than what the
open one shows, the more so where it is bright: the blur that explains most is put on it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.integral import band_image

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHRINK = 2
BAND_PX = 3.4
"""The grid, and the band in pixels of the sensor: blurred pictures have nothing finer, and displacements of some pixels
are to be told."""

BLURS_PX = (0.0, 1.5, 3.0, 5.0)
"""Blurs that are tried: from none to that of a lens ten depths of focus away."""

PRIOR_PX = 6.0
"""One standard deviation of the displacement: 60 ms of a hand that shakes by 100 px/s."""

REACH_PX = 20
"""Three standard deviations are looked at."""


def laid_on(picture: NDArray[np.float32], change: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what *picture* shows, as blurred as it is now and where it is now, as far as *change* tells.

    Both are (height, width), in contrast thresholds; *change* is what events have built since, however little. What
    comes into view repeats the edge.
    """
    blurred = [cv2.GaussianBlur(picture, (0, 0), blur_px) if blur_px else picture for blur_px in BLURS_PX]
    candidates = [(one, *_displacement(np.asarray(one, np.float32), change)) for one in blurred]
    best, x_px, y_px, _ = max(candidates, key=lambda one: one[3])
    return moved(np.asarray(best, np.float32), x_px, y_px)


def displacement_px(picture: NDArray[np.float32], change: NDArray[np.float32]) -> tuple[float, float]:
    """Return how far the scene has gone, (x, y) px, since *picture* (as ``laid_on``)."""
    x_px, y_px, _ = _displacement(picture, change)
    return x_px, y_px


def _displacement(picture: NDArray[np.float32], change: NDArray[np.float32]) -> tuple[float, float, float]:
    """Return the displacement, (x, y) px, and the share of *change* that is explained at the best one."""
    band, seen = (band_image(_shrunk(one), BAND_PX / SHRINK) for one in (picture, change))
    window = np.outer(np.hanning(band.shape[0]), np.hanning(band.shape[1])).astype(np.float32)
    down, right = (window * one for one in np.gradient(band))
    seen = window * seen
    total = float(np.square(seen).sum())
    gram = np.array([[np.vdot(right, right), np.vdot(right, down)], [np.vdot(right, down), np.vdot(down, down)]])
    if total <= 0.0 or np.trace(gram) <= 0.0:
        return 0.0, 0.0, 0.0
    reach = min(REACH_PX // SHRINK, min(band.shape) // 4)
    steps = np.arange(-reach, reach + 1)
    spectrum = np.fft.rfft2(seen)
    likeness = np.stack(
        [
            np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(one)), seen.shape)[np.ix_(steps, steps)]
            for one in (right, down)
        ]
    )
    explained = np.einsum("iyx,ij,jyx->yx", likeness, np.linalg.pinv(gram, hermitian=True), likeness) / total
    y_px, x_px = np.meshgrid(SHRINK * steps, SHRINK * steps, indexing="ij")
    evidence = -0.5 * _independent(right, down, window) * np.log(np.maximum(1.0 - explained, 1e-3))
    evidence -= (np.square(x_px) + np.square(y_px)) / (2.0 * PRIOR_PX**2)
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    return float((weight * x_px).sum()), float((weight * y_px).sum()), float(explained.max())


def moved(picture: NDArray[np.float32], x_px: float, y_px: float) -> NDArray[np.float32]:
    """Return a picture whose scene has gone by so much; what comes into view repeats the edge."""
    shift = np.array([[1.0, 0.0, x_px], [0.0, 1.0, y_px]])
    size = picture.shape[1], picture.shape[0]
    there = cv2.warpAffine(picture, shift, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(there, dtype=np.float32)


def _independent(right: NDArray[np.float32], down: NDArray[np.float32], window: NDArray[np.float32]) -> float:
    """Return how many independent samples a field like the gradient has: its pixels over the patch that is one."""
    power = np.square(np.abs(np.fft.fft2(right))) + np.square(np.abs(np.fft.fft2(down)))
    share = float(np.mean(window**2)) ** 2 / float(np.mean(window**4))
    return window.size * share * float(power.mean()) ** 2 / float(np.square(power).mean())


def _shrunk(image: NDArray[np.float32]) -> NDArray[np.float32]:
    shrunk = cv2.resize(image, None, fx=1.0 / SHRINK, fy=1.0 / SHRINK, interpolation=cv2.INTER_AREA)
    return np.asarray(shrunk, dtype=np.float32)
