"""EVT3 words to lists of addresses, 32 words per step: what the fast kernels begin with.

``take_blocks`` walks a stream as far as its time stays within bounds and leaves each event as a number in a list. It
works in two passes over some blocks, because a mispredicted branch costs more than a block does. The first pass has no
branches: it sorts words by kind, gives every lane its row (and time), and packs the addresses of all ADDR_X words and
the places of all words that are neither address nor time. The second walks those places: a vector triple, mostly whole,
is one masked run of addresses; whatever is rare goes where the scalar decoder sends it.

It stops *before* a word that changes the upper part of time or leaves the caller's bounds, which is the caller's to
take, and before the last words of a piece, which are the scalar kernel's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.bits import trailing_zeros
from elpd.events.evt3 import take_rare_words
from elpd.events.jit import kernel
from elpd.events.lanes import (
    LANES,
    addresses,
    copy_run,
    fill_run,
    four_words,
    kinds,
    pack,
    pack_places,
    pack_run,
    population,
    times,
)
from elpd.events.registers import (
    HIGH,
    LOOP,
    LOW,
    MAX_SIDE,
    NO_SUBTYPE,
    OTHERS_SUBTYPE,
    RATE_AFTER,
    RATE_BEFORE,
    RATE_COUNTS,
    ROW,
    VECTOR_ON,
    VECTOR_X,
    Integer,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

AHEAD = LANES + 3
"""Words that must follow for a block to be taken: a triple may begin with its last word."""

BLOCKS = 32
EVENTS = 12 * (LANES * BLOCKS + 3) + LANES
"""Room for a list of events: all that so many blocks can hold, and what a vector store touches beyond."""

LANE_WORDS = LANES * (BLOCKS + 1)
LOWS, OF_X, OF_X_LOWS, AT_LANES = EVENTS, 2 * EVENTS, 3 * EVENTS, 4 * EVENTS
LANE_LOWS, PLACES = AT_LANES + LANE_WORDS, AT_LANES + 2 * LANE_WORDS
LISTS = AT_LANES + 3 * LANE_WORDS
"""Scratch memory is one array of this size, because a kernel pays for each that it cuts: lists of events and of their
times, the same for ADDR_X alone, what each lane would mean, its time, and the places of words that need a look."""

X_MASK, RANK, LEDGER = 0, 1, 2

TRIPLE = np.uint64(0x5000_4000_4000_3000)
TRIPLE_KINDS = np.uint64(0xF000_F000_F000_F000)
RATE = np.uint64(0x7000_F000_F000_E014)
RATE_KINDS = np.uint64(0xF000_F000_F000_FFFD)  # one bit says whether before or after the controller


@kernel()
def low_before(words: NDArray[np.uint16], place: Any, position: int, low: Any) -> Any:
    """Return the low part of time that holds at *place*, if it was *low* at *position*."""
    while place > position:
        place -= 1
        if words[place] >> 12 == 0x6:
            return np.int64(words[place]) & 0xFFF
    return low


@kernel()
def take_change_of_time(word: Integer, state: NDArray[np.int64]) -> None:
    """Take the TIME_LOW or TIME_HIGH word at which ``take_blocks`` stopped."""
    content = np.int64(word) & 0xFFF
    if word >> 12 == 0x6:
        state[LOW] = content
        return
    if state[HIGH] >= 2048 + content:
        state[LOOP] += 1
    state[HIGH] = content
    state[LOW] = 0


def _build(timed: bool) -> Callable[..., tuple[int, int, bool]]:  # noqa: FBT001  (a compile-time constant)
    @kernel()
    def take_blocks(
        words: NDArray[np.uint16],
        position: int,
        state: NDArray[np.int64],
        triggers: NDArray[np.int64],
        low_from: int,
        low_until: int,
        last_row: int,
        stride: int,
        lists: NDArray[np.uint32],
        ledger: NDArray[np.int64],
    ) -> tuple[int, int, bool]:
        of_x, of_x_lows = (OF_X, OF_X_LOWS) if timed else (0, LOWS)
        high, low, row = state[HIGH], state[LOW], state[ROW]
        first_low = low

        n_x: Any = 0
        n_places, b = 0, 0
        end: Any = LANES
        at: Any = position
        while b < BLOCKS and at + AHEAD <= words.shape[0] and end == LANES:
            x_mask, y_mask, low_mask, odd, stop = kinds(words, at, high, low_from, low_until)
            end = np.int64(trailing_zeros(stop))
            taken = np.uint32((np.uint64(1) << np.uint64(end)) - np.uint64(1))
            begin = b * LANES
            row = addresses(words, at, y_mask & taken, row, last_row, stride, lists, AT_LANES + begin)
            pack(lists, AT_LANES + begin, x_mask & taken, lists, of_x + n_x)
            if timed:
                low = times(words, at, low_mask & taken, low, lists, LANE_LOWS + begin)
                pack(lists, LANE_LOWS + begin, x_mask & taken, lists, of_x_lows + n_x)
                ledger[b * LEDGER + X_MASK], ledger[b * LEDGER + RANK] = x_mask, n_x
            n_x += population(x_mask & taken)
            pack_places(begin, odd & taken, lists, PLACES + n_places)
            n_places += population(odd & taken)
            at += end
            b += 1
        if not timed:
            low = low_before(words, at, position, low)

        base = (state[LOOP] << 24) + (high << 12)
        vector_x, vector_on = state[VECTOR_X], state[VECTOR_ON]
        n = 0 if timed else n_x
        copied = 0
        j = np.uint64(0)
        rate_before = rate_after = rate_counts = np.int64(0)
        while j < n_places:
            lane = np.int64(lists[np.uint64(PLACES) + j])
            place = position + lane
            four = four_words(words, place)
            mask = np.uint32(0)
            size: Any = 1
            columns = 0
            if four & TRIPLE_KINDS == TRIPLE:
                vector_x = np.int64(four & np.uint64(0x7FF))
                vector_on = np.int64((four >> np.uint64(11)) & np.uint64(1))
                mask = np.uint32(
                    ((four >> np.uint64(16)) & np.uint64(0xFFF))
                    | ((four >> np.uint64(20)) & np.uint64(0xFFF000))
                    | ((four >> np.uint64(24)) & np.uint64(0xFF000000))
                )
                size, columns = 4, 32
            elif four & RATE_KINDS == RATE:
                count = (
                    ((four >> np.uint64(16)) & np.uint64(0xFFF))
                    | ((four >> np.uint64(20)) & np.uint64(0xFFF000))
                    | ((four >> np.uint64(24)) & np.uint64(0xF000000))
                )
                after = -np.int64((four >> np.uint64(1)) & np.uint64(1))
                rate_after += np.int64(count) & after
                rate_before += np.int64(count) & ~after
                rate_counts += 1
                state[OTHERS_SUBTYPE] = NO_SUBTYPE
                size = 4
            else:
                word = np.int64(four & np.uint64(0xFFFF))
                kind = word >> 12
                if kind == 0x3:
                    vector_x, vector_on = word & 0x7FF, (word >> 11) & 1
                elif kind == 0x4:
                    mask, columns = np.uint32(word & 0xFFF), 12
                elif kind == 0x5:
                    mask, columns = np.uint32(word & 0xFF), 8
                else:
                    now = np.int64(lists[LANE_LOWS + lane]) if timed else low_before(words, place, position, first_low)
                    begun = np.uint64(place)
                    after_rare = take_rare_words(words, begun + np.uint64(1), base + now, state, triggers)
                    size = np.int64(after_rare - begun)
            if columns > 0:
                if timed:
                    block = lane // LANES * LEDGER
                    before = np.uint32((np.uint64(1) << np.uint64(lane % LANES)) - np.uint64(1))
                    rank = ledger[block + RANK] + population(np.uint32(ledger[block + X_MASK]) & before)
                    copy_run(lists, of_x + copied, lists, n, rank - copied)
                    copy_run(lists, of_x_lows + copied, lists, LOWS + n, rank - copied)
                    n += rank - copied
                    copied = rank
                    fill_run(np.int64(lists[LANE_LOWS + lane]), lists, LOWS + n)
                # A lane's address is its row's, and what its word would add were it an ADDR_X.
                word = np.int64(four & np.uint64(0xFFFF))
                offset = np.int64(lists[AT_LANES + lane]) - (((word << 1) & 0xFFE) | ((word >> 11) & 1)) + vector_on
                pack_run(offset + 2 * vector_x, offset + 2 * MAX_SIDE, mask, lists, n)
                n += population(mask)
                # A base outside every sensor need not grow: it would overflow in the end.
                vector_x = min(vector_x + columns, 2 * MAX_SIDE)
            at = max(at, place + size)
            j += np.uint64(size)
        if timed:
            copy_run(lists, of_x + copied, lists, n, n_x - copied)
            copy_run(lists, of_x_lows + copied, lists, LOWS + n, n_x - copied)
            n += n_x - copied
        state[LOW], state[ROW] = low, row
        state[VECTOR_X], state[VECTOR_ON] = vector_x, vector_on
        state[RATE_BEFORE] += rate_before
        state[RATE_AFTER] += rate_after
        state[RATE_COUNTS] += rate_counts
        return at, n, end < LANES

    return take_blocks


take_blocks = _build(timed=False)
take_timed_blocks = _build(timed=True)
