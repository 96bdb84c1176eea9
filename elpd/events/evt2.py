"""EVT2 (32-bit words) and EVT2.1 (64-bit words) to events.

Both carry the address and the low six bits of time in every event word and the upper 28 bits in TIME_HIGH, so time
wraps at 2^34 us (4.77 h); a high part that falls by half its range or more is a wrap. EVT2.1 names up to 32 pixels of
a row by a bit mask. Its words exist in two orders: as documented, and with the two 32-bit halves exchanged ("legacy",
what an IMX636 sends); readers and drivers put the halves right before anything else sees them (``swap_halves``).

As with EVT3: everything before the first TIME_HIGH is dropped, pixels outside the sensor and reserved words are
counted and skipped, and nothing in a stream can raise or move an access outside the arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.events.bits import trailing_zeros
from elpd.events.decoder import WordDecoder
from elpd.events.jit import kernel
from elpd.events.registers import (
    BEFORE_TIME,
    COUNT_AFTER_CONTROLLER,
    COUNT_BEFORE_CONTROLLER,
    EVENTS,
    HIGH,
    LOOP,
    LOW,
    OTHERS,
    RATE_AFTER,
    RATE_BEFORE,
    RATE_COUNTS,
    RESERVED,
    X_OUT_OF_RANGE,
    Y_OUT_OF_RANGE,
    Integer,
    hold_trigger,
)
from elpd.records import Encoding

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Geometry

LOW_BITS, HIGH_BITS = 6, 28
HALF_RANGE = 1 << (HIGH_BITS - 1)
COUNT_MASK = (1 << 22) - 1  # of an EVT2.1 rate-controller word
EVT2_WORDS = 'Array(uint32, 1, "C", readonly=True)'
EVT21_WORDS = 'Array(uint64, 1, "C", readonly=True)'
_OUTPUTS = "int64[::1], uint16[::1], uint16[::1], uint8[::1], int64[:, ::1]"


class Evt2Decoder(WordDecoder):
    """Decode EVT2 words (uint32), in pieces of any size, to arrays. See ``WordDecoder``."""

    def __init__(self, geometry: Geometry) -> None:
        super().__init__(geometry, decode_evt2, events_per_word=1, low_bits=LOW_BITS, high_bits=HIGH_BITS)


class Evt21Decoder(WordDecoder):
    """Decode EVT2.1 words (uint64, documented order), in pieces of any size, to arrays. See ``WordDecoder``."""

    def __init__(self, geometry: Geometry) -> None:
        super().__init__(geometry, decode_evt21, events_per_word=32, low_bits=LOW_BITS, high_bits=HIGH_BITS)


def swap_halves(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return EVT2.1 words with their 32-bit halves exchanged, as a copy."""
    return (words << np.uint64(32)) | (words >> np.uint64(32))


@kernel()
def take_time_high(content: Integer, state: NDArray[np.int64]) -> None:
    """Set the upper part of time; a repeated one changes nothing."""
    high = state[HIGH]
    if content != high:
        if high - content >= HALF_RANGE:
            state[LOOP] += 1
        state[HIGH] = content
        state[LOW] = 0


@kernel()
def take_rare_evt2_word(word: Integer, t: Integer, state: NDArray[np.int64], triggers: NDArray[np.int64]) -> None:
    """Account for a word that is neither an event nor TIME_HIGH. *t* is its time, where it has one."""
    kind = word >> 28
    if kind == 0xA:
        hold_trigger(t, (word >> 8) & 0x1F, word & 1, state, triggers)
    elif kind in (0xE, 0xF):
        state[OTHERS] += 1
    else:
        state[RESERVED] += 1


@kernel()
def take_rare_evt21_word(
    kind: Integer, upper: Integer, lower: Integer, t: Integer, state: NDArray[np.int64], triggers: NDArray[np.int64]
) -> None:
    """Account for a word, given as its halves, that is neither an event nor TIME_HIGH."""
    if kind == 0xA:
        hold_trigger(t, (upper >> 8) & 0x1F, upper & 1, state, triggers)
    elif kind == 0xE:
        subtype = upper & 0xFFFF
        if subtype in (COUNT_BEFORE_CONTROLLER, COUNT_AFTER_CONTROLLER):
            state[RATE_BEFORE if subtype == COUNT_BEFORE_CONTROLLER else RATE_AFTER] += lower & COUNT_MASK
            state[RATE_COUNTS] += 1
        else:
            state[OTHERS] += 1
    elif kind == 0xF:
        state[OTHERS] += 1
    else:
        state[RESERVED] += 1


@kernel(f"UniTuple(int64, 2)({EVT2_WORDS}, int64, int64[::1], int64, int64, {_OUTPUTS})", serves=Encoding.EVT2.value)
def decode_evt2(
    words: NDArray[np.uint32],
    position: int,
    state: NDArray[np.int64],
    width: int,
    height: int,
    out_t: NDArray[np.int64],
    out_x: NDArray[np.uint16],
    out_y: NDArray[np.uint16],
    out_p: NDArray[np.uint8],
    triggers: NDArray[np.int64],
) -> tuple[int, int]:
    """Decode ``words[position:]`` into the outputs, from their beginning, until they are full.

    Returns the index of the first word not taken, and how many events were written.
    """
    n = 0
    while position < words.shape[0] and n < out_t.shape[0]:
        word = np.int64(words[position])
        position += 1
        kind = word >> 28
        if kind == 0x8:
            take_time_high(word & 0xFFFFFFF, state)
            continue
        if state[HIGH] < 0:
            state[BEFORE_TIME] += 1
            continue
        t = (((state[LOOP] << HIGH_BITS) + state[HIGH]) << LOW_BITS) + ((word >> 22) & 0x3F)
        if kind > 0x1:
            take_rare_evt2_word(word, t, state, triggers)
            continue
        state[LOW] = t & 0x3F
        x = (word >> 11) & 0x7FF
        y = word & 0x7FF
        if y >= height:
            state[Y_OUT_OF_RANGE] += 1
        elif x >= width:
            state[X_OUT_OF_RANGE] += 1
        else:
            out_t[n] = t
            out_x[n] = x
            out_y[n] = y
            out_p[n] = kind
            n += 1
    state[EVENTS] += n
    return position, n


@kernel(f"UniTuple(int64, 2)({EVT21_WORDS}, int64, int64[::1], int64, int64, {_OUTPUTS})", serves=Encoding.EVT21.value)
def decode_evt21(
    words: NDArray[np.uint64],
    position: int,
    state: NDArray[np.int64],
    width: int,
    height: int,
    out_t: NDArray[np.int64],
    out_x: NDArray[np.uint16],
    out_y: NDArray[np.uint16],
    out_p: NDArray[np.uint8],
    triggers: NDArray[np.int64],
) -> tuple[int, int]:
    """Decode ``words[position:]`` into the outputs, from their beginning, until a word might not fit.

    Returns the index of the first word not taken, and how many events were written.
    """
    n = 0
    while position < words.shape[0] and n + 32 <= out_t.shape[0]:
        upper = np.int64(words[position] >> np.uint64(32))
        lower = np.uint32(words[position] & np.uint64(0xFFFFFFFF))
        position += 1
        kind = upper >> 28
        if kind == 0x8:
            take_time_high(upper & 0xFFFFFFF, state)
            continue
        if state[HIGH] < 0:
            state[BEFORE_TIME] += 1
            continue
        t = (((state[LOOP] << HIGH_BITS) + state[HIGH]) << LOW_BITS) + ((upper >> 22) & 0x3F)
        if kind > 0x1:
            take_rare_evt21_word(kind, upper, np.int64(lower), t, state, triggers)
            continue
        state[LOW] = t & 0x3F
        y = upper & 0x7FF
        while lower != 0:
            x = ((upper >> 11) & 0x7FF) + np.int64(trailing_zeros(lower))
            lower = np.uint32(lower & (lower - np.uint32(1)))
            if y >= height:
                state[Y_OUT_OF_RANGE] += 1
            elif x >= width:
                state[X_OUT_OF_RANGE] += 1
            else:
                out_t[n] = t
                out_x[n] = x
                out_y[n] = y
                out_p[n] = kind
                n += 1
    state[EVENTS] += n
    return position, n
