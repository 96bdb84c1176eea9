"""ELP as its authors ran it (Bao et al., CVPR 2025; semantics of the released code, in our own words).

One routine and three sets of constants, because the release has three programs that differ in more than names: bin
width, normalisation by the bin's event count, trigger thresholds, which bin of the transition counts, how many bins
and milliseconds are subtracted afterwards, and whether the search stops at the first trigger or keeps overwriting its
answer with what it sees later. All of that is kept, as are bins closed at both ends (an event on an edge counts
twice), the bin grid that restarts at each frame, and the EMA that the "adaptive" filter is in practice.

Two answers come out. ``focus_us`` is *as released*: hindsight, with the built-in offset. ``details`` hold the honest
ones: ``trigger_us``, the end of the first bin at which the rule could fire, which is when a motor could have been told
to stop, and ``transition_us``, the beginning of the bin it blames, without any offset. Left out, in its favour:
event counters that wrap at 256, and the exception on a stack without a transition (here: no answer, with a reason).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.baselines.stack import Estimate, FocusStack, Peer, no_answer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

FILTER_WINDOW = 10
FILTER_WEIGHT = 0.4
FILTER_THRESHOLD = 5e4


@dataclass(frozen=True, slots=True)
class Published:
    """One data set's constants.

    The rule fires when the filtered series has fallen below ``below`` and, for ``tail_bins == 0``, spans more than
    ``span`` over its whole history; else when the last ``tail_bins`` reach below ``below`` and all before rise above
    ``span``. ``overwrite`` says how long later answers replace earlier ones after the first trigger.
    """

    bin_us: int
    normalise: bool
    least_events: int
    all_events: bool
    span: float
    below: float
    tail_bins: int = 0
    last_positive: bool = False
    back_bins: int = 1
    back_us: int = 0
    overwrite: str = "no"  # "no", "frame" or "end"
    skip_us: int = 0
    filtered: bool = True
    laplacian: bool = True
    laplacian_us: int | None = None


DAVIS = Published(1_000, normalise=True, least_events=1, all_events=False, span=8.0, below=-5.0)
EVK4 = Published(
    1_000, normalise=False, least_events=10, all_events=False, span=50.0, below=-500.0, tail_bins=5, back_bins=2,
    overwrite="end",
)  # fmt: skip
SYN = Published(
    2_000, normalise=True, least_events=1, all_events=True, span=10.0, below=-8.0, last_positive=True, back_bins=2,
    back_us=5_000, overwrite="frame",
)  # fmt: skip
SYN_1FPS = replace(SYN, span=5.0, below=-2.0, overwrite="no", skip_us=100_000, laplacian_us=350_000)
"""The release's "1 fps": one frame, taken at 350 ms, serves the bins from 100 ms on: a frame from the future."""

SYN_NO_FILTER = replace(SYN, filtered=False)
SYN_NO_LAPLACIAN = replace(SYN, laplacian=False, span=0.6, below=-0.5, skip_us=25_000, overwrite="no")
"""Thresholds, late start and end at the first trigger of the release's DAVIS ablation; it has none for the synthetic
set, whose rule "until the frame's interval ends" has no meaning without frames."""


def published(constants: Published) -> Peer:
    """Return the peer with *constants*."""

    def estimate(stack: FocusStack) -> Estimate:
        return run(stack, constants)

    return estimate


def run(stack: FocusStack, constants: Published) -> Estimate:
    """Run the released search over *stack*."""
    if constants.laplacian and not stack.frames:
        return no_answer("no frame to take a Laplacian of")
    series = list(_bins(stack, constants))
    if not series:
        return no_answer("no bin holds enough events")
    begins, ends, intervals, raw = (np.array(column) for column in zip(*series, strict=True))
    values = adaptive_filter(raw) if constants.filtered else raw
    curve = {"t_us": begins.tolist(), "elp": values.tolist()}
    answer, trigger = math.nan, None
    transition = decided = math.nan
    for k, fired in enumerate(_fires(values, constants)):
        if trigger is not None and _settled(constants, k, trigger, intervals):
            break
        if not fired:
            continue
        crossing = _last_crossing(values, k)
        if crossing is None:
            return no_answer("triggered without a transition from + to - (the release raises here)", curve=curve)
        if trigger is None:
            trigger = k
        blamed = crossing - 1 if constants.last_positive else crossing
        transition = float(begins[crossing])
        answer = float(begins[blamed]) - constants.back_bins * constants.bin_us - constants.back_us
        decided = float(ends[k])
    if trigger is None:
        return no_answer("the thresholds were never reached", curve=curve, range=float(np.ptp(values)))
    details = {"trigger_us": float(ends[trigger]), "transition_us": transition, "curve": curve}
    return Estimate(answer, decided, details)


def adaptive_filter(raw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the released filter's output for a series (n,) of raw values.

    The first value passes. Then, where the value is within 5e4 of the mean of the last ten raw ones, 0.4 of it and 0.6
    of the previous *output* (the paper says: of the mean); else the value itself.
    """
    filtered = raw.astype(np.float64, copy=True)
    for k in range(1, raw.size):
        mean = raw[max(0, k + 1 - FILTER_WINDOW) : k + 1].mean()
        if abs(raw[k] - mean) <= FILTER_THRESHOLD:
            filtered[k] = FILTER_WEIGHT * raw[k] + (1.0 - FILTER_WEIGHT) * filtered[k - 1]
    return filtered


def released_laplacian(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the 4-neighbour Laplacian of the 3x3 median of an 8-bit image (height, width)."""
    median = cv2.medianBlur(np.ascontiguousarray(pixels), 3)
    return np.asarray(cv2.Laplacian(median, cv2.CV_32F), dtype=np.float32)


def _bins(stack: FocusStack, constants: Published) -> Iterator[tuple[int, int, int, float]]:
    """Yield (begin, end, frame interval, ELP) of every bin that holds enough events."""
    inside = np.ones(stack.t_us.size, dtype=np.bool_) if constants.all_events else stack.inside_roi()
    t_us, x, y = stack.t_us[inside], stack.x[inside], stack.y[inside]
    sign = 1.0 - 2.0 * (stack.on[inside] > 0)  # -p
    for interval, (begin_us, end_us, weights) in enumerate(_intervals(stack, constants)):
        first = int(np.searchsorted(t_us, begin_us, side="left"))
        last = int(np.searchsorted(t_us, end_us, side="right"))
        product = sign[first:last] * weights[y[first:last], x[first:last]]
        running = np.concatenate(([0.0], np.cumsum(product, dtype=np.float64)))
        begins = np.arange(begin_us, end_us, constants.bin_us)
        ends = np.minimum(begins + constants.bin_us, end_us)
        lows = np.searchsorted(t_us[first:last], begins, side="left")
        highs = np.searchsorted(t_us[first:last], ends, side="right")
        for begin, end, low, high in zip(begins, ends, lows, highs, strict=True):
            if high - low >= constants.least_events:
                value = float(running[high] - running[low])
                yield int(begin), int(end), interval, value / float(high - low) if constants.normalise else value


def _intervals(stack: FocusStack, constants: Published) -> Iterator[tuple[int, int, NDArray[np.float32]]]:
    """Yield the stretches of time that share one table of weights; the bin grid restarts with each."""
    start_us = stack.begin_us + constants.skip_us
    if not constants.laplacian:
        yield start_us, stack.end_us, _within_roi(stack, np.ones(_shape(stack), dtype=np.float32))
        return
    frames = stack.frames
    if constants.laplacian_us is not None:
        wanted = stack.begin_us + constants.laplacian_us
        nearest = min(frames, key=lambda frame: abs(frame.t_us - wanted))
        yield start_us, stack.end_us, _within_roi(stack, released_laplacian(nearest.pixels))
        return
    for k, frame in enumerate(frames):
        begin_us = max(frame.t_us, start_us)
        end_us = frames[k + 1].t_us if k + 1 < len(frames) else stack.end_us
        if end_us > begin_us:
            yield begin_us, end_us, _within_roi(stack, released_laplacian(frame.pixels))


def _shape(stack: FocusStack) -> tuple[int, int]:
    return stack.geometry.height, stack.geometry.width


def _within_roi(stack: FocusStack, weights: NDArray[np.float32]) -> NDArray[np.float32]:
    table = np.zeros(_shape(stack), dtype=np.float32)
    rows = slice(stack.roi.y, stack.roi.y + stack.roi.height)
    columns = slice(stack.roi.x, stack.roi.x + stack.roi.width)
    table[rows, columns] = weights[rows, columns]
    return table


def _fires(values: NDArray[np.float64], constants: Published) -> list[bool]:
    """Say of every bin whether the rule holds on the history that ends with it."""
    lowest, highest = np.minimum.accumulate(values), np.maximum.accumulate(values)
    if constants.tail_bins == 0:
        return list((highest - lowest > constants.span) & (lowest < constants.below))
    tail = constants.tail_bins
    return [
        k >= tail and values[k + 1 - tail : k + 1].min() < constants.below and highest[k - tail] > constants.span
        for k in range(values.size)
    ]


def _settled(constants: Published, k: int, trigger: int, intervals: NDArray[np.int64]) -> bool:
    """Say whether bin *k* can no longer change the answer that was first given at *trigger*."""
    if constants.overwrite == "end":
        return False
    return constants.overwrite == "no" or bool(intervals[k] != intervals[trigger])


def _last_crossing(values: NDArray[np.float64], until: int) -> int | None:
    """Return the last bin up to *until* that is negative after a positive one."""
    history = values[: until + 1]
    crossings = np.flatnonzero((history[:-1] > 0.0) & (history[1:] < 0.0)) + 1
    return int(crossings[-1]) if crossings.size else None
