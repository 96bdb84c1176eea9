"""How long a pixel is deaf after an event, measured from the events themselves.

After an event a pixel is held in reset for its refractory period, and what the light does in that time is lost: the
next threshold is counted from the brightness at *release*, not at the event. So the level that an event stands for is
that of its release, and every position read off event times is early by the refractory period times the lens speed:
half a millisecond at 4 mm/s is 2 um, a third of a depth of focus. Dating events to their release removes it, on both
sides of focus alike (a pair's halves then lie at equal levels again).

Nobody knows the period of a given sensor and bias; but no two events of one pixel are closer than it, and noise sees to
it that some nearly are. Just above the period the intervals are evenly spread, so the shortest ones, less what their
number leaves to expect, are the period, and their scatter its error. Where there is hardly any noise the shortest
interval is set by the steepest edge in view instead; then the intervals above it crowd, and nothing is learnt but a
bound: the period is anything below it, evenly. So it is where stamps lie on a grid: intervals are as long as the grid
makes them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from elpd.events.jit import kernel
from elpd.vision.flicker import stamp_grid_us

if TYPE_CHECKING:
    from numpy.typing import NDArray

ORDER = 5
"""Which of the shortest intervals is believed: a glitch in the time stamps may make one or two."""

KEPT = 512
MIN_INTERVALS = 5_000
GRID_COUNT = 250
"""So many intervals exactly alike and shortest, and the time stamps are on a grid too, whatever most of them do."""

FEWEST_ABOVE = 8
EVEN_SIGMAS = 2.0
"""So many intervals must lie above the shortest, up to half as long again, and not crowd towards their end by so many
standard deviations. One steep edge makes several alike at the start, so all that are kept are looked at."""

TOGETHER_US = 16.0
"""Closer together than this all of them are at the period, and whole microseconds say nothing of how they lie."""

MOST_US = 1_000.0
"""So long a period nobody sets for focusing: shortest intervals above it are those of the scene."""


@dataclass(frozen=True, slots=True)
class Refractory:
    """A refractory period and one standard error, us; both zero where nothing need be said."""

    period_us: float = 0.0
    sigma_us: float = 0.0


@kernel("int64(int64[::1], uint16[::1], uint16[::1], int64[:, ::1], int64[::1])")
def shortest_intervals(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    last_us: NDArray[np.int64],
    shortest_us: NDArray[np.int64],
) -> int:
    """Keep the shortest intervals between events of one pixel in *shortest_us*, ascending; return how many there were.

    *last_us*, (height, width), holds each pixel's last time, negative before the first; *shortest_us* begins full of
    large values. Intervals of zero (one time stamp for two events) are passed over.
    """
    count = 0
    top = shortest_us.size - 1
    for i in range(t_us.size):
        before = last_us[y[i], x[i]]
        last_us[y[i], x[i]] = t_us[i]
        interval = t_us[i] - before
        if before < 0 or interval <= 0:
            continue
        count += 1
        if interval >= shortest_us[top]:
            continue
        j = top
        while j > 0 and shortest_us[j - 1] > interval:
            shortest_us[j] = shortest_us[j - 1]
            j -= 1
        shortest_us[j] = interval
    return count


def refractory_period(
    t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], shape: tuple[int, int]
) -> Refractory:
    """Return the refractory period, as far as the events tell it.

    Parameters
    ----------
    t_us, x, y
        Events in time order, inside *shape* (height, width).

    """
    last_us = np.full(shape, -1, np.int64)
    shortest_us = np.full(KEPT, np.iinfo(np.int64).max)
    count = shortest_intervals(t_us, x, y, last_us, shortest_us)
    least_us = float(shortest_us[ORDER - 1])
    bound_us = min(least_us, MOST_US)
    only_bounded = Refractory(0.5 * bound_us, bound_us / sqrt(12.0))
    if count < MIN_INTERVALS or least_us > MOST_US or shortest_us[0] == shortest_us[GRID_COUNT]:
        return only_bounded
    top_us = min(1.5 * least_us, float(shortest_us[-1]))
    above = (shortest_us[ORDER:] - least_us) / (top_us - least_us) if top_us > least_us else np.empty(0)
    above = above[: max(FEWEST_ABOVE, int(np.searchsorted(above, 1.0, side="right")))]
    if above.size < FEWEST_ABOVE or _on_a_grid(shortest_us, t_us):
        return only_bounded
    # Evenly spread, they lie at half their range on average; what is set by edges in view crowds towards its end.
    reach = max(float(above.max()), 1.0 / (top_us - least_us))
    lie = float(above.mean()) / reach
    if reach * (top_us - least_us) > TOGETHER_US and lie > 0.5 + EVEN_SIGMAS / np.sqrt(12.0 * above.size):
        return only_bounded
    per_us = float(above.size / (reach * (top_us - least_us)))
    return Refractory(max(0.0, least_us - ORDER / per_us), min(only_bounded.sigma_us, sqrt(ORDER) / per_us))


def _on_a_grid(shortest_us: NDArray[np.int64], t_us: NDArray[np.int64]) -> bool:
    """Whether a grid of time stamps, not the pixels, sets intervals: most are alike, and most stamps far apart."""
    return np.unique(shortest_us).size < shortest_us.size // 2 and stamp_grid_us(t_us) > TOGETHER_US
