"""Where parts of a region are sharpest in the image that events built, of a scene that moves.

Pairs tell several depths apart in a scene that stands still (``vision.depths``, ``vision.relief``). Where it moves they
turn at any time; but sixteen parts of the image have a curve of log S each, and its vertex. Photoreceptors and motion
make all of them late, so the middle of a pass there and one back is the depth of the part. Half of their difference is
the same for all parts, so its scatter tells how far chance may have put the middles apart. In flat regions those
scatter as much (1 to 5 um, depth of focus 6 um), in halves 15 um apart by 7.5 um where chance has 1.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.bands import CORNER
from elpd.vision.integral import BANDS_PX, band_gain, band_image, fit_vertex, inside_margin

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.vision.bands import BandFocus

SIDE = 4
"""Parts along each side of the region."""

WIDEST = 2.5
"""A part's curve is no wider than so many of the whole image's: what is wider shows something else."""

CERTAIN = 2.0
"""Parts that scatter by so many times as much as chance would have it lie apart."""

WITHIN = 0.4
"""How far parts scatter within two groups at the most, over how far all do: spread evenly they would have half."""

LEAST_SHARE = 0.2
"""How much of the sharpness a depth has at the least."""

_GAIN = band_gain(BANDS_PX[0])
_FLOOR = 1e-3


@dataclass(frozen=True, slots=True)
class ImageParts:
    """Where each part is sharpest, (parts,), not a number where that is not known, and how much of S it has."""

    at: NDArray[np.float64]
    energy: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        images: NDArray[np.float32],
        ticks: NDArray[np.float64],
        weight: NDArray[np.float32],
        margin: int,
        whole: BandFocus,
        until: float,
    ) -> ImageParts:
        """Measure them in *images*, (ticks, height, width), as far as *until*; *whole* is the focus of all of it."""
        use = ticks <= until
        ticks = ticks[use]
        energies = np.array([_energies(image, weight, margin) for image in images[use]])
        vertices = [fit_vertex(ticks, np.log(one + 1e-12), 0.7 * whole.finest.width) for one in energies.T]
        seen = [one is not None and one.width < WIDEST * whole.finest.width for one in vertices]
        at = [one.at if one is not None and good else np.nan for one, good in zip(vertices, seen, strict=True)]
        return cls(np.array(at), energies[int(np.argmin(np.abs(ticks - whole.finest.at)))])


@dataclass(frozen=True, slots=True)
class Spread:
    """How far parts lie from their mean, as a standard deviation, and what of it may be chance.

    ``groups`` are how far each of two groups of them lies from the mean of all, the lower first, if they are two.
    """

    sigma: float
    chance: float
    groups: tuple[float, float] | None = None

    @property
    def certain(self) -> bool:
        """Whether it is no chance."""
        return self.sigma > CERTAIN * self.chance


def spread_of(there: Sequence[ImageParts], back: Sequence[ImageParts]) -> Spread | None:
    """Compare the parts' middles of passes there and *back*, all on rulers that rise with time; ``None``: not known."""
    if not there or not back:
        return None
    # A part counts where passes both ways have shown it.
    ways = [np.array([one.at for one in passes]) for passes in (there, back)]
    known = np.logical_and(*(np.isfinite(way).any(axis=0) for way in ways))
    energy = np.mean([one.energy for one in (*there, *back)], axis=0)[known]
    if known.sum() < SIDE or not energy.sum() > 0.0:
        return None
    forth, late = np.nanmean(ways[0][:, known], axis=0), -np.nanmean(ways[1][:, known], axis=0)
    share = energy / energy.sum()
    middle, lateness = (one - float(share @ one) for one in (0.5 * (forth + late), 0.5 * (forth - late)))
    # All parts are as late, but for chance, and that is as large in the middle as in the difference.
    chance = float(np.sqrt(share @ lateness**2))
    order = np.argsort(middle)
    middle, share = middle[order], share[order]
    sigma = float(np.sqrt(share @ middle**2))
    below = np.cumsum(share)[:-1]
    lower = np.cumsum(share * middle)[:-1] / below
    upper = -below * lower / (1.0 - below)
    between = below * lower**2 + (1.0 - below) * upper**2
    cut = int(np.argmax(between))
    within = float(np.sqrt(max(0.0, sigma**2 - between[cut])))
    if min(below[cut], 1.0 - below[cut]) < LEAST_SHARE or within > WITHIN * sigma:
        return Spread(sigma, chance)
    return Spread(sigma, chance, (float(lower[cut]), float(upper[cut])))


def _energies(image: NDArray[np.float32], weight: NDArray[np.float32], margin: int) -> NDArray[np.float64]:
    """Return S of each part, freed of white noise, (parts,)."""
    inside = inside_margin(image.shape, margin)
    bands = band_image(image, BANDS_PX[0])[inside], cv2.filter2D(image, cv2.CV_32F, CORNER)[inside]
    raw, noise = (
        cv2.resize(np.square(band) * weight[inside], (SIDE, SIDE), interpolation=cv2.INTER_AREA).ravel().astype(float)
        for band in bands
    )
    return np.asarray(np.maximum(raw - _GAIN * noise, _FLOOR * raw))
