"""Words to windows in one pass: decoding and summing fused, no event ever stored.

Each kernel comes in two builds from one body: plain, and with a causal per-pixel leaky rate cap that keeps a hot
pixel from speaking for the scene. The cap is a leaky bucket in integer arithmetic: a pixel may have ``CAP_EVENTS``
within ``CAP_US``, refilled one each ``CAP_US / CAP_EVENTS``; an event beyond is refused, counted, and does not fill
the bucket. With it goes, where it is wanted, a filter of background activity (``elpd.vision.background``). Both are
asked about events inside the region alone.

Decoding is bound by mispredicted branches, look-ups by the latency of a table that no level-2 cache holds. So they
are kept apart: a block of words leaves its events' table indexes in a small buffer that stays in the level-1 cache,
and a loop without branches then gathers and adds, many misses in flight at a time. Everything rare leaves through
``move_to`` or ``take_rare_words``. (Looking each event up as it was decoded made every miss wait behind a flushed
pipeline.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.bits import prefetch, trailing_zeros
from elpd.events.evt3 import NEITHER_ROW_NOR_COLUMN, WORDS, skip_to_time, take_rare_words
from elpd.events.evt3_others import TRIPLE, TRIPLE_KINDS, join_triple
from elpd.events.jit import kernel
from elpd.events.lanes import four_words
from elpd.events.registers import HIGH, LOOP, LOW, MAX_SIDE, ROW, VECTOR_ON, VECTOR_X, Integer
from elpd.records import Encoding
from elpd.vision.background import CELL, is_alone
from elpd.vision.elp_weights import OUT_OF_SENSOR_WEIGHT, OUTSIDE_WEIGHT, STRIDE
from elpd.vision.elp_windows import (
    BEGIN,
    ELP,
    ENERGY,
    LENGTH,
    N_CAPPED,
    N_OFF,
    N_ON,
    NEVER,
    OUT_OF_SENSOR,
    OUTSIDE,
    move_to,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

CAP_EVENTS = 8
CAP_US = 5000
REFILL_US = CAP_US // CAP_EVENTS
DEPTH_US = CAP_US - REFILL_US

UNCAPPED = "no rate cap"
"""Whom the plain builds serve: those who measure. A cycle always caps."""

BLOCK_WORDS = 256
PENDING = 12 * (BLOCK_WORDS + 4)
"""Room for the events of a block, and of the few words that may be taken along with its last."""

SIGNATURE = (
    f"int64({WORDS}, int64, int64[::1], int64[:, ::1], "
    "int16[::1], int64[::1], int64[::1], int64[:, ::1], int64, int64[::1], uint32[::1], int64[::1])"
)


def served(encoding: Encoding, *, capped: bool) -> str:
    """Return whom a build of a fused kernel serves (``kernel``)."""
    return encoding.value if capped else UNCAPPED


@kernel()
def sum_pending(pending: NDArray[np.uint32], n: Integer, table: NDArray[np.int16], window: NDArray[np.int64]) -> None:
    """Add *n* events, each its table index times two plus its polarity, to the open window."""
    elp = np.int64(0)
    energy = np.int64(0)
    n_inside = np.int64(0)
    n_on = np.int64(0)
    out_of_sensor = np.int64(0)
    for i in range(n):
        on = np.int64(pending[i] & np.uint32(1))
        entry = np.int64(table[pending[i] >> np.uint32(1)])
        inside = np.int64(entry > OUTSIDE_WEIGHT)
        weight = entry if entry > OUTSIDE_WEIGHT else np.int64(0)
        elp += (weight ^ -on) + on
        energy += weight * weight
        n_inside += inside
        n_on += inside & on
        out_of_sensor += np.int64(entry == OUT_OF_SENSOR_WEIGHT)
    window[ELP] += elp
    window[ENERGY] += energy
    window[N_ON] += n_on
    window[N_OFF] += n_inside - n_on
    window[OUTSIDE] += n - n_inside
    window[OUT_OF_SENSOR] += out_of_sensor


def new_buckets(size: int, support_us: int = 0) -> NDArray[np.int64]:
    """Return what ``sum_capped`` remembers of a table of *size* entries: a bucket each.

    Behind those, if *support_us* is not zero, lie that number and the cells of the filter of background activity.
    """
    buckets = np.full(size, NEVER, np.int64)
    if support_us == 0:
        return buckets
    cells = (size // STRIDE // CELL + 1) * (STRIDE // CELL)
    return np.concatenate((buckets, [support_us], np.full(cells, NEVER, np.int64)))


@kernel()
def sum_capped(
    pending: NDArray[np.uint32],
    times: NDArray[Any],
    first: int,
    base_us: Integer,
    n: Integer,
    table: NDArray[np.int16],
    window: NDArray[np.int64],
    bucket: NDArray[np.int64],
) -> None:
    """As ``sum_pending``, refusing the events of pixels that have had too many of late.

    Event i was at ``base_us + times[first + i]``. The buckets of a sensor are larger than any cache that is near, so
    they are all asked for first: without that an event took 18 ns on a dense recording, and 6 with.
    """
    support_us = bucket[table.shape[0]] if bucket.shape[0] > table.shape[0] else np.int64(0)
    for i in range(n):
        prefetch(bucket, np.uint64(pending[i] >> np.uint32(1)))
        if support_us > 0:
            prefetch(bucket, _cell_of(pending[i] >> np.uint32(1), table.shape[0]))
    elp = np.int64(0)
    energy = np.int64(0)
    n_inside = np.int64(0)
    n_on = np.int64(0)
    n_capped = np.int64(0)
    for i in range(n):
        index = np.uint64(pending[i] >> np.uint32(1))
        weight = np.int64(table[index])
        if weight <= OUTSIDE_WEIGHT:
            window[OUTSIDE] += 1
            window[OUT_OF_SENSOR] += weight == OUT_OF_SENSOR_WEIGHT
            continue
        t = base_us + np.int64(times[first + i])
        ready = max(bucket[index], t)
        if ready - t > DEPTH_US:
            n_capped += 1
            continue
        bucket[index] = ready + REFILL_US
        if support_us > 0:
            row, column = np.uint32(index) // np.uint32(STRIDE), np.uint32(index) % np.uint32(STRIDE)
            place = np.int64(row % np.uint32(CELL) * np.uint32(CELL) + column % np.uint32(CELL))
            if is_alone(t, place, bucket, _cell_of(np.uint32(index), table.shape[0]), support_us):
                n_capped += 1
                continue
        on = np.int64(pending[i] & np.uint32(1))
        elp += (weight ^ -on) + on
        energy += weight * weight
        n_inside += 1
        n_on += on
    window[ELP] += elp
    window[ENERGY] += energy
    window[N_ON] += n_on
    window[N_OFF] += n_inside - n_on
    window[N_CAPPED] += n_capped


@kernel()
def _cell_of(index: Any, size: int) -> Any:
    """Return where in the buckets of a table of *size* entries the cell of one of them (a ``uint32``) is."""
    row, column = index // np.uint32(STRIDE), index % np.uint32(STRIDE)
    cell = row // np.uint32(CELL) * np.uint32(STRIDE // CELL) + column // np.uint32(CELL)
    return np.uint64(size + 1) + np.uint64(cell)


@kernel()
def sum_block(
    capped: bool,  # noqa: FBT001  (a constant of the caller)
    pending: NDArray[np.uint32],
    pending_us: NDArray[np.int64],
    n: Integer,
    table: NDArray[np.int16],
    window: NDArray[np.int64],
    bucket: NDArray[np.int64],
) -> None:
    """Add the *n* events of a block to the open window."""
    if capped:
        sum_capped(pending, pending_us, 0, 0, n, table, window, bucket)
    else:
        sum_pending(pending, n, table, window)


def _build_evt3(capped: bool) -> Callable[..., int]:  # noqa: C901, FBT001  (one function: calls cost)
    @kernel(SIGNATURE, serves=served(Encoding.EVT3, capped=capped))
    def evt3_to_windows(  # noqa: C901
        words: NDArray[np.uint16],
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
        if state[HIGH] < 0:
            position = skip_to_time(words, position, state)
            if position == words.shape[0]:
                return position
            state[HIGH] = np.int64(words[position]) & 0xFFF
        base = (state[LOOP] << 24) + (state[HIGH] << 12)
        t = base + state[LOW]
        if not move_to(t, window, edges, rows):
            return position
        begin, length = window[BEGIN], np.uint64(window[LENGTH])
        high_word = np.int64(0x8000 | (base >> 12) & 0xFFF)
        last_row = table.shape[0] // STRIDE - 1
        row = state[ROW]
        paused = False
        i = np.uint64(position)
        size = np.uint64(words.shape[0])
        block_end = i
        n = np.uint64(0)
        while i < size:
            if i >= block_end:
                sum_block(capped, pending, pending_us, np.int64(n), table, window, bucket)
                n = np.uint64(0)
                block_end = i + np.uint64(BLOCK_WORDS)
            word = np.int64(words[i])
            i += np.uint64(1)
            if word & NEITHER_ROW_NOR_COLUMN == 0:
                # Which of the two it is nobody can predict: both are listed, and a row is overwritten by what follows.
                is_column = word >> 13
                row = row if is_column else word
                pending[n] = (min(row, last_row) * STRIDE + (word & 0x7FF)) << 1 | (word >> 11) & 1
                if capped:
                    pending_us[n] = t
                n += np.uint64(is_column)
                continue
            kind = word >> 12
            if kind == 0x8:
                if word == high_word:
                    continue
                if high_word >= 2048 + word:
                    base += 1 << 24
                base += (word - high_word) << 12
                high_word = word
                word = np.int64(0)
                kind = np.int64(0x6)
            # What mostly follows is taken at once: after a time a row, after a row a column.
            if kind == 0x6:
                t = base + (word & 0xFFF)
                if np.uint64(t - begin) >= length:
                    sum_block(capped, pending, pending_us, np.int64(n), table, window, bucket)
                    n = np.uint64(0)
                    paused = not move_to(t, window, edges, rows)
                    begin, length = window[BEGIN], np.uint64(window[LENGTH])
                    if paused:
                        break
                if i == size:
                    break
                word = np.int64(words[i])
                if word >> 12 != 0x0:
                    continue
                i += np.uint64(1)
                row = word
                if i == size:
                    break
                word = np.int64(words[i])
                if word >> 12 != 0x2:
                    continue
                i += np.uint64(1)
                pending[n] = (min(row, last_row) * STRIDE + (word & 0x7FF)) << 1 | (word >> 11) & 1
                if capped:
                    pending_us[n] = t
                n += np.uint64(1)
                # After an event with a time of its own a TIME_HIGH is often said again. It is stepped over, not
                # branched on, for the same reason.
                if i < size:
                    i += np.uint64(np.int64(words[i]) == high_word)
                continue
            if kind == 0x3:
                state[VECTOR_X], state[VECTOR_ON] = word & 0x7FF, (word >> 11) & 1
                if i + np.uint64(3) > size:
                    continue
                four = four_words(words, np.int64(i) - 1)
                if four & TRIPLE_KINDS != TRIPLE:
                    continue
                i += np.uint64(3)
                mask, vector_x, vector_on = join_triple(four), word & 0x7FF, (word >> 11) & 1
                first = min(row, last_row) * STRIDE + vector_x
                while mask != 0:
                    index = first + np.int64(trailing_zeros(mask))
                    mask = np.uint32(mask & (mask - np.uint32(1)))
                    pending[n] = index << 1 | vector_on
                    if capped:
                        pending_us[n] = t
                    n += np.uint64(1)
                state[VECTOR_X] = vector_x + 32
                continue
            if kind in (0x4, 0x5):
                vector_x, vector_on = state[VECTOR_X], state[VECTOR_ON]
                mask = np.uint32(word & 0xFFF if kind == 0x4 else word & 0xFF)
                while mask != 0:
                    column = min(vector_x + np.int64(trailing_zeros(mask)), MAX_SIDE)
                    mask = np.uint32(mask & (mask - np.uint32(1)))
                    pending[n] = (min(row, last_row) * STRIDE + column) << 1 | vector_on
                    if capped:
                        pending_us[n] = t
                    n += np.uint64(1)
                # A base outside every sensor need not grow: it would overflow in the end.
                state[VECTOR_X] = min(vector_x + (12 if kind == 0x4 else 8), 2 * MAX_SIDE)
                continue
            i = take_rare_words(words, i, t, state, triggers)
        sum_block(capped, pending, pending_us, np.int64(n), table, window, bucket)
        state[LOOP], state[HIGH], state[LOW], state[ROW] = base >> 24, (base >> 12) & 0xFFF, t - base, row
        if not paused:
            move_to(max(t, complete_until_us), window, edges, rows)
        return int(i)

    return evt3_to_windows


evt3_to_windows = _build_evt3(capped=False)
evt3_to_windows_capped = _build_evt3(capped=True)
