"""EGS: event-based golden search (Lin et al., CVPR 2022).

The event rate is taken for a measure of focus and its maximum is found by golden-section search over the recorded
stack: two overlapping windows of 0.618 of the interval, the busier one survives. The semantics are those of the
released ``egs.m``: windows open on the left, closed on the right, clipped intervals that begin and end on an event,
the survivor's closing time taken from the first event past its end. Only the counting differs: bisection in the
sorted time stamps instead of a scan, so it costs O(log N) per step where the release costs O(N).

It is known to work where optical flow makes the events (shake), and to land on one of the two rate peaks beside focus
where nothing moves: with a still scene the rate has a *valley* at focus. It needs the complete stack.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.baselines.stack import Estimate, FocusStack, no_answer

if TYPE_CHECKING:
    from numpy.typing import NDArray

STOP_US = 1_000
"""The search ends when the interval is no longer than this (the release's 0.001 s)."""

_LONG = 0.618
_SHORT = 0.381


def estimate(stack: FocusStack) -> Estimate:
    """Return the golden search's answer over the region's events."""
    t_us = np.ascontiguousarray(stack.t_us[stack.inside_roi()])
    if t_us.size < 2:
        return no_answer("fewer than two events in the region", events=int(t_us.size))
    focus_us, steps = golden_search(t_us)
    return Estimate(focus_us, float(stack.end_us), {"steps": steps, "events": int(t_us.size)})


def golden_search(t_us: NDArray[np.int64]) -> tuple[float, int]:
    """Search sorted time stamps (n >= 2,); return the focus time in us and the number of steps taken.

    Ties go to the first window. The answer is the time of the first event past the middle of the last window chosen.
    """
    begin, end = float(t_us[0]), float(t_us[-1])
    focus_us = 0.5 * (begin + end)
    steps = 0
    while end - begin > STOP_US:
        first = int(np.searchsorted(t_us, begin, side="left"))
        last = int(np.searchsorted(t_us, end, side="right")) - 1
        if last <= first or t_us[last] <= t_us[first]:
            break
        begin, end = float(t_us[first]), float(t_us[last])
        span = end - begin
        width = _LONG * span
        openings = (begin, begin + _SHORT * span)
        counts = [_count(t_us, opening, opening + width, last) for opening in openings]
        chosen = openings[1] if counts[1] > counts[0] else openings[0]
        past = min(int(np.searchsorted(t_us, chosen + width, side="right")), last)
        middle = min(int(np.searchsorted(t_us, chosen + 0.5 * width, side="right")), last)
        focus_us = float(t_us[middle])
        end = float(t_us[past])
        begin = end - width
        steps += 1
    return focus_us, steps


def _count(t_us: NDArray[np.int64], begin: float, end: float, last: int) -> int:
    """Count events in ``(begin, end]`` up to index *last*."""
    upper = min(int(np.searchsorted(t_us, end, side="right")), last + 1)
    return upper - int(np.searchsorted(t_us, begin, side="right"))
