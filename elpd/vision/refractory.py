"""How long a pixel is deaf after an event, measured from the events themselves.

After an event a pixel is held in reset for its refractory period, and what the light does in that time is lost: the next
threshold is counted from the brightness at *release*, not at the event. So the level that an event stands for is that of
its release, and every position read off event times is early by the refractory period times the lens speed: half a
millisecond at 4 mm/s is 2 um, a third of a depth of focus. Dating events to their release removes it, on both sides of
focus alike (a pair's halves then lie at equal levels again).

Nobody knows the period of a given sensor and bias; but no two events of one pixel are closer than it, and noise sees to it
that some nearly are. The fifth shortest interval among ten thousands is the period to a few per cent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHORTEST = 5
"""Which of the shortest intervals is believed: a glitch in the time stamps may make one or two."""

MIN_INTERVALS = 5_000
MAX_PERIOD_US = 5_000.0
"""Beyond this nobody sets it for focusing, and a shortest interval so long only says that there are few events."""

GRID_SHARE = 0.05
"""More than this share of all intervals exactly alike, and the time stamps are on a grid: it hides the period."""


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


def refractory_period_us(
    t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], shape: tuple[int, int]
) -> float:
    """Return the refractory period in us, 0 where the events do not tell it.

    Parameters
    ----------
    t_us, x, y
        Events in time order, inside *shape* (height, width).

    """
    last_us = np.full(shape, -1, np.int64)
    shortest_us = np.full(max(SHORTEST, round(GRID_SHARE * MIN_INTERVALS)), np.iinfo(np.int64).max)
    count = shortest_intervals(t_us, x, y, last_us, shortest_us)
    if count < MIN_INTERVALS or shortest_us[SHORTEST - 1] > MAX_PERIOD_US or shortest_us[0] == shortest_us[-1]:
        return 0.0
    return float(shortest_us[SHORTEST - 1])
