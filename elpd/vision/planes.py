"""Several depths in one region: where each plane is in focus, by its own mirror pairs.

Pairs of one plane agree on one focus; those of several planes make clusters, each in its own part of the picture. What
else makes clusters (edges that move) sharpens nothing, so each part must be sharpest where its pairs say.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.bands import band_energies
from elpd.vision.depths import find_depths, shares_of_planes
from elpd.vision.pairs import weighted_mode
from elpd.vision.rebuilt import rebuilt

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.vision.pairs import Mode, Pairs
    from elpd.vision.rebuilt import EventStretch, Groups

PLANE_KERNEL = 0.1
"""Standard deviation, in widths, of the kernel that finds the mode of one plane's pairs among several planes."""

PLANES_AGREE = 0.5
"""How far from its pairs the sharpest place of a plane's own part of the picture may be, in shares of the least gap
of planes: edges that move make clusters of pairs, but sharpen nothing."""

FLANK = 0.6
"""The rising flank begins where log S is so far below its peak."""

MIN_PAIRS = 30
TICKS = 64


def flank_width(begin: float, peak: float) -> float:
    """Return the width of a curve that rose by ``FLANK`` from *begin* to *peak*."""
    return (peak - begin) / float(np.sqrt(2.0 * FLANK))


def find_planes(
    pairs: Pairs,
    events: EventStretch,
    groups: Groups,
    level: NDArray[np.float32],
    stretch: tuple[float, float, float],
    late: NDArray[np.float64],
) -> list[Mode]:
    """Return where planes of the region are in focus, if there are several.

    *stretch* is where the curve's rising flank, its peak and the record's end lie, *late* each pixel's lag. The planes'
    own parts of the picture must be sharpest where their pairs say.
    """
    begin, peak, end = stretch
    width = flank_width(begin, peak)
    curvature = cv2.Laplacian(cv2.GaussianBlur(level, (0, 0), 1.0), cv2.CV_32F)[pairs.y, pairs.x].astype(np.float64)
    middle = pairs.middle - late[pairs.y, pairs.x]
    believed = ((2.0 * pairs.on - 1.0) * curvature > 0.0) & (middle >= begin - width)
    weights = (np.abs(curvature) / np.maximum(pairs.after - pairs.before, 1e-3 * width))[believed]
    middle = middle[believed]
    clusters = find_depths(middle, weights, pairs.x[believed], pairs.y[believed], width)
    held = sum(float(weights[one].sum()) for one in clusters) / max(float(weights.sum()), 1e-300)
    modes = [weighted_mode(middle[one], weights[one], PLANE_KERNEL * width) for one in clusters]
    known = [replace(mode, share=held) for mode in modes if mode is not None and mode.count >= MIN_PAIRS]
    if len(known) < 2 or len(known) < len(modes):
        return []
    shares = shares_of_planes(clusters, pairs.x[believed], pairs.y[believed], level.shape)
    ticks = np.linspace(begin - width, end, TICKS)
    images = rebuilt(events, groups, ticks)
    tops = [float(ticks[_sharpest(images, share, events.margin)]) for share in shares]
    places = np.array([mode.at for mode in known])
    allowed = PLANES_AGREE * float(np.diff(places).min())
    # Each part must be sharpest where its pairs say, and the parts as far apart as the pairs.
    astray = np.concatenate([np.abs(tops - places), np.abs(np.diff(tops) - np.diff(places))])
    return known if bool((astray <= allowed).all()) else []


def _sharpest(images: NDArray[np.float32], share: NDArray[np.float32], margin: int) -> int:
    return int(np.argmax([band_energies(image, share, margin)[0] for image in images]))
