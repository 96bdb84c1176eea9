"""The kernels of the simulated sensor: a step of all pixels, noise, and sorting by time.

A step goes over a block of pixels without branches, which the compiler turns into vector code, and notes who may
fire; then it visits only those, eight notes at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCK = 2048


class Scratch(NamedTuple):
    """Room for one block: the photoreceptors before the step, who may fire, and the same again by eights."""

    before: NDArray[np.float32]
    stirred: NDArray[np.uint8]
    eights: NDArray[np.uint64]


def scratch() -> Scratch:
    """Make room for ``step_pixels``, to be used again and again."""
    stirred = np.zeros(BLOCK, np.uint8)
    return Scratch(np.empty(BLOCK, np.float32), stirred, stirred.view(np.uint64))


@kernel()
def keep(values: NDArray[np.float32], kept: NDArray[np.float32]) -> None:
    """Copy *values* to the beginning of *kept*; assigning a slice would make numba ask for room of its own."""
    for k in range(values.shape[0]):
        kept[k] = values[k]


@kernel(
    "int64(float32[::1], float32[::1], float32[::1], float32[::1], uint8[::1], uint8[::1], uint8[::1], int64[::1],"
    "float32, float32, float32, int64, int64, int64, int64, int64[::1], int64[::1], uint8[::1],"
    "float32[::1], uint8[::1], uint64[::1])"
)
def step_pixels(
    target: NDArray[np.float32],
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    gain: NDArray[np.float32],
    spread_on: NDArray[np.uint8],
    spread_off: NDArray[np.uint8],
    held: NDArray[np.uint8],
    release_us: NDArray[np.int64],
    c_on: np.float32,
    c_off: np.float32,
    spread: np.float32,
    refractory_us: int,
    begin_us: int,
    end_us: int,
    count: int,
    out_t: NDArray[np.int64],
    out_pixel: NDArray[np.int64],
    out_on: NDArray[np.uint8],
    before: NDArray[np.float32],
    stirred: NDArray[np.uint8],
    eights: NDArray[np.uint64],
) -> int:
    """Advance all pixels from *begin_us* to *end_us* and append their events; return the new count of events.

    ``target`` is the log photocurrent at *end_us*, ``level`` the photoreceptor's output (updated), ``reference`` the
    comparator's (updated), ``gain`` how much of the way to the target the photoreceptor goes in this step. A pixel
    whose ``held`` is 1 is in reset until ``release_us``. Thresholds are ``c·(1 + spread·(q - 128))`` with q from
    ``spread_on`` or ``spread_off``.
    Events beyond the capacity of the outputs are counted but not kept. The last three are a ``Scratch``.
    """
    capacity = out_t.shape[0]
    pixels = target.shape[0]
    step = np.float32(end_us - begin_us)
    one = np.float32(1)
    on_base, on_slope = c_on * (one - np.float32(128) * spread), c_on * spread
    off_base, off_slope = c_off * (one - np.float32(128) * spread), c_off * spread
    for start in range(0, pixels, BLOCK):
        stop = min(start + BLOCK, pixels)
        goal, now, base_, part = target[start:stop], level[start:stop], reference[start:stop], gain[start:stop]
        q_on, q_off, reset = spread_on[start:stop], spread_off[start:stop], held[start:stop]
        # Loops of few arrays each: the compiler gives up on vector code where it would have to prove many apart.
        keep(now, before)
        for k in range(stop - start):
            now[k] = before[k] + (goal[k] - before[k]) * part[k]
        for k in range(stop - start):
            moved = now[k] - base_[k]
            rises = moved >= on_base + on_slope * np.float32(q_on[k])
            falls = -moved >= off_base + off_slope * np.float32(q_off[k])
            stirred[k] = np.uint8(rises) | np.uint8(falls) | reset[k]
        for eight in range((stop - start + 7) // 8):
            if eights[eight] == 0:
                continue
            for k in range(8 * eight, min(8 * eight + 8, stop - start)):
                if stirred[k] == 0:
                    continue
                i = start + k
                first, last = before[k], level[i]
                slope = (last - first) / step
                base = reference[i]
                free_us = begin_us
                if held[i] != 0:
                    if release_us[i] >= end_us:
                        continue
                    free_us = max(begin_us, release_us[i])
                    base = first + slope * np.float32(free_us - begin_us)
                    held[i] = 0
                threshold_on = on_base + on_slope * np.float32(spread_on[i])
                threshold_off = off_base + off_slope * np.float32(spread_off[i])
                while held[i] == 0:
                    if last - base >= threshold_on:
                        on, crossing = 1, base + threshold_on
                    elif base - last >= threshold_off:
                        on, crossing = 0, base - threshold_off
                    else:
                        break
                    at_us = free_us
                    if slope != np.float32(0):
                        at_us = begin_us + int((crossing - first) / slope)
                    at_us = min(max(at_us, free_us), end_us - 1)
                    if count < capacity:
                        out_t[count] = at_us
                        out_pixel[count] = i
                        out_on[count] = on
                    count += 1
                    free_us = at_us + refractory_us
                    if free_us >= end_us:
                        held[i] = 1
                        release_us[i] = free_us
                    else:
                        base = first + slope * np.float32(free_us - begin_us)
                reference[i] = base
    return count


@kernel(
    "int64(int64[::1], int64[::1], uint8[::1], float32[::1], float32[::1], uint8[::1], int64[::1],"
    "float32, float32, float32[::1], int64, int64, int64[::1], int64[::1], uint8[::1])"
)
def fire_noise(
    times_us: NDArray[np.int64],
    pixels: NDArray[np.int64],
    kinds: NDArray[np.uint8],
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    held: NDArray[np.uint8],
    release_us: NDArray[np.int64],
    c_on: np.float32,
    c_off: np.float32,
    dice: NDArray[np.float32],
    refractory_us: int,
    count: int,
    out_t: NDArray[np.int64],
    out_pixel: NDArray[np.int64],
    out_on: NDArray[np.uint8],
) -> int:
    """Let candidate noise events (sorted by time) fire where the pixel is not held; return the new count.

    Kind 0 fires the comparator that the residual is nearer to, with probability linear in it; kind 1 fires ON.
    """
    capacity = out_t.shape[0]
    for k in range(times_us.shape[0]):
        i, t = pixels[k], times_us[k]
        residual = level[i] - reference[i]
        if held[i] != 0:
            if release_us[i] > t:
                continue
            residual = np.float32(0)
        on = 1
        if kinds[k] == 0 and dice[k] * (c_on + c_off) >= residual + c_off:
            on = 0
        if count < capacity:
            out_t[count] = t
            out_pixel[count] = i
            out_on[count] = on
        count += 1
        held[i] = 1
        release_us[i] = t + refractory_us
    return count


@kernel(
    "void(int64[::1], int64[::1], uint8[::1], int64, int64, int64, int64, int64, int64,"
    "int64[::1], int64[::1], uint16[::1], uint16[::1], uint8[::1])"
)
def sort_events(
    t: NDArray[np.int64],
    pixel: NDArray[np.int64],
    on: NDArray[np.uint8],
    count: int,
    begin_us: int,
    span_us: int,
    width: int,
    x0: int,
    y0: int,
    heads: NDArray[np.int64],
    out_t: NDArray[np.int64],
    out_x: NDArray[np.uint16],
    out_y: NDArray[np.uint16],
    out_on: NDArray[np.uint8],
) -> None:
    """Counting-sort *count* events by time (stable) and turn pixel numbers of the window into x and y.

    *heads* is scratch of ``span_us + 1``. All times lie in ``[begin_us, begin_us + span_us)``.
    """
    heads[:] = 0
    for k in range(count):
        heads[t[k] - begin_us + 1] += 1
    for bin_ in range(span_us):
        heads[bin_ + 1] += heads[bin_]
    for k in range(count):
        bin_ = t[k] - begin_us
        place = heads[bin_]
        heads[bin_] += 1
        row = pixel[k] // width
        out_t[place] = t[k]
        out_x[place] = x0 + pixel[k] - row * width
        out_y[place] = y0 + row
        out_on[place] = on[k]
