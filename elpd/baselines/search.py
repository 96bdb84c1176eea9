"""Contrast autofocus as a camera does it: move, wait for a frame, compare, move again.

Hill climbing with step halving (He et al. 2003) and Fibonacci search (Krotkov 1988) over Tenengrad. The stack of frames
stands for the world: a lens asked to go to a position gets the frame taken nearest to it, so a search can resolve no
more than the frames do. What the search costs is counted as the rig would pay it: travel at the sweep's speed, and
after each arrival one whole frame period for a frame that was exposed at rest. ``decided_us`` is the sweep's beginning
plus that time; it can lie before or after the sweep's own end.

Both end at the true peak of a single-peaked contrast; both stop on a false peak when there is one, and hunt: several
moves past focus and back before they know.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from elpd.baselines.contrast import tenengrad
from elpd.baselines.rates import vertex
from elpd.baselines.stack import Estimate, FocusStack, no_answer

if TYPE_CHECKING:
    from numpy.typing import NDArray

FIRST_STEP = 0.125
"""The first step of the hill climb, as a share of the stack."""


@dataclass(slots=True)
class Bench:
    """The stack of frames as a lens and a camera that can be asked, with a bill.

    ``ask(i)`` moves to frame *i* and returns its contrast; asking again for the place the lens is at costs nothing.
    """

    stack: FocusStack
    asked: dict[int, float] = field(default_factory=dict)
    at: int = 0
    moves: int = 0
    travel: float = 0.0
    frames_waited: int = 0

    def ask(self, index: int) -> float:
        """Return the contrast of frame *index*, moving there first."""
        frames = self.stack.frames
        if index != self.at:
            self.moves += 1
            self.travel += abs(self.stack.lens_um(frames[index].t_us) - self.stack.lens_um(frames[self.at].t_us))
            self.at = index
        if index not in self.asked:
            self.frames_waited += 1
            self.asked[index] = tenengrad(frames[index].pixels, self.stack.roi)
        return self.asked[index]

    def bill_us(self) -> float:
        """Return the time that all of it took: travel at the sweep's mean speed, and a frame period per new frame."""
        frames = self.stack.frames
        whole = abs(self.stack.lens_um(frames[-1].t_us) - self.stack.lens_um(frames[0].t_us))
        per_frame_us = (frames[-1].t_us - frames[0].t_us) / (len(frames) - 1)
        travelled_us = 0.0 if whole == 0.0 else self.travel / whole * (frames[-1].t_us - frames[0].t_us)
        return travelled_us + self.frames_waited * per_frame_us


def estimate_hill_climb(stack: FocusStack) -> Estimate:
    """Climb from the first frame; on each fall turn round and halve the step, until it is one frame."""
    if len(stack.frames) < 3:
        return no_answer("fewer than three frames", frames=len(stack.frames))
    bench = Bench(stack)
    last = len(stack.frames) - 1
    step = max(int(FIRST_STEP * last), 1)
    here, value, heading = 0, bench.ask(0), 1
    while True:
        there = min(max(here + heading * step, 0), last)
        if there != here and bench.ask(there) > value:
            here, value = there, bench.ask(there)
            continue
        if step == 1:
            # A single step that falls ends the climb only when its mirror falls too.
            other = min(max(here - heading, 0), last)
            if other == here or bench.ask(other) <= value:
                break
            here, value = other, bench.ask(other)
        heading, step = -heading, max(step // 2, 1)
    return _answer(bench, here)


def estimate_fibonacci(stack: FocusStack) -> Estimate:
    """Search all frames with Fibonacci's ratios: one new frame per step, whatever the step's outcome."""
    if len(stack.frames) < 3:
        return no_answer("fewer than three frames", frames=len(stack.frames))
    bench = Bench(stack)
    last = len(stack.frames) - 1
    shorter, longer = 1, 1
    while longer < last:
        shorter, longer = longer, shorter + longer
    low, width = 0, longer
    while width > 2:
        shorter, width_left = width - shorter, shorter
        inner, outer = low + shorter, low + width_left
        # Places beyond the stack, where Fibonacci's number exceeds it, are worse than any frame.
        if outer <= last and bench.ask(outer) > bench.ask(inner):
            low = inner
        width = width_left
    best = max(range(low, min(low + width, last) + 1), key=bench.ask)
    return _answer(bench, best)


def _answer(bench: Bench, best: int) -> Estimate:
    """Refine by the parabola over the neighbours that were looked at, drive there, and present the bill."""
    stack = bench.stack
    neighbours = [index for index in (best - 1, best, best + 1) if index in bench.asked]
    index = float(best)
    if len(neighbours) == 3:
        values: NDArray[np.float64] = np.array([bench.asked[one] for one in neighbours])
        index = best - 1 + vertex(values, 1)
    bench.ask(best)
    positions = np.array([stack.lens_um(frame.t_us) for frame in stack.frames])
    position_um = float(np.interp(index, np.arange(positions.size), positions))
    details = {"moves": bench.moves, "frames": bench.frames_waited, "search_us": bench.bill_us()}
    return Estimate(stack.time_at_um(position_um), stack.begin_us + bench.bill_us(), details)
