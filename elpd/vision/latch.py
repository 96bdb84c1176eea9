"""The first ON times of each pixel: where they are kept, and how one is added.

A pixel has room for ``SLOTS`` times, in planes of one time a pixel; events of a time go to the first plane where their
pixel is empty. Rows begin at multiples of 32 columns, so that a vector of columns is a mask over one group of places,
or over two. Beside the planes each group has a mask of pixels that are known to be full, which together are small
enough for a near cache: a vector of nothing but full pixels (a flickering lamp, a scene that moves on) touches nothing
else. It is a hint and not a count: single events neither read nor write it, since a first event, which most are while
an aperture opens, has to touch its place anyway.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from elpd.events.bits import prefetch, trailing_zeros
from elpd.events.jit import kernel
from elpd.events.lanes import count
from elpd.vision.large_pages import in_large_pages

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.events.registers import Integer

SLOTS = 3
"""ON times kept per pixel. At 5 Hz of noise, 100 ms of waiting exhausts them in 1.4 % of the pixels."""

EMPTY = np.int32(2**31 - 1)
"""No event yet. Larger than any time, so that comparisons treat it as "later than everything"."""

MAX_INTERVAL_US = int(EMPTY) - 1

GROUP = 32
"""Columns that share a mask."""

LISTED = 512
"""Events listed at a time."""

N_ON, N_BEFORE, N_AFTER, N_OUTSIDE = range(4)
"""Of a latch's tally: ON events inside the interval, before it, after it, and outside the sensor."""

LATCH = "int32[::1], uint32[::1], uint16[::1], int64[::1]"
"""The types of ``Latch``, in its order."""

_COLUMN = 'Array({}, 1, "C", readonly=True)'


class Latch(NamedTuple):
    """What kernels write to: flat arrays, of rows that are padded to whole groups of columns.

    ``slots`` (int32) plane after plane of times since the interval's begin, ``full`` (uint32) the groups' masks,
    ``before`` (uint16) each pixel's ON events before the interval, saturating, and ``tally`` (int64).
    """

    slots: NDArray[np.int32]
    full: NDArray[np.uint32]
    before: NDArray[np.uint16]
    tally: NDArray[np.int64]


def new_latch(width: int, height: int) -> Latch:
    """Return an empty one for a sensor of so many pixels."""
    pixels = stride(width) * height
    slots = in_large_pages(SLOTS * pixels, np.int32)
    slots[:] = EMPTY
    return Latch(slots, np.zeros(pixels // GROUP, np.uint32), np.zeros(pixels, np.uint16), np.zeros(4, np.int64))


def stride(width: int) -> int:
    """Return how many pixels a row takes."""
    return -(-width // GROUP) * GROUP


@kernel()
def latch_pixel(pixel: Any, time: Any, pixels: Any, slots: NDArray[np.int32]) -> bool:
    """Keep a time of a pixel if it has room, and say whether it has no more. All numbers but *time* are unsigned."""
    if slots[pixel] == EMPTY:
        slots[pixel] = time
        return False
    if slots[pixels + pixel] == EMPTY:
        slots[pixels + pixel] = time
        return False
    pixel += np.uint64(2) * pixels
    if slots[pixel] == EMPTY:
        slots[pixel] = time
    return True


@kernel()
def latch_group(
    pixel: Any, mask: Any, time: Any, pixels: Any, slots: NDArray[np.int32], full: NDArray[np.uint32]
) -> None:
    """Keep a time of the pixels ``pixel + i`` for each bit i of *mask*; *pixel* is the first of its group."""
    group = pixel >> np.uint64(5)
    mask = np.uint32(mask & ~full[group])
    while mask != 0:
        bit = trailing_zeros(mask)
        mask = np.uint32(mask & (mask - np.uint32(1)))
        if latch_pixel(pixel + np.uint64(bit), time, pixels, slots):
            full[group] |= np.uint32(1) << np.uint32(bit)


@kernel()
def count_before(pixel: Any, before: NDArray[np.uint16]) -> None:
    """Count an ON event before the interval."""
    if before[pixel] < 65535:
        before[pixel] += np.uint16(1)


@kernel()
def inside_columns(mask: Any, first: Any, width: Any) -> Any:
    """Return those bits i of a 32-bit *mask* for which ``first + i`` is below *width*."""
    if first + GROUP <= width:
        return np.uint32(mask)
    if first >= width:
        return np.uint32(0)
    return np.uint32(mask & ((np.uint64(1) << np.uint64(width - first)) - np.uint64(1)))


@kernel()
def latch_columns(
    t_us: Integer,
    x: Integer,
    row: Integer,
    mask: Any,
    begin_us: int,
    end_us: int,
    width: int,
    height: int,
    slots: NDArray[np.int32],
    full: NDArray[np.uint32],
    before: NDArray[np.uint16],
    tally: NDArray[np.int64],
) -> None:
    """Add ON events of one time and row: columns ``x + i`` for each bit i of a 32-bit *mask*."""
    pixels = np.uint64(before.shape[0])
    length = -(-width // GROUP) * GROUP
    if row >= height:
        tally[N_OUTSIDE] += count(np.uint32(mask))
        return
    first = x - x % GROUP
    both = np.uint64(mask) << np.uint64(x - first)
    for half in range(2):
        some = np.uint32(both >> np.uint64(GROUP * half))
        if some != 0:
            inside = inside_columns(some, first, width)
            n = count(inside)
            tally[N_OUTSIDE] += count(some) - n
            pixel = np.uint64(row * length + first)
            if t_us < begin_us:
                tally[N_BEFORE] += n
                while inside != 0:
                    count_before(pixel + np.uint64(trailing_zeros(inside)), before)
                    inside = np.uint32(inside & (inside - np.uint32(1)))
            elif t_us >= end_us:
                tally[N_AFTER] += n
            elif inside != 0:
                tally[N_ON] += n
                latch_group(pixel, inside, np.int32(t_us - begin_us), pixels, slots, full)
        first += GROUP


@kernel(
    f"void({_COLUMN.format('int64')}, {_COLUMN.format('uint16')}, {_COLUMN.format('uint16')}, "
    f"{_COLUMN.format('uint8')}, int64, int64, int64, int64, int64, {LATCH}, int64[:, ::1])"
)
def latch_first_on(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    size: int,
    begin_us: int,
    end_us: int,
    width: int,
    height: int,
    slots: NDArray[np.int32],
    _full: NDArray[np.uint32],
    before: NDArray[np.uint16],
    tally: NDArray[np.int64],
    listed: NDArray[np.int64],
) -> None:
    """Add the first *size* events of columns.

    In two steps over some events: those that count are listed (pixel and time in the rows of *listed*) without a branch
    on their polarity, which nobody can predict, and their pixels asked for, which no near cache holds; then latched.
    """
    n_on = n_before = n_after = 0
    n_outside: Integer = 0
    length = -(-width // GROUP) * GROUP
    pixels = np.uint64(before.shape[0])
    room = listed.shape[1]
    begun = 0
    while begun < size:
        until = min(begun + room, size)
        n: Integer = 0
        for i in range(begun, until):
            is_on = np.int64(on[i] == 1)
            inside = np.int64(x[i] < width) & np.int64(y[i] < height)
            k = np.int64(y[i]) * length + np.int64(x[i])
            listed[0, n], listed[1, n] = k, t_us[i]
            prefetch(slots, k)
            n += is_on & inside
            n_outside += is_on & ~inside & 1
        begun = until
        for i in range(n):
            pixel, t = np.uint64(listed[0, i]), listed[1, i]
            if t < begin_us:
                n_before += 1
                count_before(pixel, before)
            elif t >= end_us:
                n_after += 1
            else:
                n_on += 1
                latch_pixel(pixel, np.int32(t - begin_us), pixels, slots)
    tally[N_ON] += n_on
    tally[N_BEFORE] += n_before
    tally[N_AFTER] += n_after
    tally[N_OUTSIDE] += n_outside
