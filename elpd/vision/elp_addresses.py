"""Events that carry their own time and address, to windows: arrays, EVT2 and EVT2.1.

The same windows, table and cap as ``elpd.vision.elp_words``, and the same division of work: a loop that only looks at
times finds how far the open window goes on, or a list fills until it ends; then one loop without branches weighs the
list. Events may come in any order, because nothing is taken for sorted: a run is what lies inside the window. Arrays
are read where they lie, in whatever layout a camera library packed them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.bits import trailing_zeros
from elpd.events.evt2 import (
    EVT2_WORDS,
    EVT21_WORDS,
    HIGH_BITS,
    LOW_BITS,
    take_rare_evt2_word,
    take_rare_evt21_word,
    take_time_high,
)
from elpd.events.jit import kernel
from elpd.events.registers import BEFORE_TIME, HIGH, LOOP, LOW, MAX_SIDE, Integer
from elpd.records import Encoding
from elpd.vision.elp_lanes import sum_list
from elpd.vision.elp_weights import STRIDE
from elpd.vision.elp_windows import BEGIN, LENGTH, NEVER, move_to
from elpd.vision.elp_words import served, sum_capped

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

RUN = 1024
"""Events listed at a time: what a level-1 cache holds with ease."""

_WINDOWS = "int16[::1], int64[::1], int64[::1], int64[:, ::1], int64, int64[::1], uint32[::1], int64[::1]"
ARRAYS_SIGNATURES = tuple(
    f'int64(Array({t}, 1, "A", readonly=True, aligned=False), Array(uint16, 1, "A", readonly=True, aligned=False), '
    'Array(uint16, 1, "A", readonly=True, aligned=False), Array(uint8, 1, "A", readonly=True, aligned=False), '
    f"int64, {_WINDOWS})"
    for t in ("int64", "uint32")
)
"""Any stride, any alignment, writable or not: every other layout converts to these without a copy."""


@kernel()
def sum_events(
    capped: bool,  # noqa: FBT001  (a constant of the caller)
    pending: NDArray[np.uint32],
    times: NDArray[Any],
    first: int,
    n: Integer,
    table: NDArray[np.int16],
    window: NDArray[np.int64],
    bucket: NDArray[np.int64],
) -> None:
    """Add *n* listed events to the open window; event i was at ``times[first + i]``."""
    if capped:
        sum_capped(pending, times, first, 0, n, table, window, bucket)
    else:
        sum_list(pending, n, table, window)


def _build_arrays(capped: bool) -> Callable[..., int]:  # noqa: FBT001  (a compile-time constant of the kernel)
    @kernel(*ARRAYS_SIGNATURES, serves=served(Encoding.ARRAY, capped=capped))
    def arrays_to_windows(
        ts: NDArray[np.int64],
        xs: NDArray[np.uint16],
        ys: NDArray[np.uint16],
        ps: NDArray[np.uint8],
        position: int,
        table: NDArray[np.int16],
        window: NDArray[np.int64],
        edges: NDArray[np.int64],
        rows: NDArray[np.int64],
        complete_until_us: int,
        bucket: NDArray[np.int64],
        pending: NDArray[np.uint32],
        _pending_us: NDArray[np.int64],
    ) -> int:
        begin, length = np.int64(0), np.uint64(0)
        last_row = table.shape[0] // STRIDE - 1
        size = ts.shape[0]
        t: Any = np.int64(NEVER)
        while position < size:
            t = np.int64(ts[position])
            if np.uint64(t - begin) >= length:
                if not move_to(t, window, edges, rows):
                    return position
                begin, length = window[BEGIN], np.uint64(window[LENGTH])
            until = min(position + RUN, size)
            end = position + 1
            while end < until and np.uint64(np.int64(ts[end]) - begin) < length:
                end += 1
            n = end - position
            for i in range(n):
                row = min(np.int64(ys[position + i]), last_row)
                column = min(np.int64(xs[position + i]), np.int64(MAX_SIDE))
                pending[i] = np.uint32((row * STRIDE + column) << 1 | np.int64(ps[position + i] == 1))
            sum_events(capped, pending, ts, position, n, table, window, bucket)
            position = end
            t = np.int64(ts[end - 1])
        if max(t, complete_until_us) > NEVER:
            move_to(max(t, complete_until_us), window, edges, rows)
        return position

    return arrays_to_windows


@kernel()
def base_of(state: NDArray[np.int64]) -> Any:
    """Return the time of the registers without its low part."""
    return ((state[LOOP] << HIGH_BITS) + state[HIGH]) << LOW_BITS


@kernel()
def finish(
    state: NDArray[np.int64],
    window: NDArray[np.int64],
    edges: NDArray[np.int64],
    rows: NDArray[np.int64],
    complete_until_us: int,
) -> None:
    """Settle the count of late events and close what the caller's promise closes."""
    t: Any = np.int64(NEVER)
    if state[HIGH] >= 0:
        t = base_of(state) + state[LOW]
    if max(t, complete_until_us) > NEVER:
        move_to(max(t, complete_until_us), window, edges, rows)


def _build_evt2(capped: bool) -> Callable[..., int]:  # noqa: FBT001  (a compile-time constant of the kernel)
    @kernel(
        f"int64({EVT2_WORDS}, int64, int64[::1], int64[:, ::1], {_WINDOWS})",
        serves=served(Encoding.EVT2, capped=capped),
    )
    def evt2_to_windows(
        words: NDArray[np.uint32],
        position: int,
        state: NDArray[np.int64],
        triggers: NDArray[np.int64],
        table: NDArray[np.int16],
        window: NDArray[np.int64],
        edges: NDArray[np.int64],
        rows: NDArray[np.int64],
        complete_until_us: int,
        bucket: NDArray[np.int64],
        pending: NDArray[np.uint32],
        pending_us: NDArray[np.int64],
    ) -> int:
        begin, length = np.int64(0), np.uint64(0)
        last_row = table.shape[0] // STRIDE - 1
        base = base_of(state)
        n = 0
        while position < words.shape[0]:
            word = np.int64(words[position])
            kind = word >> 28
            if kind == 0x8:
                take_time_high(word & 0xFFFFFFF, state)
                base = base_of(state)
                t = base + state[LOW]
            elif state[HIGH] < 0:
                state[BEFORE_TIME] += 1
                position += 1
                continue
            else:
                t = base + ((word >> 22) & 0x3F)
                if kind > 0x1:
                    take_rare_evt2_word(word, t, state, triggers)
                    position += 1
                    continue
                state[LOW] = t - base
            if np.uint64(t - begin) >= length:
                sum_events(capped, pending, pending_us, 0, n, table, window, bucket)
                n = 0
                if not move_to(t, window, edges, rows):
                    return position
                begin, length = window[BEGIN], np.uint64(window[LENGTH])
            if kind != 0x8:
                row = min(word & 0x7FF, last_row)
                pending[n] = np.uint32((row * STRIDE + ((word >> 11) & 0x7FF)) << 1 | kind)
                if capped:
                    pending_us[n] = t
                n += 1
                if n == RUN:
                    sum_events(capped, pending, pending_us, 0, n, table, window, bucket)
                    n = 0
            position += 1
        sum_events(capped, pending, pending_us, 0, n, table, window, bucket)
        finish(state, window, edges, rows, complete_until_us)
        return position

    return evt2_to_windows


def _build_evt21(capped: bool) -> Callable[..., int]:  # noqa: FBT001  (a compile-time constant of the kernel)
    @kernel(
        f"int64({EVT21_WORDS}, int64, int64[::1], int64[:, ::1], {_WINDOWS})",
        serves=served(Encoding.EVT21, capped=capped),
    )
    def evt21_to_windows(
        words: NDArray[np.uint64],
        position: int,
        state: NDArray[np.int64],
        triggers: NDArray[np.int64],
        table: NDArray[np.int16],
        window: NDArray[np.int64],
        edges: NDArray[np.int64],
        rows: NDArray[np.int64],
        complete_until_us: int,
        bucket: NDArray[np.int64],
        pending: NDArray[np.uint32],
        pending_us: NDArray[np.int64],
    ) -> int:
        begin, length = np.int64(0), np.uint64(0)
        last_row = table.shape[0] // STRIDE - 1
        base = base_of(state)
        n = 0
        while position < words.shape[0]:
            upper = np.int64(words[position] >> np.uint64(32))
            lower = np.uint32(words[position] & np.uint64(0xFFFFFFFF))
            kind = upper >> 28
            if kind == 0x8:
                take_time_high(upper & 0xFFFFFFF, state)
                base = base_of(state)
                t = base + state[LOW]
                lower = np.uint32(0)
            elif state[HIGH] < 0:
                state[BEFORE_TIME] += 1
                position += 1
                continue
            else:
                t = base + ((upper >> 22) & 0x3F)
                if kind > 0x1:
                    take_rare_evt21_word(kind, upper, np.int64(lower), t, state, triggers)
                if kind > 0x1 or lower == 0:
                    position += 1
                    continue
                state[LOW] = t - base
            if np.uint64(t - begin) >= length:
                sum_events(capped, pending, pending_us, 0, n, table, window, bucket)
                n = 0
                if not move_to(t, window, edges, rows):
                    return position
                begin, length = window[BEGIN], np.uint64(window[LENGTH])
            offset = min(upper & 0x7FF, last_row) * STRIDE
            first_x = (upper >> 11) & 0x7FF
            while lower != 0:
                column = min(first_x + np.int64(trailing_zeros(lower)), MAX_SIDE)
                lower = np.uint32(lower & (lower - np.uint32(1)))
                pending[n] = np.uint32((offset + column) << 1 | kind)
                if capped:
                    pending_us[n] = t
                n += 1
            if n > RUN - 32:
                sum_events(capped, pending, pending_us, 0, n, table, window, bucket)
                n = 0
            position += 1
        sum_events(capped, pending, pending_us, 0, n, table, window, bucket)
        finish(state, window, edges, rows, complete_until_us)
        return position

    return evt21_to_windows


arrays_to_windows = _build_arrays(capped=False)
arrays_to_windows_capped = _build_arrays(capped=True)
evt2_to_windows = _build_evt2(capped=False)
evt2_to_windows_capped = _build_evt2(capped=True)
evt21_to_windows = _build_evt21(capped=False)
evt21_to_windows_capped = _build_evt21(capped=True)
