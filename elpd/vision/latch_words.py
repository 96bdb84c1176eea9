"""EVT3 words to first ON times in one pass, without an array of all events: some are decoded, then latched.

This is the kernel of processors without vector instructions, and takes the last words of each piece for the others
(``elpd.vision.latch_lanes``). A stretch of events is small enough for the nearest cache, so decoding costs no memory,
and what waits for memory, the places of the pixels, does not wait behind a word whose kind was guessed wrongly.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.events.evt3 import EVENTS_PER_WORD, WORDS, decode
from elpd.events.jit import kernel
from elpd.events.registers import MAX_SIDE, NO_ROW
from elpd.vision.latch import LATCH, LISTED, latch_first_on

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

ROOM = LISTED + EVENTS_PER_WORD
"""Places of the columns that events are decoded to."""

ANY_COLUMN, ANY_ROW = 4 * MAX_SIDE, NO_ROW + 1
"""A sensor that everything is inside of: what is not inside the real one is the latch's to count."""

SCRATCH = "uint32[::1], int64[::1], int64[::1], uint16[::1], uint16[::1], uint8[::1], int64[:, ::1]"
SIGNATURE = f"void({WORDS}, int64, int64[::1], int64[:, ::1], int64, int64, int64, int64, {LATCH}, {SCRATCH})"


@kernel(SIGNATURE)
def evt3_to_latch(
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
    _lists: NDArray[np.uint32],
    _ledger: NDArray[np.int64],
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    listed: NDArray[np.int64],
) -> None:
    """Take ``words[position:]``: the ON events inside ``[begin_us, end_us)`` are kept, those outside it counted."""
    while position < words.shape[0]:
        position, n = decode(words, position, state, ANY_COLUMN, ANY_ROW, t_us, x, y, on, triggers)
        latch_first_on(t_us, x, y, on, n, begin_us, end_us, width, height, slots, full, before, tally, listed)
