"""Which of a pixel's first ON times is believed: the earliest that its neighbourhood supports.

Keeping one time per pixel would be enough if sensors had no noise. They have: dark pixels fire ON events by leakage
and shot noise at 0.1 to 10 Hz each, so of a million pixels thousands have fired *before* the light reached their
threshold.

The idea against that: of the first ON times of each pixel believe the earliest one that its neighbourhood supports.
Light comes through a lens, whose point spread covers more than one pixel, so a pixel that truly sees light is never
alone: at least two of its eight neighbours fire before it, or about when it does. A noise event strikes one pixel at a
random time, mostly long before its neighbours. A pixel of which no time can be believed is hot (its neighbours have
fired together) or merely dark (they have not).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.events.jit import kernel
from elpd.vision.latch import EMPTY, SLOTS

if TYPE_CHECKING:
    from numpy.typing import NDArray

PASSES = 4
"""Times that a neighbourhood is asked: each may free another pixel's supporter."""

SUPPORT = 2
"""Neighbours that must fire with or before a pixel. One would let pairs of noise events vouch for each other."""

TOLERANCE_SIGMA = 5.0
"""How much earlier than its supporters a pixel may be, in standard deviations of the jitter."""

MIN_JITTER = 0.002
"""A floor for simulations without mismatch. Low, because times count from the interval's begin, not the opening."""

NORMAL_QUARTILE = 0.3186
"""A quarter of normal deviates are smaller than this in magnitude."""

# What became of a pixel: the slot that is believed, or why none is.
HOT = np.uint8(SLOTS)
UNFIRED = np.uint8(SLOTS + 1)


@kernel()
def sort_few(values: NDArray[np.int32], count: int) -> None:
    """Sort the first *count* values in place, by insertion."""
    for i in range(1, count):
        value = values[i]
        j = i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value


@kernel("int64(int32[:, ::1], uint8[:, ::1], int32[:, ::1], uint8[:, ::1], int32[:, :, ::1], float64)", allocates=True)
def believe(
    times: NDArray[np.int32],
    choice: NDArray[np.uint8],
    new_times: NDArray[np.int32],
    new_choice: NDArray[np.uint8],
    slots: NDArray[np.int32],
    jitter: float,
) -> int:
    """Move each pixel whose *choice* its neighbours contradict to its next slot; return how many moved.

    One Jacobi pass: everything is judged by *times* as they stood, so the order of pixels does not matter.
    A time stands when ``SUPPORT`` neighbours fired earlier or at most a tolerance later, and as many later or at most
    a tolerance earlier. The tolerance is ``TOLERANCE_SIGMA * jitter`` times the neighbours' median time. Too early,
    with no better slot: hot. Too late: the light's event was missed, which counts as unfired, and so does a pixel with
    at most ``SUPPORT`` fired neighbours, alone in the dark.
    """
    height, width = times.shape
    near = np.empty(8, np.int32)
    moved = 0
    for row in range(height):
        for column in range(width):
            slot = choice[row, column]
            own = times[row, column]
            new_times[row, column] = own
            new_choice[row, column] = slot
            if slot >= HOT:
                continue
            margin = TOLERANCE_SIGMA * jitter * own
            fired = silent = early = late = 0
            for r in range(max(row - 1, 0), min(row + 2, height)):
                for c in range(max(column - 1, 0), min(column + 2, width)):
                    if r == row and c == column:
                        continue
                    value = times[r, c]
                    if value == EMPTY:
                        silent += 1
                        continue
                    early += value <= own + margin
                    late += value >= own - margin
                    near[fired] = value
                    fired += 1
            late += silent
            limit = np.float64(EMPTY)
            verdict = UNFIRED
            if fired > SUPPORT:
                if early >= SUPPORT and late >= SUPPORT:
                    continue
                sort_few(near, fired)
                tolerance = TOLERANCE_SIGMA * jitter * near[fired // 2]
                too_early = near[SUPPORT - 1] > own + tolerance
                too_late = late < SUPPORT and near[fired - SUPPORT + silent] < own - tolerance
                if not too_early and not too_late:
                    continue
                limit = min(near[fired - 1] + tolerance, limit)
                if too_early:
                    verdict = HOT
            moved += 1
            following = slot + 1
            if following < HOT and slots[following, row, column] < limit:
                new_choice[row, column] = following
                new_times[row, column] = slots[following, row, column]
            else:
                new_choice[row, column] = verdict
                new_times[row, column] = EMPTY
    return moved


@dataclass(frozen=True, slots=True)
class FirstTimes:
    """The believed first ON times of one opening.

    ``times_us`` is (height, width) int32 relative to ``begin_us``, ``EMPTY`` where nothing is believed. ``hot`` marks
    pixels that fired too early for their neighbours, ``unfired`` those that did not fire, too late, or alone.
    ``fired_fraction`` counts every pixel with an ON event in the interval, believed or not; ``second_thoughts`` how
    many pixels had their first event taken for noise and a later one believed.
    """

    begin_us: int
    times_us: NDArray[np.int32]
    hot: NDArray[np.bool_]
    unfired: NDArray[np.bool_]
    fired_fraction: float
    second_thoughts: int


def believe_neighbours(slots: NDArray[np.int32], hot: NDArray[np.bool_], begin_us: int) -> FirstTimes:
    """Choose each pixel's first ON time that its neighbours support.

    Parameters
    ----------
    slots : (SLOTS, height, width)
        The first times of each pixel, relative to *begin_us*, in the order they came; ``EMPTY`` where there is none.
    hot : (height, width)
        Pixels that are not asked at all.
    """
    times = slots[0].copy()
    fired = times != EMPTY
    choice = np.where(fired, np.uint8(0), UNFIRED)
    hot = hot & fired
    choice[hot] = HOT
    times[hot] = EMPTY
    new_times, new_choice = np.empty_like(times), np.empty_like(choice)
    jitter = relative_jitter(times)
    for _ in range(PASSES):
        moved = believe(times, choice, new_times, new_choice, slots, jitter)
        times, new_times = new_times, times
        choice, new_choice = new_choice, choice
        if moved == 0:
            break
    return FirstTimes(
        begin_us=begin_us,
        times_us=times,
        hot=choice == HOT,
        unfired=choice == UNFIRED,
        fired_fraction=float(fired.mean()),
        second_thoughts=int(((choice > 0) & (choice < HOT)).sum()),
    )


def relative_jitter(times_us: NDArray[np.int32]) -> float:
    """Return the standard deviation of a first-ON time around what its neighbours suggest, relative to that time.

    Relative, because threshold mismatch and photon noise both act on intensity, so that their effect in time grows
    with time. From the mixed second difference of every ninth 2x2 block, which slopes and straight edges do not
    touch; from its lower quartile, because with noise before the opening most blocks may hold a noise event.
    At least ``MIN_JITTER``.
    """
    corner, right, below, across = (
        times_us[row::3, column::3].astype(np.float32)[: (times_us.shape[0] - 1) // 3, : (times_us.shape[1] - 1) // 3]
        for row in (0, 1)
        for column in (0, 1)
    )
    latest = np.maximum(np.maximum(corner, right), np.maximum(below, across))
    fired = latest < EMPTY
    if fired.sum() < 8:
        return MIN_JITTER
    scatter = np.abs(corner - right - below + across)[fired] / 2
    middle = (corner + right + below + across)[fired] / 4
    return max(float(np.quantile(scatter / np.maximum(middle, 1.0), 0.25)) / NORMAL_QUARTILE, MIN_JITTER)
