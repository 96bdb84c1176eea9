"""A small world for detector tests: a picture, Gaussian blur, a lens that sweeps, threshold pixels.

Every pixel compares its log intensity with its own last level at even steps of time and emits at most one event per
step, stamped inside the step where the straight line crosses the threshold.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class World:
    """What was simulated: events in time order, frames with times, the truth."""

    t_us: np.ndarray
    x: np.ndarray
    y: np.ndarray
    on: np.ndarray
    frames: list[tuple[int, np.ndarray]]
    focus_us: int
    size: int


def picture(size: int, seed: int, slope: float = 1.0, contrast: float = 0.45) -> np.ndarray:
    """Return a picture with the spectrum of natural ones, in linear light around 100."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    frequency[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) / frequency**slope
    field = np.fft.irfft2(spectrum, s=(size, size))
    field = (field - field.mean()) / field.std()
    return 100.0 * np.exp(contrast * np.clip(field, -2.5, 2.5))


def sweep(
    *,
    seed: int = 0,
    size: int = 96,
    start_um: float = -150.0,
    end_um: float = 150.0,
    speed_um_s: float = 4000.0,
    blur_px_per_um: float = 0.0233,
    least_blur_px: float = 0.35,
    threshold: float = 0.15,
    mismatch: float = 0.03,
    noise_hz: float = 1.0,
    frame_every_us: int | None = None,
    shake_px: float = 0.0,
    scene: np.ndarray | None = None,
    step_us: int = 200,
    lamp_hz: float = 0.0,
    lamp_depth: float = 0.0,
) -> World:
    """Sweep the lens from *start_um* to *end_um* (focus is at zero) and return what the camera saw.

    The light swings by *lamp_depth* of itself at *lamp_hz*.
    """
    rng = np.random.default_rng(seed + 1)
    scene = picture(size, seed) if scene is None else scene
    duration_us = abs(end_um - start_um) / speed_um_s * 1e6
    steps = int(duration_us / step_us)
    wall = np.full((size, size), threshold) * (1.0 + mismatch * rng.standard_normal((size, size)))
    shift = np.zeros(2)
    level = previous = None
    pieces, frames = [], []
    next_frame_us = 0
    for k in range(steps + 1):
        now_us = k * step_us
        z = start_um + (end_um - start_um) * k / steps
        moved = scene
        if shake_px:
            shift += shake_px * rng.standard_normal(2)
            matrix = np.float64([[1, 0, shift[0]], [0, 1, shift[1]]])
            moved = cv2.warpAffine(scene, matrix, (size, size), borderMode=cv2.BORDER_WRAP)
        sigma = float(np.hypot(least_blur_px, blur_px_per_um * z))
        image = cv2.GaussianBlur(moved, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
        image *= 1.0 + lamp_depth * np.sin(2e-6 * np.pi * lamp_hz * now_us)
        if frame_every_us is not None and now_us >= next_frame_us:
            frames.append((now_us, np.clip(np.rint(image), 0, 255).astype(np.uint8)))
            next_frame_us += frame_every_us
        now = np.log(image + 2.0)
        if level is None:
            level = now + wall * rng.uniform(-1.0, 1.0, now.shape)
            previous = now
            continue
        change = now - level
        fired = np.abs(change) >= wall
        y, x = np.nonzero(fired)
        up = change[fired] > 0
        crossed = level[fired] + np.where(up, 1, -1) * wall[fired]
        run = now[fired] - previous[fired]
        part = np.clip(np.where(run != 0, (crossed - previous[fired]) / np.where(run == 0, 1, run), 1.0), 0.0, 0.999)
        level[fired] = crossed
        noise = rng.random(now.shape) < noise_hz * step_us * 1e-6
        ny, nx = np.nonzero(noise & ~fired)
        t = np.concatenate([now_us - step_us + part * step_us, now_us - step_us + step_us * rng.random(ny.size)])
        pieces.append(
            (t, np.concatenate([x, nx]), np.concatenate([y, ny]), np.concatenate([up, rng.random(ny.size) < 0.5]))
        )
        previous = now
    t, x, y, on = (np.concatenate(column) for column in zip(*pieces, strict=True))
    t = t.astype(np.int64)
    order = np.argsort(t, kind="stable")
    focus_us = round(-start_um / (end_um - start_um) * steps * step_us)
    columns = (t[order], x[order].astype(np.uint16), y[order].astype(np.uint16), on[order].astype(np.uint8))
    return World(*columns, frames, focus_us, size)
