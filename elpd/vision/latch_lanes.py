"""``elpd.vision.latch_words``, 32 words per step: same arguments, same times and tallies, to the bit.

``elpd.events.evt3_lanes`` sorts the words into lists of events, as far as time stays before, inside or past the
interval, so that no event asks which of the three it is in. Those that are ON and inside the sensor are kept, sixteen
at a time, and their places asked for, which no near cache holds; then they are latched one by one.

Where vectors are full (a step of light that many pixels see at once), they stay whole instead: each is a mask over the
places of its group, and all its events are latched by one comparison and one store a plane. Each vector is then a
branch or two that nobody can predict, which pays from some eight columns on; a camera that watches an aperture open
sends two or three (EVK4). So what a stretch of words holds says how the next one is taken.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.bits import prefetch
from elpd.events.evt3 import skip_to_time
from elpd.events.evt3_lanes import AHEAD, take_change_of_time, take_timed_blocks, take_whole_blocks
from elpd.events.evt3_lists import (
    COLUMNS,
    LEDGER_OF_RUNS,
    LISTS,
    LOWS,
    N_RUNS,
    ROWS,
    RUN,
    RUN_LOW,
    RUN_MASK,
    RUN_ON,
    RUN_RANK,
    RUN_ROW,
    RUN_X,
    RUNS,
    X_COLUMNS,
    X_LOWS,
    X_ROWS,
)
from elpd.events.jit import kernel
from elpd.events.lanes import count, entry
from elpd.events.registers import HIGH, LOOP, LOW, Integer
from elpd.events.simd import available
from elpd.vision.latch import (
    GROUP,
    LISTED,
    N_AFTER,
    N_BEFORE,
    N_ON,
    N_OUTSIDE,
    count_before,
    latch_columns,
    latch_pixel,
)
from elpd.vision.latch_places import claim, keep_on, to_places
from elpd.vision.latch_words import ROOM, SIGNATURE, evt3_to_latch

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

LOWS_IN_HIGH = 4096
DENSE = 2
"""Events a word from which on vectors stay whole: single ones are one a word at most, a full vector eight."""


@kernel()
def latch_list(
    lists: NDArray[np.uint32],
    columns: Any,
    rows: Any,
    lows: Any,
    n: Any,
    base_us: Any,
    begin_us: int,
    end_us: int,
    width: int,
    height: int,
    slots: NDArray[np.int32],
    before: NDArray[np.uint16],
    tally: NDArray[np.int64],
) -> None:
    """Add *n* events of lists of columns, rows and low parts of times, all before, inside or past the interval."""
    n_on, n_outside = keep_on(lists, columns, rows, lows, n, width, height)
    tally[N_OUTSIDE] += n_outside
    if n_on == 0:
        return
    to_places(lists, n_on, -(-width // GROUP) * GROUP)
    pixels = np.uint64(before.shape[0])
    since_us = base_us - begin_us
    t_us = base_us + entry(lists, LOWS)
    if t_us < begin_us:
        tally[N_BEFORE] += n_on
        for i in range(n_on):
            count_before(np.uint64(lists[i]), before)
    elif t_us >= end_us:
        tally[N_AFTER] += n_on
    else:
        tally[N_ON] += n_on
        for i in range(n_on):
            prefetch(slots, lists[i])
        for i in range(n_on):
            latch_pixel(np.uint64(lists[i]), np.int32(since_us + entry(lists, LOWS + i)), pixels, slots)


@kernel()
def latch_vector(
    pixel: Any, mask: Any, time: Any, pixels: Any, slots: NDArray[np.int32], full: NDArray[np.uint32]
) -> None:
    """As ``elpd.vision.latch.latch_group``, all at once."""
    group = pixel >> np.uint64(5)
    rest = np.uint32(mask & ~full[group])
    if rest == 0:
        return
    rest = claim(slots, pixel, rest, time)
    if rest == 0:
        return
    rest = claim(slots, pixels + pixel, rest, time)
    if rest != 0:
        claim(slots, np.uint64(2) * pixels + pixel, rest, time)
        full[group] |= rest


@kernel()
def latch_whole(
    lists: NDArray[np.uint32],
    ledger: NDArray[np.int64],
    n: Any,
    base_us: Any,
    begin_us: int,
    end_us: int,
    width: int,
    height: int,
    slots: NDArray[np.int32],
    full: NDArray[np.uint32],
    before: NDArray[np.uint16],
    tally: NDArray[np.int64],
) -> Any:
    """Add what ``take_whole_blocks`` left, in the stream's order; return how many events those are, *n* of them single.

    The order matters, because which time of a pixel is its first says the order and nothing else.
    """
    pixels = np.uint64(before.shape[0])
    stride = -(-width // GROUP) * GROUP
    added: Integer = n
    latched: Any = 0
    for run in range(RUNS, RUNS + RUN * ledger[N_RUNS], RUN):
        mask, rank = np.uint32(ledger[run + RUN_MASK]), ledger[run + RUN_RANK]
        added += count(mask)
        if ledger[run + RUN_ON] == 0:
            continue
        if rank > latched:
            latch_list(
                lists, X_COLUMNS + latched, X_ROWS + latched, X_LOWS + latched, rank - latched, base_us, begin_us,
                end_us, width, height, slots, before, tally,
            )  # fmt: skip
            latched = rank
        x, row, t_us = ledger[run + RUN_X], ledger[run + RUN_ROW], base_us + ledger[run + RUN_LOW]
        if x % GROUP == 0 and x + GROUP <= width and row < height and begin_us <= t_us < end_us:
            tally[N_ON] += count(mask)
            latch_vector(np.uint64(row * stride + x), mask, np.int32(t_us - begin_us), pixels, slots, full)
        else:
            latch_columns(t_us, x, row, mask, begin_us, end_us, width, height, slots, full, before, tally)
    latch_list(
        lists, X_COLUMNS + latched, X_ROWS + latched, X_LOWS + latched, n - latched, base_us, begin_us,
        end_us, width, height, slots, before, tally,
    )  # fmt: skip
    return added


if available():  # elsewhere it does not compile

    @kernel(SIGNATURE)
    def evt3_to_latch_by_blocks(
        words: NDArray[np.uint16],
        position: int,
        state: NDArray[np.int64],
        triggers: NDArray[np.int64],
        begin_us: int,
        end_us: int,
        width: int,
        height: int,
        slots: NDArray[np.int32],
        full: NDArray[np.uint32],
        before: NDArray[np.uint16],
        tally: NDArray[np.int64],
        lists: NDArray[np.uint32],
        ledger: NDArray[np.int64],
        t_us: NDArray[np.int64],
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        on: NDArray[np.uint8],
        listed: NDArray[np.int64],
    ) -> None:
        """As ``evt3_to_latch``."""
        if state[HIGH] < 0:
            position = skip_to_time(words, position, state)
            if position == words.shape[0]:
                return
            state[HIGH] = np.int64(words[position]) & 0xFFF
        base = (state[LOOP] << 24) + (state[HIGH] << 12)
        is_dense = False
        while position + AHEAD <= words.shape[0]:
            t = base + state[LOW]
            low_from, low_until = np.int64(0), np.int64(LOWS_IN_HIGH)
            if t >= begin_us:
                low_from = min(max((begin_us if t < end_us else end_us) - base, low_from), low_until)
            if t < end_us:
                low_until = max(min((end_us if t >= begin_us else begin_us) - base, low_until), low_from)
            was = position
            if is_dense:
                position, n, stopped = take_whole_blocks(
                    words, position, state, triggers, low_from, low_until, lists, ledger
                )
                n = latch_whole(lists, ledger, n, base, begin_us, end_us, width, height, slots, full, before, tally)
            else:
                position, n, stopped = take_timed_blocks(
                    words, position, state, triggers, low_from, low_until, lists, ledger
                )
                latch_list(lists, COLUMNS, ROWS, LOWS, n, base, begin_us, end_us, width, height, slots, before, tally)
            is_dense = n > DENSE * (position - was)
            if stopped:
                take_change_of_time(words[position], state)
                position += 1
                base = (state[LOOP] << 24) + (state[HIGH] << 12)
        evt3_to_latch(
            words, position, state, triggers, begin_us, end_us, width, height, slots, full, before, tally,
            lists, ledger, t_us, x, y, on, listed,
        )  # fmt: skip


def latch_kernel() -> Callable[..., None]:
    """Return the fastest kernel for this processor."""
    return evt3_to_latch_by_blocks if available() else evt3_to_latch


def scratch() -> tuple[NDArray[Any], ...]:
    """Return the memory that any kernel works in."""
    return (
        np.zeros(LISTS, np.uint32),
        np.zeros(LEDGER_OF_RUNS, np.int64),
        *(np.zeros(ROOM, kind) for kind in (np.int64, np.uint16, np.uint16, np.uint8)),
        np.zeros((2, LISTED), np.int64),
    )
