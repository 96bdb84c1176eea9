"""EVT3 to arrays, 32 words per step: ``elpd.events.evt3`` for processors that have the instructions.

Outputs, registers and counters are those of the scalar decoder, to the bit, at any cut of the stream.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from elpd.events.decoder import WordDecoder
from elpd.events.evt3 import WORDS, Evt3Decoder, decode, skip_to_time
from elpd.events.evt3_lanes import AHEAD, take_change_of_time, take_timed_blocks
from elpd.events.evt3_lists import COLUMNS, EVENTS, LEDGER_SIZE, LISTS, LOWS, ROWS
from elpd.events.jit import kernel
from elpd.events.lanes_columns import unpack
from elpd.events.registers import EVENTS as EVENTS_SEEN
from elpd.events.registers import HIGH, LOOP, X_OUT_OF_RANGE, Y_OUT_OF_RANGE
from elpd.events.simd import available
from elpd.records import Encoding

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.events.decoder import DecodeKernel
    from elpd.records import Geometry

ALL_LOWS = 4096


if available():  # elsewhere it does not compile

    @kernel(
        f"UniTuple(int64, 2)({WORDS}, int64, int64[::1], int64, int64, "
        "int64[::1], uint16[::1], uint16[::1], uint8[::1], int64[:, ::1], uint32[::1], int64[::1])",
        serves=Encoding.EVT3.value,
    )
    def decode_blocks(
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
        lists: NDArray[np.uint32],
        ledger: NDArray[np.int64],
    ) -> tuple[int, int]:
        """Decode as ``elpd.events.evt3.decode`` does; stops early when fewer than ``EVENTS`` places are left."""
        if state[HIGH] < 0:
            position = skip_to_time(words, position, state)
            if position < words.shape[0]:
                state[HIGH] = np.int64(words[position]) & 0xFFF
        n = 0
        while position + AHEAD <= words.shape[0]:
            if n + EVENTS > out_t.shape[0]:
                return position, n
            base = (state[LOOP] << 24) + (state[HIGH] << 12)
            position, listed, stopped = take_timed_blocks(words, position, state, triggers, 0, ALL_LOWS, lists, ledger)
            written, no_row, no_column = unpack(
                lists, COLUMNS, ROWS, LOWS, listed, base, width, height, out_t[n:], out_x[n:], out_y[n:], out_p[n:]
            )
            n += written
            state[EVENTS_SEEN] += written
            state[Y_OUT_OF_RANGE] += no_row
            state[X_OUT_OF_RANGE] += no_column
            if stopped:
                take_change_of_time(words[position], state)
                position += 1
        position, more = decode(
            words, position, state, width, height, out_t[n:], out_x[n:], out_y[n:], out_p[n:], triggers
        )
        return position, n + more


class Evt3BlockDecoder(WordDecoder):
    """Decode EVT3 words (uint16), in pieces of any size, to arrays, with AVX-512 or AVX2. See ``WordDecoder``."""

    def __init__(self, geometry: Geometry) -> None:
        scratch = (np.zeros(LISTS, np.uint32), np.zeros(LEDGER_SIZE, np.int64))

        def run(*arguments: Any) -> Any:
            return decode_blocks(*arguments, *scratch)  # type: ignore[call-arg]  # *arguments is one to it

        super().__init__(geometry, cast("DecodeKernel", run), events_per_word=EVENTS, low_bits=12, high_bits=12)


def evt3_decoder(geometry: Geometry) -> WordDecoder:
    """Return the fastest decoder of EVT3 for this processor."""
    return Evt3BlockDecoder(geometry) if available() else Evt3Decoder(geometry)
