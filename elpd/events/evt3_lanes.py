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
from elpd.events.evt3 import take_rare_word
from elpd.events.evt3_lists import (
    BLOCKS,
    COLUMNS,
    COPIED,
    LANE_LOWS,
    LANE_ROWS,
    LEDGER,
    LOWS,
    N_RUNS,
    PLACES,
    RANK,
    ROWS,
    RUN,
    RUN_LOW,
    RUN_MASK,
    RUN_ON,
    RUN_RANK,
    RUN_ROW,
    RUN_X,
    RUNS,
    SETTLED,
    STOPPED,
    X_COLUMNS,
    X_LOWS,
    X_MASK,
    X_ROWS,
)
from elpd.events.evt3_others import TRIPLE, TRIPLE_KINDS, is_whole, join_triple, settle_last, settle_others
from elpd.events.jit import kernel
from elpd.events.lanes import (
    copy_run,
    count,
    entry,
    fill_run,
    four_words,
    highest,
    kinds,
    pack,
    pack_places,
    pack_run,
    pack_words,
    pack_words_before,
    spread,
    take_counts,
)
from elpd.events.registers import (
    HIGH,
    LOOP,
    LOW,
    MAX_SIDE,
    OTHERS,
    RATE_AFTER,
    RATE_BEFORE,
    RATE_COUNTS,
    ROW,
    VECTOR_ON,
    VECTOR_X,
    Integer,
)
from elpd.events.simd import LANES

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

AHEAD = LANES + 3
"""Words that must follow for a block to be taken: a triple may begin with its last word."""


@kernel()
def content_before(words: NDArray[np.uint16], place: Any, position: int, kind: int, otherwise: Any) -> Any:
    """Return what the nearest word of a *kind* before *place* says; *otherwise* if there is none since *position*."""
    while place > position:
        place -= 1
        if words[place] >> 12 == kind:
            return np.int64(words[place]) & 0xFFF
    return otherwise


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


@kernel()
def copy_x(lists: NDArray[np.uint32], begin: Any, end: Any, n: Any) -> None:
    """Append the events of ADDR_X words, from one to another, to the list of all events."""
    copy_run(lists, X_COLUMNS + begin, lists, COLUMNS + n, end - begin)
    copy_run(lists, X_ROWS + begin, lists, ROWS + n, end - begin)
    copy_run(lists, X_LOWS + begin, lists, LOWS + n, end - begin)


def _build_rest(timed: bool, whole: bool = False) -> Callable[..., Any]:  # noqa: FBT001, FBT002  (compile-time constants)
    @kernel()
    def take_rest(
        words: NDArray[np.uint16],
        position: int,
        state: NDArray[np.int64],
        triggers: NDArray[np.int64],
        n: Any,
        n_places: int,
        lists: NDArray[np.uint32],
        ledger: NDArray[np.int64],
    ) -> Any:
        base = (state[LOOP] << 24) + (state[HIGH] << 12)
        vector_x, vector_on = state[VECTOR_X], state[VECTOR_ON]
        copied: Any = 0
        settled: Any = 0
        for j in range(n_places):
            lane = entry(lists, PLACES + j)
            place = position + lane
            four = four_words(words, place)
            mask = np.uint32(0)
            width = 0
            if four & TRIPLE_KINDS == TRIPLE:
                vector_x = np.int64(four & np.uint64(0x7FF))
                vector_on = np.int64((four >> np.uint64(11)) & np.uint64(1))
                mask, width = join_triple(four), 32
            else:
                word = np.int64(four & np.uint64(0xFFFF))
                kind = word >> 12
                if kind == 0x3:
                    vector_x, vector_on = word & 0x7FF, (word >> 11) & 1
                elif kind == 0x4:
                    mask, width = np.uint32(word & 0xFFF), 12
                elif kind == 0x5:
                    mask, width = np.uint32(word & 0xFF), 8
                else:
                    settle_others(words, position, settled, lane, state)
                    settled = lane + 1
                    now = content_before(words, place, position, 0x6, state[LOW])
                    take_rare_word(word, base + now, state, triggers)
            if width > 0:
                rank: Any = 0
                if timed:
                    block = lane // LANES * LEDGER
                    before = np.uint32((np.uint64(1) << np.uint64(lane % LANES)) - np.uint64(1))
                    rank = ledger[block + RANK] + count(np.uint32(ledger[block + X_MASK]) & before)
                if whole:
                    run = RUNS + n * RUN
                    ledger[run + RUN_X], ledger[run + RUN_ON], ledger[run + RUN_MASK] = vector_x, vector_on, mask
                    ledger[run + RUN_ROW] = entry(lists, LANE_ROWS + lane)
                    ledger[run + RUN_LOW] = entry(lists, LANE_LOWS + lane)
                    ledger[run + RUN_RANK] = rank
                    n += 1
                elif timed:
                    copy_x(lists, copied, rank, n)
                    n += rank - copied
                    copied = rank
                    fill_run(entry(lists, LANE_LOWS + lane), lists, LOWS + n)
                if not whole:
                    pack_run(vector_x, vector_on, mask, lists, COLUMNS + n)
                    fill_run(entry(lists, LANE_ROWS + lane), lists, ROWS + n)
                    n += count(mask)
                # A base outside every sensor need not grow: it would overflow in the end.
                vector_x = min(vector_x + width, 2 * MAX_SIDE)
        state[VECTOR_X], state[VECTOR_ON] = vector_x, vector_on
        ledger[COPIED], ledger[SETTLED] = copied, settled
        return n

    return take_rest


_take_rest = _build_rest(timed=False)
_take_timed_rest = _build_rest(timed=True)
_take_whole_rest = _build_rest(timed=True, whole=True)


def _build(timed: bool, whole: bool = False) -> Callable[..., tuple[int, int, bool]]:  # noqa: C901, FBT001, FBT002  (calls cost)
    @kernel()
    def take_blocks(
        words: NDArray[np.uint16],
        position: int,
        state: NDArray[np.int64],
        triggers: NDArray[np.int64],
        low_from: int,
        low_until: int,
        lists: NDArray[np.uint32],
        ledger: NDArray[np.int64],
    ) -> tuple[int, int, bool]:
        columns, rows, lows = (X_COLUMNS, X_ROWS, X_LOWS) if timed else (COLUMNS, ROWS, LOWS)
        high = state[HIGH]
        n_x: Any = 0
        n_others: Any = 0
        n_counts: Any = 0
        last_count, last_other, last_low, last_row = -1, -1, -1, -1  # lanes
        n_places, b = 0, 0
        end: Any = LANES
        at: Any = position
        row_before, continued = np.uint32(0), np.uint32(0)
        while b < BLOCKS and at + AHEAD <= words.shape[0] and end == LANES:
            x, y, low, stop, vector, other, counted, triples, edge, odd = kinds(words, at, high, low_from, low_until)
            taken = np.uint32(0xFFFF_FFFF)
            if stop != 0:
                end = np.int64(trailing_zeros(stop))
                taken = np.uint32((np.uint64(1) << np.uint64(end)) - np.uint64(1))
                # A store keeps this a branch: as a selection the next block would wait for this one's words.
                ledger[STOPPED] = end
            begin = b * LANES
            x, y, low, other, odd = x & taken, y & taken, low & taken, other & taken, odd & taken
            if edge & taken != 0:
                for lane in range(LANES - 3, LANES):
                    if (edge & taken) >> np.uint32(lane) & np.uint32(1):
                        count_there, triple_there = is_whole(words, at + lane)
                        counted |= np.uint32(count_there) << np.uint32(lane)
                        triples |= np.uint32(triple_there) << np.uint32(lane)
            # Mostly each ADDR_X has a row of its own, right before it.
            if x & ~(y << np.uint32(1) | row_before) & np.uint32(0xFFFF_FFFF) | vector & taken == 0:
                pack_words_before(words, at, np.uint32(x), lists, rows + n_x)
            else:
                row = np.int64(words[position + last_row]) if last_row >= 0 else state[ROW]
                spread(words, at, np.uint32(y), row, lists, LANE_ROWS + begin)
                pack(lists, LANE_ROWS + begin, np.uint32(x), lists, rows + n_x)
            pack_words(words, at, np.uint32(x), lists, columns + n_x)
            if timed:
                now = np.int64(words[position + last_low]) if last_low >= 0 else state[LOW]
                spread(words, at, np.uint32(low), now & 0xFFF, lists, LANE_LOWS + begin)
                pack(lists, LANE_LOWS + begin, np.uint32(x), lists, lows + n_x)
                ledger[b * LEDGER + X_MASK], ledger[b * LEDGER + RANK] = x, n_x
            n_x += count(np.uint32(x))
            last_row = begin + highest(np.uint32(y)) if y != 0 else last_row
            last_low = begin + highest(np.uint32(low)) if low != 0 else last_low
            row_before = y >> np.uint32(31)
            counted &= taken
            last_count = begin + highest(np.uint32(counted)) if counted != 0 else last_count
            last_other = begin + highest(np.uint32(other)) if other != 0 else last_other
            n_counts += count(np.uint32(counted))
            n_others += count(np.uint32(other))
            # A time that stops a block does not stand within a phrase, so what reaches beyond reaches the next block.
            within = np.uint64((counted | triples) & taken) * np.uint64(0b1110)
            rest = np.uint32(odd & ~(within | np.uint64(continued) | np.uint64(other)))
            continued = np.uint32(within >> np.uint64(LANES))
            pack_places(begin, rest, lists, PLACES + n_places)
            n_places += count(rest)
            at += end
            b += 1
        at += 1 + highest(continued)

        if n_counts > 0:
            n_places, before, after = take_counts(words, position, lists, PLACES, n_places)
            state[RATE_BEFORE] += before
            state[RATE_AFTER] += after
            state[RATE_COUNTS] += n_counts
        n = 0 if timed else n_x
        if n_places > 0:
            if whole:
                n = _take_whole_rest(words, position, state, triggers, n, n_places, lists, ledger)
            elif timed:
                n = _take_timed_rest(words, position, state, triggers, n, n_places, lists, ledger)
            else:
                n = _take_rest(words, position, state, triggers, n, n_places, lists, ledger)
        if whole:
            ledger[N_RUNS] = n
            n = n_x
        elif timed:
            copied = ledger[COPIED] if n_places > 0 else np.int64(0)
            copy_x(lists, copied, n_x, n)
            n += n_x - copied
        state[OTHERS] += n_others
        settled = ledger[SETTLED] if n_places > 0 else np.int64(0)
        settle_last(words, position, settled, last_count, last_other, state)
        if last_low >= 0:
            state[LOW] = np.int64(words[position + last_low]) & 0xFFF
        if last_row >= 0:
            state[ROW] = words[position + last_row]
        return at, n, end < LANES

    return take_blocks


take_blocks = _build(timed=False)
take_timed_blocks = _build(timed=True)
take_whole_blocks = _build(timed=True, whole=True)
