"""The image that the events of a region built, at any position of the lens, without hysteresis.

Events are grouped by pixel once; ``integral.rebuild_levels`` then draws each pixel's level through its knots. What the
images are asked for is in ``elpd.vision.crossing``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.vision.integral import group_by_pixel, rebuild_levels

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Groups = tuple[NDArray[np.int64], NDArray[np.int64]]
    """Events by pixel: ``integral.group_by_pixel``."""


@dataclass(frozen=True, slots=True)
class EventStretch:
    """Events of a region and its margin, in coordinates of that cut-out, with rising lens positions.

    ``base``, (height, width), is the image in thresholds that earlier events had built; ``None`` for nothing.
    """

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]
    position: NDArray[np.float64]
    height: int
    width: int
    margin: int
    base: NDArray[np.float32] | None = None


def by_pixel(events: EventStretch) -> Groups:
    """Return the events' indices by pixel, in time order."""
    return group_by_pixel(events.y.astype(np.int64) * events.width + events.x, max(1, events.height * events.width))


def rebuilt(events: EventStretch, groups: Groups, ticks: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the image at each tick, (ticks, height, width), in thresholds."""
    level = np.empty((ticks.size, events.height * events.width), dtype=np.float32)
    starts, order = groups
    rebuild_levels(starts, events.position[order], events.on[order], ticks, level)
    images = level.reshape(ticks.size, events.height, events.width)
    if events.base is not None:
        images += events.base
    return images


def counted(events: EventStretch, ticks: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the image at each tick, (ticks, height, width), as events count it: no turn is mirrored."""
    images = np.empty((ticks.size, events.height, events.width), dtype=np.float32)
    image = np.zeros((events.height, events.width), dtype=np.float32)
    if events.base is not None:
        image += events.base
    begin = 0
    for k, end in enumerate(np.searchsorted(events.position, ticks, side="right")):
        part = slice(begin, int(end))
        np.add.at(image, (events.y[part], events.x[part]), 2.0 * events.on[part] - 1.0)
        images[k], begin = image, int(end)
    return images


def busiest_rows(events: EventStretch, pixels: int) -> slice:
    """Return a stretch of rows of at most *pixels* pixels, that with the most events."""
    count = min(events.height, max(pixels // events.width, 4 * events.margin))
    below = np.concatenate([[0], np.cumsum(np.bincount(events.y, minlength=events.height))])
    first = int(np.argmax(below[count:] - below[:-count]))
    return slice(first, first + count)


def rows_of(events: EventStretch, rows: slice) -> EventStretch:
    """Return the events of some rows, in coordinates of those."""
    inside = (events.y >= rows.start) & (events.y < rows.stop)
    return EventStretch(
        events.t_us[inside],
        events.x[inside],
        (events.y[inside] - rows.start).astype(np.uint16),
        events.on[inside],
        events.position[inside],
        rows.stop - rows.start,
        events.width,
        events.margin,
        None if events.base is None else events.base[rows],
    )


def hush(images: NDArray[np.float32], ticks: NDArray[np.float64], events: EventStretch, focus: float) -> None:
    """Take out of the images, in place, what pixels did that have been silent since *focus*.

    They have risen and not yet come back (or have by less than a threshold): they know the way to focus and not the way
    from it, and would draw the vertex to the late side, the more the lower the scene's contrast.
    """
    last = np.full((events.height, events.width), -np.inf)
    last[events.y, events.x] = events.position
    silent = last < focus
    images[:, silent] = images[int(np.argmin(np.abs(ticks - focus)))][silent]
