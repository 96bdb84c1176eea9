"""What light does while a pixel is deaf, which no event tells of: how much of it, and what to put back.

After an event a pixel is held in reset for its refractory period, and how far its level goes in that time is lost. A
scene that only loses focus changes slowly, and loses next to nothing. One that shakes runs an edge over a pixel in ten
milliseconds: events every two, half a millisecond of each deaf, and a quarter of the edge's height is missing in the
image that the events build. It is missing where edges are steep, so the image is held down near focus, more so where a
lens leaves edges steep for longer, and its sharpness peaks aside: behind a traced F/2 lens by 10 um.

How fast the level went is known: between two events of one sign it went by one threshold in the time that the pixel
heard. As far as it went on as fast, it went ``period / (interval - period)`` thresholds unheard, half of that beside
either event. Where the sign turns, so did the level, and there is nothing to put back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_LOST = 4.0
"""Thresholds, at the most, between two events: they are as close as the period's error, and anything may have been."""


@kernel()
def unheard(apart_us: float, deaf_us: float) -> float:
    """Return how many thresholds went by unheard between two events of one sign."""
    heard_us = max(apart_us - deaf_us, deaf_us / MOST_LOST)
    return deaf_us / heard_us if heard_us > 0.0 else 0.0


@kernel("void(int64[::1], int64[::1], uint8[::1], float64, float64[::1])")
def steps_with_losses(
    starts: NDArray[np.int64],
    t_us: NDArray[np.int64],
    on: NDArray[np.uint8],
    deaf_us: float,
    steps: NDArray[np.float64],
) -> None:
    """Say how far the level went with each event, in thresholds: one, and what went by while the pixel was deaf.

    Parameters
    ----------
    starts, t_us, on:
        Events of pixel ``k``, in time order, are ``starts[k] : starts[k + 1]`` (``integral.group_by_pixel``).
    deaf_us:
        The refractory period; with zero nothing is lost.
    steps:
        Output, (events,): positive for ON events.
    """
    for k in range(starts.size - 1):
        before = 0.0
        for i in range(starts[k], starts[k + 1]):
            after = 0.0
            if i + 1 < starts[k + 1] and (on[i] != 0) == (on[i + 1] != 0):
                after = 0.5 * unheard(float(t_us[i + 1] - t_us[i]), deaf_us)
            steps[i] = (1.0 + before + after) * (1.0 if on[i] else -1.0)
            before = after


@kernel("void(int64[::1], uint16[::1], uint16[::1], uint8[::1], float64, int64[:, ::1], float32[:, ::1])")
def lost_between_events(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    deaf_us: float,
    last: NDArray[np.int64],
    lost: NDArray[np.float32],
) -> None:
    """Add to *lost*, (height, width) in thresholds, what ``steps_with_losses`` puts back for these events.

    They are in time order; *last*, (height, width), begins as -1.
    """
    for i in range(t_us.size):
        before = last[y[i], x[i]]
        last[y[i], x[i]] = 2 * t_us[i] + (1 if on[i] else 0)
        if before < 0 or (before % 2 == 1) != (on[i] != 0):
            continue
        lost[y[i], x[i]] += np.float32((1.0 if on[i] else -1.0) * unheard(float(t_us[i] - before // 2), deaf_us))


def lost_levels(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    deaf_us: float,
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Return what the image that events build lacks of what pixels went through while deaf, *shape*, in thresholds."""
    lost = np.zeros(shape, np.float32)
    if deaf_us > 0.0:
        lost_between_events(t_us, x, y, on, deaf_us, np.full(shape, -1, np.int64), lost)
    return lost
