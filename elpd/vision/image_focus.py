"""Where the image that the events built was sharpest, and which of its pixels make it so."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.vision.bands import BandFocus, filtered, focus_of_bands, freed_of_noise, products
from elpd.vision.integral import BANDS_PX, band_image, fit_vertex, inside_margin
from elpd.vision.planes import FLANK
from elpd.vision.slowness import DARK

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.vision.astigmatism import Edges

UNANSWERED = 0.23
"""The last part of a record, in widths, whose pixels have turned but not yet answered."""

NARROWEST = 0.4
"""Width of a vertex over that of the hill it stands on, below which it is a ripple."""


def band_energy_image(level: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what each pixel has of S where it is at its peak, (height, width)."""
    return np.asarray(weight * np.square(band_image(level, BANDS_PX[0])), dtype=np.float32)


def who_turns(
    level: NDArray[np.float32], bend: NDArray[np.float32], weight: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return which pixels make S fall again behind its peak, (height, width).

    S has its energy on both sides of an edge, but it turns where the level of a pixel does, which is the dark side:
    ``S" = 2·sum of L"·B(A·B·L)``. *bend* stands for L".
    """
    weighted = np.asarray(band_image(level, BANDS_PX[0]) * weight, dtype=np.float32)
    return np.asarray(bend * band_image(weighted, BANDS_PX[0]), dtype=np.float32)


def typical_slowness(slowness: NDArray[np.float64], turning: NDArray[np.float32], energy: NDArray[np.float32]) -> float:
    """Return how slow the image is: the mean over what turns, or over its energy where it does not turn as a whole."""
    by_energy = float(np.average(slowness, weights=energy))
    total = float(turning.sum())
    if total <= 0.0:
        return by_energy
    return float(np.clip((slowness * turning).sum() / total, slowness.min(), slowness.max()))


def sharpness_curves(
    images: NDArray[np.float32],
    start: NDArray[np.float32] | None,
    worths: tuple[float, ...],
    weight: NDArray[np.float32],
    margin: int,
) -> list[NDArray[np.float64]]:
    """Return candidates of log S, (ticks, bands): of the images as they are, and with the start picture below them.

    Events count changes since their first; what was there before, the blurred start picture, is missing. In a still
    scene that is as symmetric in defocus as the picture itself. In one that moves, the picture wanders over what is
    missing, and S wavers. What it is worth in events is known roughly at best, so several *worths* are tried.
    """
    weight = weight[inside_margin(images.shape[1:], margin)]
    below = None
    if start is not None:
        below = filtered(np.log(np.maximum(start, 0.0) + np.float32(DARK)).astype(np.float32), margin)
    alone, with_start = [], []
    for image in images:
        seen = filtered(image, margin)
        alone.append(products(seen, seen, weight))
        if below is not None:
            with_start.append(products(seen, below, weight))
    own = np.array(alone)
    curves = [own]
    if below is not None:
        mixed, under = np.array(with_start), products(below, below, weight)
        curves += [own + 2.0 * worth * mixed + worth**2 * under for worth in worths]
    return [np.log(freed_of_noise(one) + 1e-12) for one in curves]


def image_focus(
    curve: NDArray[np.float64],
    ticks: NDArray[np.float64],
    peak: float,
    bands: int = len(BANDS_PX),
    edges: Sequence[Edges] | None = None,
) -> BandFocus | None:
    """Find the focus of a curve of log S, (ticks, bands), but for what lies too near the end of the record.

    *edges* are those of the image at each tick.
    """
    end = float(ticks[-1])
    wide = fit_vertex(ticks, curve[:, 0], end - float(ticks[0]))
    if wide is None:
        return None
    use = ticks <= end - UNANSWERED * wide.width
    if int(use.sum()) < 5:
        return None
    edges = None if edges is None else edges[: int(use.sum())]
    found = focus_of_bands(ticks[use], curve[use], 0.7 * wide.width, bands, edges, of_events=True)
    if found is None or found.finest.at > end - (UNANSWERED + 0.2) * found.finest.width:
        return None
    # The flank that led up to the peak is as wide as the curve; a dent in it is not the curve.
    if found.finest.width < NARROWEST * (peak - float(ticks[0])) / float(np.sqrt(2.0 * FLANK)):
        return None
    return found
