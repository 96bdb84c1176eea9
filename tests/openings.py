"""Synthetic aperture openings: a scene, a profile, a sensor with mismatch and noise; events in time order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

CONTRAST = 0.3


@dataclass(frozen=True)
class Opening:
    """Events as columns, and the truth: log intensity, when the opening began, which pixels stayed dark."""

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]
    log_intensity: NDArray[np.float64]
    open_us: int
    dark: NDArray[np.bool_]


def natural_scene(seed: int, height: int = 120, width: int = 160) -> NDArray[np.float64]:
    """Return a log intensity with a 1/f spectrum through a lens: 3 decades, no detail finer than a pixel or two."""
    random = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :])
    frequency[0, 0] = 1.0
    spectrum = np.fft.rfft2(random.normal(size=(height, width))) / frequency**1.3
    spectrum[0, 0] = 0.0
    scene = cv2.GaussianBlur(np.fft.irfft2(spectrum, (height, width)), (0, 0), 1.0)
    scaled: NDArray[np.float64] = scene * (3 * np.log(10) / (scene.max() - scene.min()))
    return scaled


def record(
    scene: NDArray[np.float64],
    *,
    exponent: float = 2,
    duration_us: int = 20_000,
    lead_us: int = 0,
    mismatch: float = 0.0,
    noise_hz: float = 0.0,
    hot: Sequence[tuple[int, int]] = (),
    dark: NDArray[np.bool_] | None = None,
    start_us: int = 5_000_000,
    seed: int = 0,
) -> Opening:
    """Open an aperture of T = (t/duration)^exponent over *scene*; the brightest pixel fires at 4 % of the opening.

    *lead_us* of closed aperture come first; pixels of *hot* fire at 2 kHz all the time; *dark* pixels see no light.
    """
    random = np.random.default_rng(seed)
    height, width = scene.shape
    open_us = start_us + lead_us
    level = -(scene - scene.max()) + exponent * np.log(0.04) + random.normal(0, mismatch, scene.shape)
    dark = np.zeros(scene.shape, bool) if dark is None else dark
    rows, columns = np.mgrid[:height, :width]
    pieces = []
    for step in range(40):
        since_us = duration_us * np.exp((level + step * CONTRAST) / exponent)
        fires = (since_us < duration_us) & ~dark
        if not fires.any():
            break
        pieces.append((open_us + since_us[fires], columns[fires], rows[fires], np.ones(fires.sum(), int)))
    span_us = lead_us + duration_us
    n_noise = random.poisson(noise_hz * 1e-6 * span_us * scene.size)
    pieces.append(
        (
            start_us + random.uniform(0, span_us, n_noise),
            random.integers(0, width, n_noise),
            random.integers(0, height, n_noise),
            random.integers(0, 2, n_noise),
        )
    )
    for row, column in hot:
        times = np.arange(start_us, start_us + span_us, 500.0)
        pieces.append((times, np.full(times.size, column), np.full(times.size, row), np.ones(times.size, int)))
    t_us, x, y, on = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    order = np.argsort(t_us, kind="stable")
    return Opening(
        np.floor(t_us[order]).astype(np.int64),
        x[order].astype(np.uint16),
        y[order].astype(np.uint16),
        on[order].astype(np.uint8),
        scene,
        open_us,
        dark,
    )
