"""The band energy S of the image that the events themselves keep up to date, and the vertex of its logarithm.

``dS/dt`` of ``S = Σ A·|B·L|²`` (B a band-pass, L the log image) *is* the Event Laplacian Product with a reference that
is always current. S depends on the amplitude spectrum alone, so scene motion leaves it unchanged, and a Gaussian blur
makes ``log S`` a parabola in the lens position whose vertex is focus. No registration, no sharp
picture, no contrast threshold: L is counted in thresholds, from zero at the start of the sweep. What the start picture
looked like does not matter, because ``|h(z) - h(z_start)|²`` is as symmetric in defocus as ``|h(z)|²``.

Events say where a level was crossed, not where the intensity is: a pixel that has turned stays silent until it has
fallen by what it had risen beyond its last event, plus one threshold. So the image at a decision is *rebuilt*: levels
are joined linearly, and at a turn the mirror of the last rise is inserted (the idea of ``pairs``, per pixel). Threshold
mismatch between pixels adds a pattern that is white in space; ``elpd.vision.bands`` measures and subtracts it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

BANDS_PX = (0.8, 1.2, 1.8, 2.7)
"""Inner standard deviations of the difference-of-Gaussian bands; the outer is 1.6 times larger."""

_BAND_RATIO = 1.6


def inside_margin(shape: tuple[int, ...], margin: int) -> tuple[slice, slice]:
    """Return what a margin of *margin* pixels at each side leaves of an image.

    Of a small image less is left out: at least its middle eight pixels are measured.
    """
    margin = max(0, min(margin, (min(shape) - 8) // 2))
    return slice(margin, -margin or None), slice(margin, -margin or None)


def band_energy(image: NDArray[np.float32], scale_px: float, weight: NDArray[np.float32], margin: int = 0) -> float:
    """Return the weighted mean square of one band of *image*, leaving a margin out of the mean (``inside_margin``)."""
    inside = inside_margin(image.shape, margin)
    square = np.square(band_image(image, scale_px)[inside])
    square *= weight[inside]
    return float(square.mean(dtype=np.float64))


def band_stamp(scale_px: float) -> NDArray[np.float32]:
    """Return a band's impulse response, square and of odd size."""
    impulse = np.zeros((33, 33), dtype=np.float32)
    impulse[16, 16] = 1.0
    response = band_image(impulse, scale_px)
    reach = int(np.abs(np.flatnonzero(response[16]) - 16).max())
    return np.ascontiguousarray(response[16 - reach : 17 + reach, 16 - reach : 17 + reach])


def band_gain(scale_px: float) -> float:
    """Return the variance that white noise of unit variance has in a band: the sum of the response's squares."""
    return float(np.square(band_stamp(scale_px), dtype=np.float64).sum())


def band_patch(scale_px: float) -> float:
    """Return over how many pixels white noise is one and the same in a band: the patch that counts as one sample."""
    impulse = np.zeros((65, 65), dtype=np.float32)
    impulse[32, 32] = 1.0
    power = np.square(np.abs(np.fft.fft2(band_image(impulse, scale_px))))
    return float(np.square(power).mean() / power.mean() ** 2)


def band_image(image: NDArray[np.float32], scale_px: float) -> NDArray[np.float32]:
    """Return a band of *image*: a difference of Gaussians, *scale_px* the narrower one's sigma."""
    band = cv2.GaussianBlur(image, (0, 0), scale_px)
    band -= cv2.GaussianBlur(image, (0, 0), scale_px * _BAND_RATIO)
    return np.asarray(band, dtype=np.float32)


@kernel("void(uint16[::1], uint16[::1], uint8[::1], float32[:, ::1], float32[:, ::1])")
def stamp_events(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    stamp: NDArray[np.float32],
    band: NDArray[np.float32],
) -> None:
    """Add *stamp* around the pixel of each ON event to *band*, (height, width), and subtract it for each OFF event.

    What falls outside is lost.
    """
    height, width = band.shape
    size = stamp.shape[0]
    reach = size // 2
    for i in range(x.size):
        sign = np.float32(1.0) if on[i] else np.float32(-1.0)
        left = np.int64(x[i]) - reach
        top = np.int64(y[i]) - reach
        begin = max(0, -left)
        end = min(size, width - left)
        for row in range(max(0, -top), min(size, height - top)):
            target = band[top + row, left + begin : left + end]
            source = stamp[row, begin:end]
            for column in range(target.size):
                target[column] += sign * source[column]


@kernel("void(int64[::1], float64[::1], float64[::1], float64[::1], float32[:, ::1])")
def rebuild_levels(
    starts: NDArray[np.int64],
    position: NDArray[np.float64],
    steps: NDArray[np.float64],
    ticks: NDArray[np.float64],
    level: NDArray[np.float32],
) -> None:
    """Rebuild each pixel's level at each tick from its events, without the hysteresis of the sensor.

    Parameters
    ----------
    starts:
        Events of pixel ``k``, in time order, are ``starts[k] : starts[k + 1]``.
    position, steps:
        Lens position (rising with time) of each event, and how far the level went with it (positive for an ON event, in
        thresholds: one, or more by ``losses.steps_with_losses``), grouped by pixel (``group_by_pixel``).
    ticks:
        Positions at which the levels are wanted, rising.
    level:
        Output, (ticks, pixels): level in thresholds, zero at the beginning.
    """
    n_ticks = ticks.size
    for k in range(starts.size - 1):
        begin = starts[k]
        end = starts[k + 1]
        tick = 0
        value = 0.0
        at = -1e300  # where the last knot lies; before the first event the level is constant
        for i in range(begin, end):
            here = position[i]
            step = steps[i]
            if i == begin:
                while tick < n_ticks and ticks[tick] < here:
                    level[tick, k] = value
                    tick += 1
            else:
                last = position[i - 1]
                if steps[i - 1] * step < 0.0:
                    # The turn: the level of the last event is met again on the way back.
                    mirrored = 0.5 * (last + here)
                    if i - 2 >= begin and steps[i - 2] * steps[i - 1] > 0.0:
                        mirrored = max(here - (last - position[i - 2]), mirrored)
                    at = mirrored
                else:
                    at = last
                while tick < n_ticks and ticks[tick] < at:
                    level[tick, k] = value
                    tick += 1
                width = here - at
                while tick < n_ticks and ticks[tick] < here:
                    part = (ticks[tick] - at) / width if width > 0.0 else 1.0
                    level[tick, k] = value + step * part
                    tick += 1
            value += step
        while tick < n_ticks:
            level[tick, k] = value
            tick += 1


@dataclass(frozen=True, slots=True)
class Vertex:
    """Where ``log S`` peaks, one standard error from the scatter about the parabola, and the curve's own width.

    ``width`` is the standard deviation of the Gaussian that S follows near its peak, in the unit of the positions;
    it is the natural ruler of an optical system whose depth of focus nobody has told.
    """

    at: float
    sigma: float
    width: float
    points: int


def group_by_pixel(pixel: NDArray[np.int64], pixels: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return (starts, order): a stable sort of event indices by pixel."""
    starts = np.zeros(pixels + 1, dtype=np.int64)
    order = np.empty(pixel.size, dtype=np.int64)
    sort_by_pixel(pixel, starts, order)
    return starts, order


@kernel("void(int64[::1], int64[::1], int64[::1])")
def sort_by_pixel(pixel: NDArray[np.int64], starts: NDArray[np.int64], order: NDArray[np.int64]) -> None:
    """Sort event indices by pixel, stably, by counting.

    *starts*, (pixels + 1), begins as zeros; afterwards the events of pixel ``k`` are
    ``order[starts[k] : starts[k + 1]]``.
    """
    for i in range(pixel.size):
        starts[pixel[i]] += 1
    behind = 0
    for k in range(starts.size):
        count = starts[k]
        starts[k] = behind
        behind += count
    for i in range(pixel.size):
        order[starts[pixel[i]]] = i
        starts[pixel[i]] += 1
    for k in range(starts.size - 1, 0, -1):
        starts[k] = starts[k - 1]
    starts[0] = 0


def fit_vertex(position: NDArray[np.float64], log_energy: NDArray[np.float64], half_width: float) -> Vertex | None:
    """Fit a parabola over a window that is kept symmetric about its own vertex; ``None`` if there is no peak inside.

    The window is what the data past the vertex allow, at most *half_width*. A window that is not symmetric would turn
    every departure from a parabola into bias.
    """
    if position.size < 3:
        return None
    at = float(position[int(np.argmax(log_energy))])
    result = None
    for _ in range(8):
        reach = min(half_width, float(position[-1]) - at, at - float(position[0]))
        inside = np.abs(position - at) <= reach * (1.0 + 1e-9)
        if int(inside.sum()) < 3:
            nearest = np.sort(np.argsort(np.abs(position - at), kind="stable")[:3])
            inside = np.zeros(position.size, dtype=bool)
            inside[nearest] = True
        result = _parabola(position[inside], log_energy[inside])
        if result is None or not position[inside][0] <= result.at <= position[inside][-1]:
            return None
        if abs(result.at - at) < 1e-3 * max(reach, 1e-12):
            break
        at = result.at
    return result


def with_window(
    vertex: Vertex | None, position: NDArray[np.float64], log_energy: NDArray[np.float64], half_width: float
) -> Vertex | None:
    """Add to a vertex' error how it moves with the window, which tells more than the scatter of neighbours."""
    if vertex is None:
        return None
    narrow = fit_vertex(position, log_energy, 0.7 * half_width)
    moved = 0.5 * half_width if narrow is None else abs(narrow.at - vertex.at)
    return replace(vertex, sigma=float(np.hypot(vertex.sigma, 0.7 * moved)))


def _parabola(position: NDArray[np.float64], log_energy: NDArray[np.float64]) -> Vertex | None:
    middle = float(position.mean())
    scale = float(np.ptp(position)) / 2.0
    if scale <= 0.0:
        return None
    z = (position - middle) / scale
    # In polynomials that are orthogonal over these positions the coefficients do not depend on one another.
    square = z * z
    of_line = float(square.sum())
    skew, mean_square = float(square @ z) / of_line, of_line / z.size
    bend = square - skew * z - mean_square
    of_bend = float(bend @ bend)
    if of_bend <= 1e-12 * of_line:
        return None  # two places only
    mean = float(log_energy.mean())
    slope, curvature = float(z @ log_energy) / of_line, float(bend @ log_energy) / of_bend
    if curvature >= 0.0:
        return None
    at = 0.5 * skew - slope / (2.0 * curvature)
    residual = log_energy - mean - slope * z - curvature * bend
    freedom = position.size - 3
    variance = float(residual @ residual) / freedom if freedom > 0 else 0.0
    sigma = sqrt(variance * (1.0 / of_line + (slope / curvature) ** 2 / of_bend)) / (-2.0 * curvature)
    width = sqrt(-1.0 / (2.0 * curvature))
    return Vertex(middle + scale * at, scale * sigma, scale * width, int(position.size))
