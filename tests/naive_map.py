"""Slow, obvious twins of the kernels of ``elpd.vision.latch`` and ``first_times``: loops and lists, nothing clever."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

EMPTY = 2**31 - 1
SLOTS = 3
HOT, UNFIRED = 3, 4


def latch_first_on(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    begin_us: int,
    end_us: int,
    width: int,
    height: int,
) -> tuple[NDArray[np.int32], NDArray[np.uint16], list[int]]:
    """Return times (3, height, width), counts before (height, width), and the tally on, before, after, outside."""
    held: dict[tuple[int, int], list[int]] = {}
    before = np.zeros((height, width), np.uint16)
    tally = [0, 0, 0, 0]
    for t, column, row, polarity in zip(t_us.tolist(), x.tolist(), y.tolist(), on.tolist(), strict=True):
        if polarity != 1:
            continue
        if column >= width or row >= height:
            tally[3] += 1
        elif t < begin_us:
            tally[1] += 1
            before[row, column] = min(int(before[row, column]) + 1, 65535)
        elif t >= end_us:
            tally[2] += 1
        else:
            tally[0] += 1
            held.setdefault((row, column), []).append(t - begin_us)
    slots = np.full((SLOTS, height, width), EMPTY, np.int32)
    for (row, column), times in held.items():
        for slot, time in enumerate(times[:SLOTS]):
            slots[slot, row, column] = time
    return slots, before, tally


def believe(
    times: NDArray[np.int32], choice: NDArray[np.uint8], slots: NDArray[np.int32], jitter: float
) -> tuple[NDArray[np.int32], NDArray[np.uint8], int]:
    """Return the times and choices after one pass, and how many pixels moved."""
    height, width = times.shape
    new_times, new_choice = times.copy(), choice.copy()
    moved = 0
    for row in range(height):
        for column in range(width):
            if choice[row, column] >= HOT:
                continue
            own = int(times[row, column])
            around = [
                int(times[r, c])
                for r in range(row - 1, row + 2)
                for c in range(column - 1, column + 2)
                if (r, c) != (row, column) and 0 <= r < height and 0 <= c < width
            ]
            fired = sorted(time for time in around if time != EMPTY)
            silent = len(around) - len(fired)
            if len(fired) <= 2:
                verdict, limit = UNFIRED, float(EMPTY)
            else:
                tolerance = 5.0 * jitter * fired[len(fired) // 2]
                margin = 5.0 * jitter * own
                n_early = sum(time <= own + margin for time in fired)
                n_late = sum(time >= own - margin for time in fired) + silent
                too_early = n_early < 2 and sum(time <= own + tolerance for time in fired) < 2
                too_late = n_late < 2 and sum(time >= own - tolerance for time in fired) + silent < 2
                if not too_early and not too_late:
                    continue
                verdict = HOT if too_early else UNFIRED
                limit = min(fired[-1] + tolerance, float(EMPTY))
            moved += 1
            slot = int(choice[row, column]) + 1
            if slot < SLOTS and slots[slot, row, column] < limit:
                new_choice[row, column], new_times[row, column] = slot, slots[slot, row, column]
            else:
                new_choice[row, column], new_times[row, column] = verdict, EMPTY
    return new_times, new_choice, moved
