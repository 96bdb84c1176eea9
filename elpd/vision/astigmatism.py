"""Off its axis a lens focuses edges of one direction before those of the other: where focus is all the same.

To first order in defocus an astigmatic lens sharpens waves of direction θ best at ``focus + a·cos 2θ + b·sin 2θ``, and
the mean over all directions, ``focus``, is where the point spread function has its least RMS radius. A picture shows
the mean over the directions that *it* has: bricks, behind the corner of a traced F/2 lens, are sharpest 14 um early, a
depth of focus. But its spectrum shows more: in wedges of direction the same bricks have peaks 26 um apart, which tell a
and b, and with them where a picture with edges of all directions would be sharpest.

The spectrum of each image is summed in polar bins, once, and those are weighed by the bands of ``integral.BANDS_PX``.
White noise, measured next to the sampling limit as in ``bands``, is subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.integral import BANDS_PX, fit_vertex, inside_margin, with_window

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

WEDGES = 4
"""Wedges of direction, half overlapping: 0, 45, 90 and 135 degrees. Three would do; the fourth tells the error."""

ASTIGMATISM = 0.05
"""Standard deviation, in widths of the curve, of a and of b before anything is seen: the fields of a traced F/2 lens
have 0, 0.02, 0.08 and 0.17, and what lies on the axis is mostly looked at."""

UNEXPLAINED = 0.1
"""Share of the correction that may be wrong: a lens has terms beyond the second harmonic (0.05 to 0.1 of it)."""

UNEXPLAINED_OF_EVENTS = 0.25
"""The same where events built the image: pixels that hold back smooth peaks over (a fifth of a is missed)."""

BUILT_BY_EVENTS = 0.02
"""Standard deviation of a and b of an image that events built, in widths, whatever the scatter: 54 sweeps of one seed
through the lens's four fields have 0.01 to 0.02, in violent motion 0.03."""

LEAST_SIGMA = 0.005
"""Standard error of a wedge's vertex at the least, in widths, as of a band's."""

HELD_BACK = 0.15
"""Error of a wedge's vertex, in widths, over the noise in it relative to its picture, as of whole bands
(``witness.HELD_BACK``): what pixels hold back is not quite white. Bars have only that in three wedges of four."""

TAPER_PX = 4.0
"""The region fades out over its border, so that its frame has no edges of its own."""

DIRECTION_PX = 1.2
"""Scale of the edges whose directions are asked for pixel by pixel."""

_RINGS, _SECTORS = 64, 32
_COARSEST_PX = 1.6 * BANDS_PX[-1]
_FLOOR = 1e-3


@dataclass(frozen=True, slots=True)
class Edges:
    """What an image has of edges of each direction.

    ``energy`` (bands, wedges), freed of white noise; ``towards`` (bands, wedges, 2), the mean of cos 2θ and sin 2θ over
    it, θ the direction across the edge from x to y; ``noise`` (bands, wedges), what was taken off over what is left.
    """

    energy: NDArray[np.float64]
    towards: NDArray[np.float64]
    noise: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Astigmatism:
    """The coefficients a and b, (2,), their covariance (2, 2), and where the picture's edges point: (bands, 2).

    Lengths are on the caller's ruler. ``unexplained`` is the share of a shift that may be wrong.
    """

    at: NDArray[np.float64]
    covariance: NDArray[np.float64]
    towards: NDArray[np.float64]
    unexplained: float = UNEXPLAINED

    def shift(self, towards: NDArray[np.float64]) -> tuple[float, float]:
        """Return how far beyond focus edges are sharpest that point *towards*, (2,), and a standard error."""
        shift = float(self.at @ towards)
        return shift, float(np.sqrt(towards @ self.covariance @ towards + (self.unexplained * shift) ** 2))

    def mirrored(self) -> Astigmatism:
        """Return the same on a ruler that runs the other way."""
        return replace(self, at=-self.at)


@dataclass(frozen=True, slots=True)
class _Polar:
    """Bins of a spectrum: each coefficient's bin, how often it counts; by bin that count and the corner's response.

    ``response`` (bins, bands, wedges, 3): of each band in each wedge, and that times cos 2θ and sin 2θ.
    """

    bin_of: NDArray[np.int64]
    twice: NDArray[np.float64]
    count: NDArray[np.float64]
    corner: NDArray[np.float64]
    response: NDArray[np.float64]


@lru_cache(maxsize=4)
def _polar(height: int, width: int) -> _Polar:
    down, right = np.meshgrid(2.0 * np.pi * np.fft.fftfreq(height), 2.0 * np.pi * np.fft.rfftfreq(width), indexing="ij")
    radius, angle = np.hypot(down, right), np.arctan2(down, right) % np.pi
    ring = np.minimum((radius / (np.sqrt(2.0) * np.pi) * _RINGS).astype(np.int64), _RINGS - 1)
    sector = np.minimum((angle / np.pi * _SECTORS).astype(np.int64), _SECTORS - 1)
    bin_of = (ring * _SECTORS + sector).ravel()
    # A real transform has each of its inner columns for two.
    twice = np.full(radius.shape, 2.0)
    twice[:, 0] = 1.0
    if width % 2 == 0:
        twice[:, -1] = 1.0
    bins = _RINGS * _SECTORS
    count = np.bincount(bin_of, twice.ravel(), bins).astype(np.float64)

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        summed = np.bincount(bin_of, (values * twice).ravel(), bins)
        return np.asarray(summed / np.maximum(count, 1e-12), dtype=np.float64)

    corner = mean(np.square((2.0 - 2.0 * np.cos(right)) * (2.0 - 2.0 * np.cos(down)) / 6.0))
    response = np.empty((bins, len(BANDS_PX), WEDGES, 3))
    harmonics = (np.ones_like(angle), np.cos(2.0 * angle), np.sin(2.0 * angle))
    for band, scale_px in enumerate(BANDS_PX):
        passed = np.exp(-0.5 * (scale_px * radius) ** 2) - np.exp(-0.5 * (1.6 * scale_px * radius) ** 2)
        for wedge in range(WEDGES):
            off = (angle - wedge * np.pi / WEDGES + 0.5 * np.pi) % np.pi - 0.5 * np.pi
            inside = np.where(np.abs(off) < np.pi / WEDGES, np.square(np.cos(0.5 * WEDGES * off)), 0.0)
            for k, harmonic in enumerate(harmonics):
                response[:, band, wedge, k] = mean(np.square(passed) * inside * harmonic)
    return _Polar(bin_of, twice.ravel(), count, corner, response)


def edges_of(image: NDArray[np.float32], weight: NDArray[np.float32], margin: int = 0) -> Edges:
    """Return an image's edges by band and direction.

    Parameters
    ----------
    image, weight
        (height, width): the levels, and each pixel's say in their sharpness.
    margin
        Pixels at each side that do not count.
    """
    return edges_of_each([image], weight, margin)[0]


def edges_of_each(images: Iterable[NDArray[np.float32]], weight: NDArray[np.float32], margin: int = 0) -> list[Edges]:
    """Return the same of images whose pixels have the same say."""
    inside = inside_margin(weight.shape, margin)
    seen = np.zeros(weight.shape, np.float32)
    seen[inside] = weight[inside]
    fading = np.sqrt(np.maximum(cv2.GaussianBlur(seen, (0, 0), TAPER_PX), 0.0))
    return [_edges(image, fading) for image in images]


def _edges(image: NDArray[np.float32], fading: NDArray[np.float32]) -> Edges:
    fine = image - cv2.GaussianBlur(image, (0, 0), _COARSEST_PX)
    power = np.square(np.abs(np.fft.rfft2(fine * fading))).ravel()
    polar = _polar(*image.shape)
    summed = np.bincount(polar.bin_of, power * polar.twice, polar.count.size)
    white = float(summed @ polar.corner) / float(polar.count @ polar.corner)
    pure = summed - white * polar.count
    raw, energy = (np.tensordot(one, polar.response[..., 0], 1) for one in (summed, pure))
    freed = np.asarray(np.maximum(energy, _FLOOR * raw + 1e-12), dtype=np.float64)
    towards = np.tensordot(np.maximum(pure, 0.0), polar.response, 1)
    return Edges(freed, towards[..., 1:] / np.maximum(towards[..., :1], 1e-12), (raw - energy) / freed)


def find_astigmatism(
    position: NDArray[np.float64],
    edges: Sequence[Edges],
    half_width: float,
    width: float,
    *,
    of_events: bool = False,
) -> Astigmatism:
    """Return the astigmatism that the wedges' vertices show.

    Parameters
    ----------
    position, edges
        Rising positions of the lens, and the edges of the image at each.
    half_width
        Points that far from a vertex are used.
    width
        Of the finest band's curve.
    of_events
        Whether events built the images.
    """
    energy = np.log(np.array([one.energy for one in edges]))
    top = int(np.argmax(energy[:, 0].sum(axis=-1)))
    towards, share = edges[top].towards, edges[top].energy
    bands = energy.shape[1]
    mean = (share[..., None] * towards).sum(axis=1) / share.sum(axis=1)[:, None]
    rows, places, errors = [], [], []
    for band in range(bands):
        for wedge in range(WEDGES):
            curve = energy[:, band, wedge]
            vertex = with_window(fit_vertex(position, curve, half_width), position, curve, half_width)
            if vertex is None:
                continue
            row = np.zeros(bands + 2)
            row[band] = 1.0
            row[bands:] = towards[band, wedge]
            rows.append(row)
            places.append(vertex.at)
            # As of a whole band: what is coarse has little structure, and tilts move wide curves the most.
            own = max(vertex.sigma, LEAST_SIGMA * width) * max(1.0, vertex.width / width) ** 3
            errors.append(float(np.hypot(own, HELD_BACK * edges[top].noise[band, wedge] * width)))
    unexplained, unseen = (UNEXPLAINED_OF_EVENTS, BUILT_BY_EVENTS) if of_events else (UNEXPLAINED, 0.0)
    known, right = _marginal(np.array(rows).reshape(-1, bands + 2), np.array(places), np.array(errors), bands)
    # What no scatter shows makes the measurement less: (J⁻¹ + s²)⁻¹ in place of J. Then what was known before comes in.
    less = np.linalg.inv(np.eye(2) + (unseen * width) ** 2 * known)
    covariance = np.linalg.inv(less @ known + np.eye(2) * (ASTIGMATISM * width) ** -2.0)
    return Astigmatism(covariance @ less @ right, covariance, mean, unexplained)


def _marginal(
    design: NDArray[np.float64], at: NDArray[np.float64], sigma: NDArray[np.float64], bands: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what the wedges tell of a and b: the normal matrix (2, 2) and its right side, each band's focus unknown.

    Wedges that disagree by more than their errors tell the less (Birge's ratio).
    """
    if not at.size:
        return np.zeros((2, 2)), np.zeros(2)
    weighted = design.T / np.square(sigma)
    normal, right = weighted @ design, weighted @ at
    least = 1e-9 * np.trace(normal)
    off = (at - design @ np.linalg.solve(normal + least * np.eye(bands + 2), right)) / sigma
    worse = max(1.0, float(off @ off) / max(1, at.size - bands - 2))
    gone = normal[bands:, :bands] @ np.linalg.inv(normal[:bands, :bands] + least * np.eye(bands))
    known = normal[bands:, bands:] - gone @ normal[:bands, bands:]
    return known / worse, (right[bands:] - gone @ right[:bands]) / worse


def directions(level: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return cos 2θ and sin 2θ of the edges about each pixel, (height, width, 2); zero where they have no direction."""
    smooth = cv2.GaussianBlur(level, (0, 0), DIRECTION_PX)
    down, right = np.gradient(smooth)
    tensor = [cv2.GaussianBlur(one, (0, 0), 2.0 * DIRECTION_PX) for one in (right**2, down**2, right * down)]
    whole = np.maximum(tensor[0] + tensor[1], 1e-12)
    return np.stack([(tensor[0] - tensor[1]) / whole, 2.0 * tensor[2] / whole], axis=-1).astype(np.float64)
