"""EVT3: 16-bit words to events, at any speed the camera can send them.

The machine of ``elpd.events.registers``, word by word. The rules are those of Prophesee's open decoder, whose output is
the field's reference; where its validators and its documentation leave freedom, this is what is done here:

* Everything before the first TIME_HIGH is dropped: those words have no time.
* A TIME_HIGH that changes sets the low part to zero, a repeated one keeps it. A high part that falls by 2048 or more is
  a wrap (each 16.777 s). TIME_LOW may step back (11 us were seen in a real recording): no clamp, no wrap.
* A row outside the sensor (bit 11, the second camera of a stereo pair, included) discards until the next ADDR_Y, as
  does the time before the first ADDR_Y.
* Vector words are taken one by one, because triples can be incomplete (a lost VECT_8 shifts nothing but its own
  columns). A column outside the sensor is discarded alone. The reference drops a whole triple whose base + 32 passes
  the width; no real recording has one with a bit inside the sensor, and sensors narrower than a multiple of 32 need it.
* Reserved words, 0x9999 padding and stray continuations are counted and skipped. Nothing in a stream can raise, nor
  move an access outside the arrays.

Counters of the camera's event-rate controller (OTHERS 0x014 before it, 0x016 after it, 28 bits in three continuations)
are summed: they tell the true event rate while the controller is dropping.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.bits import trailing_zeros
from elpd.events.decoder import WordDecoder
from elpd.events.jit import kernel
from elpd.events.registers import (
    BEFORE_TIME,
    CONTINUED_SEEN,
    CONTINUED_VALUE,
    COUNT_AFTER_CONTROLLER,
    COUNT_BEFORE_CONTROLLER,
    EVENTS,
    HIGH,
    LOOP,
    LOW,
    MAX_SIDE,
    NO_SUBTYPE,
    OTHERS,
    OTHERS_SUBTYPE,
    PADDING,
    RATE_AFTER,
    RATE_BEFORE,
    RATE_COUNTS,
    RESERVED,
    ROW,
    STRAY_CONTINUED,
    VECTOR_ON,
    VECTOR_X,
    X_OUT_OF_RANGE,
    Y_OUT_OF_RANGE,
    Integer,
    hold_trigger,
)
from elpd.records import Encoding

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Geometry

EVENTS_PER_WORD = 12
NEITHER_ROW_NOR_COLUMN = 0xD000
"""Bits of a word's kind that ADDR_Y and ADDR_X have not."""

WORDS = 'Array(uint16, 1, "C", readonly=True)'  # a writable array converts to it: one compilation for both


class Evt3Decoder(WordDecoder):
    """Decode EVT3 words (uint16), in pieces of any size, to arrays. See ``WordDecoder``."""

    def __init__(self, geometry: Geometry) -> None:
        super().__init__(geometry, decode, events_per_word=EVENTS_PER_WORD, low_bits=12, high_bits=12)


@kernel()
def forget_other(state: NDArray[np.int64]) -> None:
    """Let continuations from here on belong to nothing."""
    state[OTHERS_SUBTYPE] = NO_SUBTYPE
    state[CONTINUED_SEEN] = 0
    state[CONTINUED_VALUE] = 0


@kernel()
def take_rare_word(word: Integer, t: Integer, state: NDArray[np.int64], triggers: NDArray[np.int64]) -> None:
    """Account for a word that is neither time, address nor vector. *triggers* is (n, 3): t, id, rising."""
    kind = word >> 12
    content = word & 0xFFF
    if kind == 0xE:
        state[OTHERS_SUBTYPE] = content
        state[CONTINUED_SEEN] = 0
        state[CONTINUED_VALUE] = 0
        if content not in (COUNT_BEFORE_CONTROLLER, COUNT_AFTER_CONTROLLER):
            state[OTHERS] += 1
    elif kind in (0xF, 0x7):
        subtype = state[OTHERS_SUBTYPE]
        seen = state[CONTINUED_SEEN]
        if subtype == NO_SUBTYPE:
            state[STRAY_CONTINUED] += 1
        elif subtype not in (COUNT_BEFORE_CONTROLLER, COUNT_AFTER_CONTROLLER):
            pass
        elif kind == 0xF and seen < 2:
            state[CONTINUED_VALUE] |= content << (12 * seen)
            state[CONTINUED_SEEN] = seen + 1
        elif kind == 0x7 and seen == 2:
            count = state[CONTINUED_VALUE] | (content & 0xF) << 24
            state[RATE_BEFORE if subtype == COUNT_BEFORE_CONTROLLER else RATE_AFTER] += count
            state[RATE_COUNTS] += 1
            forget_other(state)
        else:
            state[STRAY_CONTINUED] += 1
            forget_other(state)
    elif kind == 0xA:
        hold_trigger(t, content >> 8, content & 1, state, triggers)
    elif word == 0x9999:
        state[PADDING] += 1
    else:
        state[RESERVED] += 1


@kernel()
def take_rare_words(
    words: NDArray[np.uint16], end: Any, t: Integer, state: NDArray[np.int64], triggers: NDArray[np.int64]
) -> Any:
    """Account for the rare word before index *end*, and for what surely belongs to it; return the new end.

    A quiet camera's rate counters are every tenth word: a whole one (a subtype and its three continuations) is taken at
    once, with the result that taking its words one by one would have.
    """
    word = np.int64(words[end - np.uint64(1)])
    content = word & 0xFFF
    if (
        word >> 12 == 0xE
        and content in (COUNT_BEFORE_CONTROLLER, COUNT_AFTER_CONTROLLER)
        and end + np.uint64(3) <= np.uint64(words.shape[0])
    ):
        first = np.int64(words[end])
        second = np.int64(words[end + np.uint64(1)])
        third = np.int64(words[end + np.uint64(2)])
        if first >> 12 == 0xF and second >> 12 == 0xF and third >> 12 == 0x7:
            count = (first & 0xFFF) | (second & 0xFFF) << 12 | (third & 0xF) << 24
            state[RATE_BEFORE if content == COUNT_BEFORE_CONTROLLER else RATE_AFTER] += count
            state[RATE_COUNTS] += 1
            forget_other(state)
            return end + np.uint64(3)
    take_rare_word(word, t, state, triggers)
    return end


@kernel()
def skip_to_time(words: NDArray[np.uint16], position: int, state: NDArray[np.int64]) -> int:
    """Return the index of the first TIME_HIGH at or after *position*, counting what is dropped before it."""
    while position < words.shape[0] and words[position] >> 12 != 0x8:
        state[BEFORE_TIME] += 1
        position += 1
    return position


@kernel(
    f"UniTuple(int64, 2)({WORDS}, int64, int64[::1], int64, int64, "
    "int64[::1], uint16[::1], uint16[::1], uint8[::1], int64[:, ::1])",
    serves=Encoding.EVT3.value,
)
def decode(  # noqa: C901  (one function: calls cost)
    words: NDArray[np.uint16],
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
    """Decode ``words[position:]`` into the four outputs, from their beginning.

    Stops early when fewer than ``EVENTS_PER_WORD`` places are left, so that one word always fits.

    Returns
    -------
    position, n
        The index of the first word not taken, and how many events were written.
    """
    if state[HIGH] < 0:
        position = skip_to_time(words, position, state)
    loop, high, low = state[LOOP], state[HIGH], state[LOW]
    row, vector_x, vector_on = state[ROW], state[VECTOR_X], state[VECTOR_ON]
    t = (loop << 24) + (high << 12) + low
    x_limit = width if row < height else 0
    room = out_t.shape[0] - EVENTS_PER_WORD
    n: Integer = 0
    y_out: Integer = 0
    x_out: Integer = 0
    i = np.uint64(position)
    size = np.uint64(words.shape[0])
    while i < size and n <= room:
        word = np.int64(words[i])
        i += np.uint64(1)
        if word & NEITHER_ROW_NOR_COLUMN == 0:
            # Which of the two it is nobody can predict: both are written, and a row is overwritten by what follows.
            is_column = word >> 13
            row = row if is_column else word
            x_limit = width if row < height else 0
            x = word & 0x7FF
            out_t[n], out_x[n], out_y[n], out_p[n] = t, x, row, (word >> 11) & 1
            is_inside = is_column & np.int64(x < x_limit)
            n += is_inside
            y_out += is_column & np.int64(x_limit == 0)
            x_out += is_column & ~is_inside & np.int64(x_limit != 0)
            continue
        kind = word >> 12
        if kind == 0x8:
            content = word & 0xFFF
            if content == high:
                continue
            if high >= 2048 + content:
                loop += 1
            high = content
            word = np.int64(0)
            kind = np.int64(0x6)
        # What mostly follows is taken at once: after a time a row, after a row a column.
        if kind == 0x6:
            low = word & 0xFFF
            t = (loop << 24) + (high << 12) + low
            if i == size:
                break
            word = np.int64(words[i])
            if word >> 12 != 0x0:
                continue
            i += np.uint64(1)
            row = word
            x_limit = width if row < height else 0
            if i == size:
                break
            word = np.int64(words[i])
            if word >> 12 != 0x2:
                continue
            i += np.uint64(1)
            x = word & 0x7FF
            if x < x_limit:
                out_t[n], out_x[n], out_y[n], out_p[n] = t, x, row, (word >> 11) & 1
                n += 1
            elif x_limit == 0:
                y_out += 1
            else:
                x_out += 1
            # After a row of one event a TIME_HIGH is often said again. It is stepped over, not branched on, for the
            # same reason.
            if i < size:
                i += np.uint64(words[i] == 0x8000 | high)
        elif kind == 0x3:
            vector_x = word & 0x7FF
            vector_on = (word >> 11) & 1
        elif kind in (0x4, 0x5):
            mask = np.uint32(word & 0xFFF if kind == 0x4 else word & 0xFF)
            while mask != 0:
                x = vector_x + np.int64(trailing_zeros(mask))
                mask = np.uint32(mask & (mask - np.uint32(1)))
                if x < x_limit:
                    out_t[n], out_x[n], out_y[n], out_p[n] = t, x, row, vector_on
                    n += 1
                elif x_limit == 0:
                    y_out += 1
                else:
                    x_out += 1
            # A base outside every sensor need not grow: it would overflow in the end.
            vector_x = min(vector_x + (12 if kind == 0x4 else 8), 2 * MAX_SIDE)
        else:
            i = take_rare_words(words, i, t, state, triggers)
    state[LOOP], state[HIGH], state[LOW] = loop, high, low
    state[ROW], state[VECTOR_X], state[VECTOR_ON] = row, vector_x, vector_on
    state[EVENTS] += n
    state[Y_OUT_OF_RANGE] += y_out
    state[X_OUT_OF_RANGE] += x_out
    taken: Any = np.int64(i)  # ``int`` would leave it unsigned, for kernels that know no signature of this one
    return taken, int(n)
