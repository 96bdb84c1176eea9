"""A curve of log sharpness along the sweep, and the two questions that are asked of it while it grows.

Has it passed a peak: did it rise and then fall by more than its own scatter? And where was the peak? The same curve is
drawn from frames (the sharpest witness where there are any) and from the image that events keep up to date.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.astigmatism import Edges, edges_of
from elpd.vision.bands import CORNER, band_energies, corner_image, focus_of_bands
from elpd.vision.drift import shift_px
from elpd.vision.integral import (
    BANDS_PX,
    Vertex,
    band_gain,
    band_image,
    band_stamp,
    fit_vertex,
    inside_margin,
    stamp_events,
)
from elpd.vision.reference import full_scale

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Roi
    from elpd.vision.bands import BandFocus

DROP = 0.10
"""Fall of log S that makes a peak a peak: the blur of 0.45 widths of the curve, under three depths of focus."""

RISE = 0.10
"""Rise of log S before it: a sweep that begins in focus has no peak inside."""

FIT_DROP = 0.25
"""How far down the curve's sides a parabola is believed."""

FRAME_GROUND = 10.0 / 255.0
"""Added to a frame's brightness, of which one is full scale, before its logarithm: read noise shows no structure."""

FOLLOW_PX = 1.2
"""Scale of the structure by which a scene is followed: it is there in every frame around focus."""

USUAL_THRESHOLD = 0.2
"""A contrast threshold of event cameras as they are set. A direction is right with a third less or more of it."""

POINT = np.ones((1, 1), np.float32)
"""The stamp that adds an event to nothing but its own pixel."""

CHANCE_SIGMAS = 3.0
"""What noise leaves of S, once it is subtracted, is told from nothing only beyond so many standard deviations."""

APART_PX = 3
"""The corner band of pixels so far apart has no pixel in common."""

_FLOOR = 1e-12
_GAIN = band_gain(BANDS_PX[0])


@dataclass(frozen=True, slots=True)
class Sharpness:
    """What a frame shows: log S in each band, (bands,), and where its edges point."""

    bands: NDArray[np.float64]
    edges: Edges | None = None


class PeakTrack:
    """A growing curve of (position, log S)."""

    def __init__(self) -> None:
        self.times_us: list[int] = []
        self.positions: list[float] = []
        self.values: list[float] = []
        self._sharpness: list[Sharpness] = []
        self._peak = 0
        self._lowest_before_peak = float("inf")
        self._lowest = float("inf")

    def add_sharpness(self, t_us: int, position: float, sharpness: Sharpness) -> None:
        """Append a point of which all bands are known: the finest is the curve, all of them tell the focus."""
        self._sharpness.append(sharpness)
        self.add(t_us, position, float(sharpness.bands[0]))

    def add(self, t_us: int, position: float, value: float) -> None:
        """Append a point; times rise."""
        if not self.values or value > self.values[self._peak]:
            self._peak = len(self.values)
            self._lowest_before_peak = self._lowest
        self._lowest = min(self._lowest, value)
        self.times_us.append(t_us)
        self.positions.append(position)
        self.values.append(value)

    def __len__(self) -> int:
        return len(self.values)

    @property
    def peak(self) -> int:
        """Index of the highest point so far."""
        return self._peak

    @property
    def rise(self) -> float:
        """How far the curve had risen, from its lowest point before the peak."""
        return self.values[self._peak] - min(self._lowest_before_peak, self.values[self._peak]) if self.values else 0.0

    @property
    def drop(self) -> float:
        """How far it has fallen since the peak."""
        return self.values[self._peak] - self.values[-1] if self.values else 0.0

    @property
    def scatter(self) -> float:
        """One standard deviation of the curve about a smooth one, at the scale of its own peak.

        From second differences of up to 32 averages between the flank and now: neighbouring points share most of
        their error, so their own differences would flatter them.
        """
        values = np.array(self.values[self.flank(1.0) :])
        if values.size < 6:
            return 0.0
        edges = np.linspace(0, values.size, min(32, values.size) + 1).astype(np.int64)
        means = np.add.reduceat(values, edges[:-1]) / np.diff(edges)
        second = np.diff(means, 2)
        return float(np.median(np.abs(second - np.median(second))) / 0.6745 / np.sqrt(6.0))

    @property
    def passed(self) -> bool:
        """Whether the curve has risen to a peak and fallen from it, beyond scatter."""
        if len(self) < 3 or self.rise <= RISE or self.drop <= DROP:
            return False  # the scatter is asked for last: this is looked at all through a sweep
        needed = 6.0 * self.scatter
        return self.rise > needed and self.drop > needed

    def flank(self, depth: float) -> int:
        """Return the index from which on, before the peak, the curve stays within *depth* of it."""
        k = self._peak
        while k > 0 and self.values[k - 1] > self.values[self._peak] - depth:
            k -= 1
        return k

    def vertex(self) -> Vertex | None:
        """Return the vertex of the parabola through what lies within ``FIT_DROP`` of the peak."""
        if len(self) < 3:
            return None
        begin = self.flank(2.0 * FIT_DROP)
        z = np.array(self.positions[begin:])
        y = np.array(self.values[begin:])
        if z[-1] < z[0]:
            z = -z
            vertex = self._fit(z, y)
            return None if vertex is None else Vertex(-vertex.at, vertex.sigma, vertex.width, vertex.points)
        return self._fit(z, y)

    @staticmethod
    def _fit(z: NDArray[np.float64], y: NDArray[np.float64]) -> Vertex | None:
        wide = fit_vertex(z, y, float(np.ptp(z)))
        if wide is None:
            return None
        reach = wide.width * float(np.sqrt(2.0 * FIT_DROP))
        vertex = fit_vertex(z, y, reach) or wide
        narrow = fit_vertex(z, y, 0.7 * reach)
        # Points of one curve share what motion does to them; how the answer moves with the window tells more than
        # their scatter.
        moved = 0.0 if narrow is None else abs(narrow.at - vertex.at)
        return replace(vertex, sigma=float(np.hypot(vertex.sigma, 0.7 * moved)))

    def focus(self) -> BandFocus | None:
        """Return the focus of parabolas through what lies within ``FIT_DROP`` of the peak, of points with all bands."""
        if len(self._sharpness) != len(self) or len(self) < 3:
            return None
        begin = self.flank(2.0 * FIT_DROP)
        z = np.array(self.positions[begin:])
        bands = np.array([one.bands for one in self._sharpness[begin:]])
        edges = [one.edges for one in self._sharpness[begin:] if one.edges is not None]
        sign = -1.0 if z[-1] < z[0] else 1.0
        wide = fit_vertex(sign * z, bands[:, 0], float(np.ptp(z)))
        if wide is None:
            return None
        found = focus_of_bands(
            sign * z,
            bands,
            wide.width * float(np.sqrt(2.0 * FIT_DROP)),
            edges=edges if len(edges) == z.size else None,
        )
        return None if found is None else found.mirrored(sign)


def frame_levels(pixels: NDArray[np.generic]) -> NDArray[np.float32]:
    """Return a frame's log brightness, (height, width), counted in contrast thresholds of a usual setting."""
    scale = full_scale(pixels) or 1.0
    image = pixels.astype(np.float32) / np.float32(scale)
    return np.asarray(np.log(image + np.float32(FRAME_GROUND)) / np.float32(USUAL_THRESHOLD), dtype=np.float32)


class FrameEnergy:
    """``log S`` of whole frames over a region, weighted by the brightness of each.

    (That of the first would stay where it is while the scene goes on: bright parts in dark ones' place tilt the curve.)
    With *follow* the region goes with the scene, from frame to frame by phase correlation, as far as the margin lets
    it: what a shaking hand moves in and out of a region that stands still would pass for focus.
    """

    def __init__(self, roi: Roi, margin: int, *, follow: bool = False) -> None:
        self._roi = roi
        self._margin = margin
        self._follow = follow
        self._before: NDArray[np.float32] | None = None
        self._shift_px = np.zeros(2)

    def measure(self, pixels: NDArray[np.generic]) -> Sharpness:
        """Return log S of a frame, 8 or 16 bit, in each band, and where its edges point."""
        roi, margin = self._roi, self._margin
        top, left = max(0, roi.y - margin), max(0, roi.x - margin)
        part = pixels[top : roi.y + roi.height + margin, left : roi.x + roi.width + margin]
        scale = full_scale(pixels) or 1.0
        image = part.astype(np.float32) / np.float32(scale)
        smooth = cv2.GaussianBlur(image, (0, 0), 4.0) + np.float32(1e-6)
        weight = np.asarray(smooth / smooth.mean(), dtype=np.float32)
        inside = np.zeros_like(image)
        inside[roi.y - top : roi.y - top + roi.height, roi.x - left : roi.x - left + roi.width] = 1.0
        levels = np.log(image + np.float32(FRAME_GROUND))
        weight = weight * self._moved(inside, levels)
        return Sharpness(np.log(band_energies(levels, weight) + _FLOOR), edges_of(levels, weight))

    def _moved(self, inside: NDArray[np.float32], levels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the region's mask where its scene has gone to."""
        if not self._follow:
            return inside
        band = cv2.GaussianBlur(levels, (0, 0), FOLLOW_PX) - cv2.GaussianBlur(levels, (0, 0), 4 * FOLLOW_PX)
        if self._before is not None:
            step = shift_px(self._before, np.asarray(band, np.float32))
            self._shift_px = np.clip(self._shift_px + step, -self._margin, self._margin)
        self._before = np.asarray(band, np.float32)
        shift = np.array([[1.0, 0.0, self._shift_px[0]], [0.0, 1.0, self._shift_px[1]]])
        return np.asarray(cv2.warpAffine(inside, shift, (inside.shape[1], inside.shape[0])), np.float32)


class EventEnergy:
    """``log S`` of the image that events build, from nothing or upon a *start*, (height, width), in thresholds.

    The band-passed image is what is measured: an event adds the band's impulse response around its pixel, a hundred
    products, and a look at the sharpness is a sum of squares. Filtering the image anew at every look would cost the
    whole region each time, at 4 mm/s more than a thousand times a second.

    Noise events walk at random, so what they add to S grows as long as the sweep lasts, and in dim light hides that
    focus is over. It is white: the band next to the sampling limit tells how much of it there is (``vision.bands``),
    and that is subtracted.
    """

    def __init__(self, height: int, width: int, margin: int, start: NDArray[np.float32] | None = None) -> None:
        self.image = np.zeros((height, width), dtype=np.float32) if start is None else start.copy()
        """The image itself, in thresholds."""
        self._bands = [np.zeros((height, width), np.float32) for _ in range(2)] if start is None else _fine(start)
        self._stamps = (band_stamp(BANDS_PX[0]), CORNER)
        self._inside = inside_margin((height, width), margin)
        pixels = self.image[self._inside].size
        self._by_chance = CHANCE_SIGMAS * float(np.sqrt(2.0 * _freed_patch() / pixels))
        self.raw = 0.0
        """S at the last look, with its noise."""
        self.white = True
        """Whether what is noise is white: what whole periods of a lamp leave behind is not."""

    def add(self, x: NDArray[np.uint16], y: NDArray[np.uint16], on: NDArray[np.uint8]) -> None:
        """Take events, in coordinates of the image."""
        for stamp, band in zip(self._stamps, self._bands, strict=True):
            stamp_events(x, y, on, stamp, band)
        stamp_events(x, y, on, POINT, self.image)

    def measure(self) -> float:
        """Return log S now, freed of white noise as far as chance lets it be told."""
        energy, corner = (np.square(band[self._inside]) for band in self._bands)
        self.raw = float(energy.mean(dtype=np.float64))
        if not self.white:
            return float(np.log(self.raw + _FLOOR))
        noise = min(_GAIN * float(corner.mean(dtype=np.float64)), self.raw)
        # Each pixel's noise is taken off whole; chance is in what neighbours make together. A hot pixel is alone.
        together = _GAIN * float(np.sqrt((corner[:, :-APART_PX] * corner[:, APART_PX:]).mean(dtype=np.float64)))
        return float(np.log(max(self.raw - noise, self._by_chance * min(noise, together)) + _FLOOR))


def _fine(image: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    return [band_image(image, BANDS_PX[0]), corner_image(image)]


@cache
def _freed_patch() -> float:
    """Return the variance of S of white noise, freed of noise, as the patch of pixels that count as one sample."""
    size = 65
    impulse = np.zeros((size, size), dtype=np.float32)
    impulse[size // 2, size // 2] = 1.0
    band, corner = (np.square(np.abs(np.fft.fft2(one))) for one in _fine(impulse))
    return float(np.square(band - _GAIN * corner).mean() / band.mean() ** 2)
