"""The image that the events of a region built, at any position of the lens, without hysteresis.

Events are grouped by pixel once; ``integral.rebuild_levels`` then draws each pixel's level through its knots. What the
images are asked for is in ``elpd.vision.crossing``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from elpd.vision.integral import group_by_pixel, rebuild_levels
from elpd.vision.losses import steps_with_losses
from elpd.vision.refractory import NOT_DEAF, Refractory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Groups = tuple[NDArray[np.int64], NDArray[np.int64]]
    """Events by pixel: ``integral.group_by_pixel``."""


@dataclass(frozen=True, slots=True)
class EventStretch:
    """Events of a region and its margin, in coordinates of that cut-out, with rising lens positions.

    ``base``, (height, width), is the image in thresholds that earlier events had built, ``None`` for nothing, and
    ``base_lost`` what it lacks because pixels were deaf. ``deaf`` is for how long they are.
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
    base_lost: NDArray[np.float32] | None = None
    deaf: Refractory = NOT_DEAF

    def as_heard(self) -> EventStretch:
        """Return the same as if no pixel was ever deaf, and nothing lost."""
        return replace(self, base_lost=None, deaf=NOT_DEAF)


def by_pixel(events: EventStretch) -> Groups:
    """Return the events' indices by pixel, in time order."""
    return group_by_pixel(events.y.astype(np.int64) * events.width + events.x, max(1, events.height * events.width))


def rebuilt(events: EventStretch, groups: Groups, ticks: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the image at each tick, (ticks, height, width), in thresholds."""
    level = np.empty((ticks.size, events.height * events.width), dtype=np.float32)
    starts, order = groups
    steps = np.empty(order.size)
    steps_with_losses(starts, events.t_us[order], events.on[order], events.deaf.period_us, steps)
    rebuild_levels(starts, events.position[order], steps, ticks, level)
    images = level.reshape(ticks.size, events.height, events.width)
    if events.base is not None:
        images += events.base
    if events.base_lost is not None:
        images += events.base_lost
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
    return replace(
        events,
        t_us=events.t_us[inside],
        x=events.x[inside],
        y=(events.y[inside] - rows.start).astype(np.uint16),
        on=events.on[inside],
        position=events.position[inside],
        height=rows.stop - rows.start,
        base=None if events.base is None else events.base[rows],
        base_lost=None if events.base_lost is None else events.base_lost[rows],
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
