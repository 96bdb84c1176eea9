"""The weight table that an event's address indexes.

``ELP = -Σ p·∇²I(x, y)`` (the paper's Event Laplacian Product) is one look-up and one add per event. The table is
int16 and flat, its rows wider than any 11-bit column and its last row empty, so that no word whatever can read
outside of it. Membership is in the table too: a pixel outside the region carries a value that no weight has, which
makes any shape of region, and a mask of hot pixels, cost the same as a rectangle.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import UsageError
from elpd.events.registers import MAX_SIDE
from elpd.vision.large_pages import in_large_pages

if TYPE_CHECKING:
    from numpy.typing import NDArray

STRIDE = MAX_SIDE + 64
"""Columns of a table row: more than an address can say, and no power of two, which would crowd a cache's sets."""

OUT_OF_SENSOR_WEIGHT = -32768
OUTSIDE_WEIGHT = -32767
MAX_WEIGHT = 32766


def weight_table(weights: NDArray[Any], inside: NDArray[np.bool_] | None = None) -> NDArray[np.int16]:
    """Lay out *weights* for the kernels.

    Parameters
    ----------
    weights : (height, width) integers
        The Laplacian of the reference, within ±32766.
    inside : (height, width) bool, optional
        Which pixels belong to the region; all by default. Weights elsewhere do not matter.

    Returns
    -------
    int16, ((height + 1) * STRIDE,)

    Raises
    ------
    UsageError
        For a wrong shape or type, a weight out of range, or a region without a pixel.
    """
    if weights.ndim != 2 or weights.dtype.kind not in "iu" or not 0 < max(weights.shape) <= MAX_SIDE:
        raise UsageError(
            f"weights are integers, height by width, at most {MAX_SIDE} each; got {weights.dtype} {weights.shape}"
        )
    if inside is None:
        inside = np.ones(weights.shape, np.bool_)
    if inside.shape != weights.shape or not inside.any():
        raise UsageError(
            f"a region of shape {inside.shape} with {int(inside.sum())} pixels does not fit weights of {weights.shape}"
        )
    largest = int(np.abs(weights[inside].astype(np.int64)).max())
    if largest > MAX_WEIGHT:
        raise UsageError(f"a weight of magnitude {largest} exceeds {MAX_WEIGHT}; scale the reference down")
    height, width = weights.shape
    table = in_large_pages((height + 1) * STRIDE, np.int16).reshape(-1, STRIDE)
    table[:] = OUT_OF_SENSOR_WEIGHT
    table[:height, :width] = np.where(inside, weights, OUTSIDE_WEIGHT)
    return table.reshape(-1)
