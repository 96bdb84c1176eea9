"""What a change of focus looks like in the events of a lens at rest, as its own sweep has shown it.

Blur by a little more changes a picture by a multiple of its Laplacian, so events of a knock, each weighed by the
Laplacian of the sharp picture, add up to the sharpness that is lost. The picture from before the sweep does not do for
that: it is blurred, and its Laplacian has little to do with the fine structure that goes first (correlation 0.1; of the
image which the events have built by the time focus is passed, 0.7). How large the sum is for so many um was seen in
the sweep as well. There it lags behind the lens on both sides, a gain that comes late before focus and a loss that
comes late behind it; the mean of both sides at one distance is free of that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Roi
    from elpd.vision.memory import EventMemory

SMOOTH_PX = 0.8
"""Levels count whole thresholds, so that neighbours differ by one for no reason; this takes the mean of some eight
pixels (4·pi·0.8²) and leaves what a lens resolves."""

CLIP_PERCENTILE = 99.0
"""One lamp is no yardstick."""

REACH = 2.0
"""The sum is read off so many times as far away as is asked for: a few um away hardly a pixel has reached its
threshold, and what is hidden comes out of proportion. Near focus it grows with the square of the distance."""


@dataclass(frozen=True, slots=True)
class Sharpest:
    """The picture in focus, as a ruler for its loss.

    Attributes
    ----------
    weights:
        (height, width) of the region, float64, zero mean: what an ON event in a pixel takes from sharpness.
    loss:
        What events add up to when focus moves by ``distance_um``.
    """

    weights: NDArray[np.float64]
    loss: float
    distance_um: float

    def at(self, distance_um: float) -> float:
        """Return what events add up to when focus moves by *distance_um*, no more than a few depths of focus."""
        return self.loss * (distance_um / self.distance_um) ** 2


def sharpest(memory: EventMemory, roi: Roi, position: float, distance_um: float) -> Sharpest | None:
    """Return the picture that a pass has built by *position* (its own coordinate), as a ruler around *distance_um*.

    ``None`` where the pass did not show both sides of focus, or no loss beyond it.
    """
    if not len(memory.track):
        return None
    beyond_um = memory.track.positions[-1] - position
    reach_um = min(REACH * distance_um, beyond_um, position - memory.track.positions[0])
    if reach_um < distance_um:
        return None
    levels = memory.built().levels - memory.change_beyond(position)
    smooth = cv2.GaussianBlur(levels.astype(np.float32), (0, 0), SMOOTH_PX, borderType=cv2.BORDER_REFLECT)
    response = cv2.Laplacian(smooth, cv2.CV_32F, borderType=cv2.BORDER_REFLECT)
    weights = np.zeros(levels.shape)
    inside = memory.within(roi)
    limit = float(np.percentile(np.abs(response[inside]), CLIP_PERCENTILE))
    clipped = np.clip(response[inside].astype(np.float64), -limit, limit)
    weights[inside] = clipped - clipped.mean()
    before, here, after = map(float, memory.sums(weights, (position - reach_um, position, position + reach_um)))
    loss = 0.5 * ((before - here) + (after - here))
    return Sharpest(weights[inside], loss, reach_um) if loss > 0 else None
