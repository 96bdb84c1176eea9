"""The sharpness of an image in several bands of spatial frequency, and the one focus behind them.

Two things are the matter with a single band. *Noise*: what is wrong with a pixel's value independently of its
neighbours' (threshold mismatch, what a pixel holds back, refractory losses, a frame's read-out) adds to the energy, and
what grows with time moves the peak. Such noise is white, so the band next to the sampling limit, where a lens leaves
hardly any picture, measures it, and its share in every other band is known from the kernels alone: it is subtracted.
Nothing need be known of the sensor, and whatever picture there is in that band turns in focus like the rest.

*Aberration*: off the axis a lens is sharpest at different positions for different spatial frequencies. For low ones the
transfer function is ``1 - 2π²f²·σ²``, with σ the RMS radius of the point spread function, so their peak is where that
radius is least: the definition of focus that needs no picture, and the one used here. Finer bands depart from it in
proportion to f², but they have the steeper curves. So the bands' vertices are fitted as ``focus + departure·f²``, each
with its own error; where the coarse bands know little, the departure is bounded by what lenses show (``DEPARTURE``).
What edges of one direction depart from those of another is taken off before (``astigmatism``).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.astigmatism import find_astigmatism
from elpd.vision.integral import BANDS_PX, Vertex, band_gain, band_image, fit_vertex, inside_margin, with_window

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.vision.astigmatism import Astigmatism, Edges

DEPARTURE = 0.04
"""Standard deviation, in widths of the curve, of how far the finest band's focus lies from the least RMS radius: the
fields of a traced F/2 lens have 0 to 0.12, mostly little."""

LEAST_SIGMA = 0.005
"""Standard error of a vertex at the least, in widths: curves of log S are parabolas near their top only."""

UNEXPLAINED = 0.4
"""Share of the departure that may be wrong: transfer functions have terms beyond f²."""

_FREQUENCIES = np.array([(BANDS_PX[0] / scale_px) ** 2 for scale_px in BANDS_PX])
CORNER = (np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]) / 6.0).astype(np.float32)
"""The band next to the sampling limit, which measures white noise: a kernel of unit gain for it."""

_GAINS = np.array([band_gain(scale_px) for scale_px in BANDS_PX])
_FLOOR = 1e-3
_SURPRISE = 3.0
_FREEDOM = 8
"""How many independent points a curve has, about: neighbours share most of what is wrong with them."""


def band_energies(image: NDArray[np.float32], weight: NDArray[np.float32], margin: int = 0) -> NDArray[np.float64]:
    """Return the weighted mean square of each band of *image*, (bands,), freed of white noise.

    *margin* pixels at each side are left out of the mean; of a small image less is: at least its middle eight pixels
    are measured.
    """
    bands = filtered(image, margin)
    return freed_of_noise(products(bands, bands, weight[inside_margin(image.shape, margin)]))


def products(
    one: Sequence[NDArray[np.float32]], other: Sequence[NDArray[np.float32]], weight: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return the weighted mean product of each band of two ``filtered`` images, and last that of the band of noise.

    (bands + 1,); *weight* has the size of what is left of the images.
    """
    return np.array([float((a * b * weight).mean(dtype=np.float64)) for a, b in zip(one, other, strict=True)])


def filtered(image: NDArray[np.float32], margin: int = 0) -> list[NDArray[np.float32]]:
    """Return the bands of an image, and last that of noise, without the margin."""
    middle = inside_margin(image.shape, margin)
    bands = [band_image(image, scale_px)[middle] for scale_px in BANDS_PX]
    return [*bands, corner_image(image)[middle]]


def freed_of_noise(energies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Subtract white noise from energies (..., bands + 1), the last of which measures it: (..., bands)."""
    raw = energies[..., :-1]
    return np.asarray(np.maximum(raw - _GAINS * energies[..., -1:], _FLOOR * raw))


def corner_image(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the band of noise of an image, of its size."""
    return np.asarray(cv2.filter2D(image, cv2.CV_32F, CORNER), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class BandFocus:
    """Where focus is, with its error; the finest band's vertex; how far it departs from focus.

    ``scatter`` is how far the points of the two finest bands lie off their parabolas, as an error of the vertex.
    ``as_blur`` says that the finest band rose higher than the next and has the narrower top: blur takes fine structure
    first. The difference of two pictures that lie aside comes and goes in all bands alike, or in coarse ones first.
    ``directed`` is the part of the error that comes of the directions of edges, which is no scatter.
    """

    at: float
    sigma: float
    finest: Vertex
    departure: float
    scatter: float
    as_blur: bool = True
    astigmatism: Astigmatism | None = field(default=None, compare=False)
    directed: float = 0.0

    def mirrored(self, sign: float) -> BandFocus:
        """Return the same on a ruler that runs the other way, where *sign* is -1."""
        finest = replace(self.finest, at=sign * self.finest.at)
        tilt = self.astigmatism.mirrored() if self.astigmatism is not None and sign < 0.0 else self.astigmatism
        return replace(self, at=sign * self.at, finest=finest, departure=sign * self.departure, astigmatism=tilt)


def focus_of_bands(
    position: NDArray[np.float64],
    log_energies: NDArray[np.float64],
    half_width: float,
    bands: int = len(BANDS_PX),
    edges: Sequence[Edges] | None = None,
    *,
    of_events: bool = False,
) -> BandFocus | None:
    """Fit each band's parabola, (points, bands), and the focus behind them; ``None`` if the finest has no peak.

    No more than the *bands* finest ones are believed. *edges* are those of the images at each point,
    which *of_events* says that events built.
    """
    raw = [fit_vertex(position, log_energies[:, band], half_width) for band in range(len(BANDS_PX))]
    finest = with_window(raw[0], position, log_energies[:, 0], half_width)
    if raw[0] is None or finest is None:
        return None
    scatter = float(np.hypot(raw[0].sigma, raw[0].sigma if raw[1] is None else raw[1].sigma))
    rise = log_energies[int(np.argmax(log_energies[:, 0]))] - log_energies[0]
    as_blur = bool(rise[1] < rise[0]) and (raw[1] is None or raw[1].width > raw[0].width)
    tilt = None if edges is None else find_astigmatism(position, edges, half_width, finest.width, of_events=of_events)
    shifts = [(0.0, 0.0)] * len(BANDS_PX) if tilt is None else [tilt.shift(one) for one in tilt.towards]
    bound = DEPARTURE * finest.width
    normal, right, squares, count = np.diag([0.0, 1.0 / bound**2]), np.zeros(2), 0.0, 0
    for band, f_squared in enumerate(_FREQUENCIES[:bands]):
        vertex = with_window(raw[band], position, log_energies[:, band], half_width)
        row = np.array([1.0, f_squared])
        if vertex is None:
            break
        place = vertex.at - shifts[band][0]
        # Structure that moves in and out of view tilts log S, and a tilt moves a vertex by the square of its width;
        # and there is the less structure to average over, the coarser the band.
        sigma = max(vertex.sigma, LEAST_SIGMA * finest.width) * (vertex.width / finest.width) ** 3
        if band > 0:
            # What the finer bands and the bound on the departure leave to expect here. A picture that has little
            # structure so coarse shows its drift instead, and does so in all bands coarser still.
            inverse = np.linalg.inv(normal)
            surprise = place - float(row @ inverse @ right)
            variance = float(row @ inverse @ row) + sigma**2
            if surprise**2 > _SURPRISE**2 * variance:
                break
            squares += surprise**2 / variance
        normal += np.outer(row, row) / sigma**2
        right += row * place / sigma**2
        count += 1
    inverse = np.linalg.inv(normal)
    focus, departure = (float(one) for one in inverse @ right)
    own = float(np.sqrt(inverse[0, 0] * max(1.0, squares / count)))
    # The bands share the error of what was taken off.
    sigma = float(np.linalg.norm([own, UNEXPLAINED * departure, shifts[0][1]]))
    return BandFocus(focus, sigma, finest, departure, scatter, as_blur, tilt, shifts[0][1])


def average_focus(candidates: Sequence[BandFocus]) -> BandFocus:
    """Average what candidate curves say by how well each is a parabola; their disagreement counts as error."""
    scatter = np.array([max(one.scatter, 1e-6 * one.finest.width) for one in candidates])
    weights = (scatter.min() / scatter) ** _FREEDOM
    weights /= weights.sum()
    at = np.array([one.at for one in candidates])
    focus = float(weights @ at)
    best = candidates[int(np.argmax(weights))]
    sigma = float(np.sqrt(weights @ (np.array([one.sigma for one in candidates]) ** 2 + (at - focus) ** 2)))
    return replace(best, at=focus, sigma=sigma)
