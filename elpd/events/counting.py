"""How many events of a packet lie in a region, when nothing else is wanted of them.

What is let go when too much waits should cost as little as can be: no times, no columns, no memory for events. EVT3
goes through the same blocks as the fused kernels, where the processor has them, and its lists of columns and rows are
compared 32 at a time. Each packet is judged alone: what comes before its first row belongs to no known row, and is not
counted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types

from elpd.events.bits import trailing_zeros
from elpd.events.evt2 import EVT2_WORDS, EVT21_WORDS
from elpd.events.evt3 import WORDS
from elpd.events.evt3_lanes import AHEAD, take_blocks, take_change_of_time
from elpd.events.evt3_lists import COLUMNS, LEDGER_SIZE, LISTS, ROWS
from elpd.events.jit import kernel
from elpd.events.lanes import BEYOND
from elpd.events.layout import event_columns
from elpd.events.registers import HIGH, MAX_SIDE, NO_ROW, NO_VECTOR, ROW, VECTOR_X, new_state
from elpd.events.simd import (
    I16,
    I64,
    LANES,
    Builder,
    Value,
    add,
    as_words,
    available,
    constant,
    lanes_left,
    load,
    operation,
    population,
    running,
    splat,
)
from elpd.events.simd import WORDS as BLOCK
from elpd.records import Encoding

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import CameraPacket, Roi


@kernel(f"int64({WORDS}, int64, int64[::1], int64, int64, int64, int64)", serves=Encoding.EVT3.value)
def count_evt3(
    words: NDArray[np.uint16], position: int, state: NDArray[np.int64], x: int, y: int, width: int, height: int
) -> int:
    """Return how many events of ``words[position:]`` lie in a region; keeps row and vector base in *state*."""
    row: Any = state[ROW]
    vector_x: Any = state[VECTOR_X]
    inside: Any = 0
    for i in range(position, words.shape[0]):
        word = np.int64(words[i])
        kind = word >> 12
        if kind == 0x0:
            row = word
        elif kind == 0x2:
            inside += np.int64(y <= row < y + height and x <= word & 0x7FF < x + width)
        elif kind == 0x3:
            vector_x = word & 0x7FF
        elif kind in (0x4, 0x5):
            mask = np.uint32(word & 0xFFF if kind == 0x4 else word & 0xFF)
            while mask != 0 and y <= row < y + height:
                inside += np.int64(x <= vector_x + np.int64(trailing_zeros(mask)) < x + width)
                mask = np.uint32(mask & (mask - np.uint32(1)))
            vector_x = min(vector_x + (12 if kind == 0x4 else 8), 2 * MAX_SIDE)
    return int(inside)


@kernel(f"int64({EVT2_WORDS}, int64, int64, int64, int64)", serves=Encoding.EVT2.value)
def count_evt2(words: NDArray[np.uint32], x: int, y: int, width: int, height: int) -> int:
    """Return how many events lie in a region."""
    inside: Any = 0
    for i in range(words.shape[0]):
        word = np.int64(words[i])
        column, row = (word >> 11) & 0x7FF, word & 0x7FF
        inside += np.int64((word >> 28) <= 0x1 and y <= row < y + height and x <= column < x + width)
    return int(inside)


@kernel(f"int64({EVT21_WORDS}, int64, int64, int64, int64)", serves=Encoding.EVT21.value)
def count_evt21(words: NDArray[np.uint64], x: int, y: int, width: int, height: int) -> int:
    """Return how many events lie in a region."""
    inside: Any = 0
    for i in range(words.shape[0]):
        upper = np.int64(words[i] >> np.uint64(32))
        row, column = upper & 0x7FF, (upper >> 11) & 0x7FF
        if upper >> 28 > 0x1 or not y <= row < y + height:
            continue
        mask = np.uint32(words[i] & np.uint64(0xFFFFFFFF))
        while mask != 0:
            inside += np.int64(x <= column + np.int64(trailing_zeros(mask)) < x + width)
            mask = np.uint32(mask & (mask - np.uint32(1)))
    return int(inside)


if available():  # elsewhere it does not compile

    @operation(
        types.int64,
        [types.uint32], types.int64, types.int64, types.int64, types.int64, types.int64, types.int64, types.int64,
    )  # fmt: skip
    def inside_of(
        builder: Builder,
        lists: Value,
        columns: Value,
        rows: Value,
        n: Value,
        x: Value,
        y: Value,
        width: Value,
        height: Value,
    ) -> Value:
        """Return how many of *n* listed events lie in a region."""
        inside = running(builder, I64)
        words = as_words(builder, lists)
        left, top, wide, high = (splat(builder, one, BLOCK) for one in (x, y, width, height))
        with cgutils.for_range_slice(builder, I64(0), n, I64(LANES)) as (begin, _):
            column = load(builder, words, builder.add(columns, begin), BLOCK)
            column = builder.and_(column, constant(BLOCK, BEYOND | 0x7FF))
            row = load(builder, words, builder.add(rows, begin), BLOCK)
            there = lanes_left(builder, begin, n, ir.VectorType(I16, LANES))
            there = builder.and_(there, builder.icmp_unsigned("<", builder.sub(column, left), wide))
            there = builder.and_(there, builder.icmp_unsigned("<", builder.sub(row, top), high))
            add(builder, inside, population(builder, there))
        return builder.load(inside)

    @kernel(
        f"int64({WORDS}, int64[::1], int64[:, ::1], int64, int64, int64, int64, uint32[::1], int64[::1])",
        serves=Encoding.EVT3.value,
    )
    def count_blocks(
        words: NDArray[np.uint16],
        state: NDArray[np.int64],
        triggers: NDArray[np.int64],
        x: int,
        y: int,
        width: int,
        height: int,
        lists: NDArray[np.uint32],
        ledger: NDArray[np.int64],
    ) -> int:
        """Do what ``count_evt3`` does, 32 words per step."""
        position = inside = 0
        while position + AHEAD <= words.shape[0]:
            position, n, stopped = take_blocks(words, position, state, triggers, 0, 4096, lists, ledger)
            inside += inside_of(lists, COLUMNS, ROWS, n, x, y, width, height)
            if stopped:
                take_change_of_time(words[position], state)
                position += 1
        return inside + count_evt3(words, position, state, x, y, width, height)


class EventCounter:
    """Counts the events of packets, each alone, that lie in a region."""

    def __init__(self, roi: Roi) -> None:
        self._region = (roi.x, roi.y, roi.width, roi.height)
        self._state = new_state()
        self._state[HIGH] = 0
        self._no_triggers = np.zeros((0, 3), np.int64)
        self._scratch = (np.zeros(LISTS, np.uint32), np.zeros(LEDGER_SIZE, np.int64)) if available() else ()

    def count(self, packet: CameraPacket) -> int:
        """Return how many there are."""
        words = packet.data
        match packet.encoding:
            case Encoding.EVT3:
                self._state[ROW], self._state[VECTOR_X] = NO_ROW, NO_VECTOR
                if available():
                    return int(count_blocks(words, self._state, self._no_triggers, *self._region, *self._scratch))
                return int(count_evt3(words, 0, self._state, *self._region))
            case Encoding.EVT2:
                return int(count_evt2(words, *self._region))
            case Encoding.EVT21:
                return int(count_evt21(words, *self._region))
        _, columns, rows, _ = event_columns(packet.data)
        x, y, width, height = self._region
        inside = (columns >= x) & (columns < x + width) & (rows >= y) & (rows < y + height)
        return int(np.count_nonzero(inside))
