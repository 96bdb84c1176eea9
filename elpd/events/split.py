"""Cutting word streams by time, without decoding events.

A recording played as if live must come in packets of so many microseconds, as a camera batches them. These kernels
walk the words until the first that carries time at or past a limit, so that what was walked over is complete until
there, and pick up trigger edges on the way. They keep registers of their own, apart from any decoder's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.events.evt2 import (
    EVT2_WORDS,
    EVT21_WORDS,
    HIGH_BITS,
    LOW_BITS,
    take_rare_evt2_word,
    take_rare_evt21_word,
    take_time_high,
)
from elpd.events.evt3 import WORDS, skip_to_time, take_rare_word
from elpd.events.jit import kernel
from elpd.events.registers import HIGH, LOOP, LOW
from elpd.records import Encoding

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


@kernel(f"int64({WORDS}, int64, int64[::1], int64, int64[:, ::1])", serves=Encoding.EVT3.value)
def split_evt3(
    words: NDArray[np.uint16],
    position: int,
    state: NDArray[np.int64],
    until_us: int,
    triggers: NDArray[np.int64],
) -> int:
    """Return the index of the first word at or after *position* that sets the time to *until_us* or later.

    That word is not taken: the registers stand before it. Without such a word, all are taken.
    """
    if state[HIGH] < 0:
        position = skip_to_time(words, position, state)
    while position < words.shape[0]:
        word = np.int64(words[position])
        kind = word >> 12
        if kind == 0x6:
            low = word & 0xFFF
            if (state[LOOP] << 24) + (state[HIGH] << 12) + low >= until_us:
                break
            state[LOW] = low
        elif kind == 0x8:
            high = word & 0xFFF
            if high != state[HIGH]:
                loop = state[LOOP] + (1 if state[HIGH] >= 2048 + high else 0)
                if (loop << 24) + (high << 12) >= until_us:
                    break
                state[LOOP] = loop
                state[HIGH] = high
                state[LOW] = 0
        elif kind == 0xA:
            take_rare_word(word, (state[LOOP] << 24) + (state[HIGH] << 12) + state[LOW], state, triggers)
        position += 1
    return position


@kernel(f"int64({EVT2_WORDS}, int64, int64[::1], int64, int64[:, ::1])", serves=Encoding.EVT2.value)
def split_evt2(
    words: NDArray[np.uint32],
    position: int,
    state: NDArray[np.int64],
    until_us: int,
    triggers: NDArray[np.int64],
) -> int:
    """As ``split_evt3``, for EVT2; a TIME_HIGH alone does not end a packet."""
    while position < words.shape[0]:
        word = np.int64(words[position])
        kind = word >> 28
        if kind == 0x8:
            take_time_high(word & 0xFFFFFFF, state)
        elif state[HIGH] >= 0:
            t = (((state[LOOP] << HIGH_BITS) + state[HIGH]) << LOW_BITS) + ((word >> 22) & 0x3F)
            if kind in (0x0, 0x1, 0xA) and t >= until_us:
                break
            if kind > 0x1:
                take_rare_evt2_word(word, t, state, triggers)
            else:
                state[LOW] = t & 0x3F
        position += 1
    return position


@kernel(f"int64({EVT21_WORDS}, int64, int64[::1], int64, int64[:, ::1])", serves=Encoding.EVT21.value)
def split_evt21(
    words: NDArray[np.uint64],
    position: int,
    state: NDArray[np.int64],
    until_us: int,
    triggers: NDArray[np.int64],
) -> int:
    """As ``split_evt3``, for EVT2.1; a TIME_HIGH alone does not end a packet."""
    while position < words.shape[0]:
        upper = np.int64(words[position] >> np.uint64(32))
        kind = upper >> 28
        if kind == 0x8:
            take_time_high(upper & 0xFFFFFFF, state)
        elif state[HIGH] >= 0:
            t = (((state[LOOP] << HIGH_BITS) + state[HIGH]) << LOW_BITS) + ((upper >> 22) & 0x3F)
            if kind in (0x0, 0x1, 0xA) and t >= until_us:
                break
            if kind > 0x1:
                lower = np.int64(words[position] & np.uint64(0xFFFFFFFF))
                take_rare_evt21_word(kind, upper, lower, t, state, triggers)
            else:
                state[LOW] = t & 0x3F
        position += 1
    return position


SPLITTERS: dict[Encoding, Callable[..., int]] = {
    Encoding.EVT3: split_evt3,
    Encoding.EVT2: split_evt2,
    Encoding.EVT21: split_evt21,
}
"""The kernel for each encoding in words."""
