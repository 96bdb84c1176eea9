"""Several depths in one region: mirror pairs tell them apart where sharpness cannot.

The sharpness of a region with two planes is one broad hill, whose top lies between them and shows neither. A pixel's
mirror pair knows only its own plane, so the pairs' midpoints form one narrow cluster for each. Clusters count as depths
if they are more than two depths of focus apart, if hardly any pair lies between them, and if they come from *different
places* of the region: an edge that moves to and fro makes clusters too, but at the same places.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

KERNEL = 0.04
"""Standard deviation of the smoothing, in widths of the curve of log S: a fifth of a depth of focus."""

APART = 0.4
"""Least distance of two depths in widths: two depths of focus. Closer ones cannot be told from slow photoreceptors in
the dark parts of one."""

VALLEY = 0.35
"""Density between two clusters over that at the lower one's top, at the most."""

LEAST_SHARE = 0.08
LEAST_PAIRS = 40
"""What a cluster holds at the least: a plane that little of the region shows is not what it is about."""

EXPLAINED = 0.8
"""Share of all pairs that the clusters hold together, at the least; in scenes that move the others are everywhere."""

BLOCK_PX = 16
LEAST_IN_BLOCK = 8
PURITY = 0.85
"""Share of pairs that lie in a block of the picture where their own cluster prevails; mixed at random it is near one
half. Blocks with few pairs prove nothing."""


def find_depths(
    middle: NDArray[np.float64],
    weights: NDArray[np.float64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    width: float,
) -> list[NDArray[np.bool_]]:
    """Return which pairs belong to each depth, nearest first along the sweep; none unless there are several.

    Parameters
    ----------
    middle, weights:
        Midpoints of the mirror pairs and how much each counts; lens positions that rise with time.
    x, y:
        Their pixels.
    width:
        Of the curve of log S of one plane, in the unit of the positions.

    """
    if middle.size < 2 * LEAST_PAIRS or width <= 0.0:
        return []
    clusters = [one for one in _clusters(middle, weights, width) if _counts(one, weights)]
    if len(clusters) < 2:
        return []
    held = sum(float(weights[one].sum()) for one in clusters)
    if held < EXPLAINED * float(weights.sum()) or _purity(clusters, x, y) < PURITY:
        return []
    return clusters


def _counts(cluster: NDArray[np.bool_], weights: NDArray[np.float64]) -> bool:
    return int(cluster.sum()) >= LEAST_PAIRS and float(weights[cluster].sum()) >= LEAST_SHARE * float(weights.sum())


def _clusters(middle: NDArray[np.float64], weights: NDArray[np.float64], width: float) -> list[NDArray[np.bool_]]:
    """Cut the midpoints at the valleys of their smoothed density."""
    cell = 0.25 * KERNEL * width
    low = float(middle.min()) - 8 * cell
    cells = int((float(middle.max()) - low) / cell) + 9
    if cells > 1_000_000:
        return []
    density, _ = np.histogram(middle, bins=cells, range=(low, low + cells * cell), weights=weights)
    bell = np.exp(-0.5 * (np.arange(-16, 17) / 4.0) ** 2)
    smooth = np.convolve(density, bell, mode="same")
    tops = _tops(smooth, round(APART * width / cell))
    cuts = [left + int(np.argmin(smooth[left:right])) for left, right in pairwise(tops)]
    which = np.searchsorted(low + cell * (np.array(cuts, dtype=np.float64) + 0.5), middle)
    return [which == k for k in range(len(tops))]


def _tops(smooth: NDArray[np.float64], apart: int) -> list[int]:
    """Return the tops that valleys divide, in order: lower ones on the shoulder of a higher one are none."""
    rising = np.flatnonzero((smooth[1:-1] >= smooth[:-2]) & (smooth[1:-1] > smooth[2:])) + 1
    tops: list[int] = []
    for top in sorted(rising, key=lambda one: -smooth[one]):
        divided = all(
            abs(int(top) - other) >= apart
            and float(smooth[min(int(top), other) : max(int(top), other)].min()) <= VALLEY * float(smooth[top])
            for other in tops
        )
        if divided and smooth[top] > 0.01 * smooth.max():
            tops.append(int(top))
    return sorted(tops)


def _purity(clusters: list[NDArray[np.bool_]], x: NDArray[np.uint16], y: NDArray[np.uint16]) -> float:
    columns = int(x.max()) // BLOCK_PX + 1
    block = (y.astype(np.int64) // BLOCK_PX) * columns + x // BLOCK_PX
    held = np.array([np.bincount(block[one], minlength=int(block.max()) + 1) for one in clusters])
    held = held[:, held.sum(axis=0) >= LEAST_IN_BLOCK]
    return float(held.max(axis=0).sum() / held.sum()) if held.size else 0.0


def shares_of_planes(
    clusters: list[NDArray[np.bool_]], x: NDArray[np.uint16], y: NDArray[np.uint16], shape: tuple[int, ...]
) -> list[NDArray[np.float32]]:
    """Return, for each cluster, which pixels of an image (height, width) are in blocks where it prevails: 1 or 0."""
    height, width = shape
    rows, columns = -(-height // BLOCK_PX), -(-width // BLOCK_PX)
    block = (y.astype(np.int64) // BLOCK_PX) * columns + x // BLOCK_PX
    held = np.array([np.bincount(block[one], minlength=rows * columns) for one in clusters])
    first = held.argmax(axis=0)
    shares = []
    for k in range(len(clusters)):
        prevails = ((first == k) & (held[k] > 0)).reshape(rows, columns).astype(np.float32)
        shares.append(
            np.ascontiguousarray(np.kron(prevails, np.ones((BLOCK_PX, BLOCK_PX), np.float32))[:height, :width])
        )
    return shares
