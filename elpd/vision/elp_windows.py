"""The open window of the Event Laplacian Product, and how it closes.

Windows are half-open intervals between ascending edge times, so that they can be cut by time or by travel of the lens.
The sums of the open window live in an int64 array that the caller owns; a kernel keeps them in registers while it runs
and comes here only when time leaves the open window. Time may step back by some microseconds in a real stream: an event
whose window is closed already goes to the open one and is counted as late, because a window that has been handed on is
never taken back.

A kernel pauses, losing nothing, when the output rows are full or time has passed the last known edge; the caller makes
room or appends edges and calls again. After the last edge the open window has no end yet: edges may be appended as long
as time has not passed them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.events.registers import Integer

ELP, ENERGY, N_ON, N_OFF, N_CAPPED = 0, 1, 2, 3, 4
CURSOR = 5  # the open window begins at edges[CURSOR]; -1 before the first edge
N_EDGES, N_ROWS = 6, 7
LATE, LATE_MARK, EARLY, OUTSIDE, OUT_OF_SENSOR = 8, 9, 10, 11, 12
BEGIN, LENGTH = 13, 14  # of the times that need no attention
OPEN_ENDED, PAUSED, NOW = 15, 16, 17
WINDOW_SIZE = 18

NEVER = -(1 << 62)
FOREVER = 1 << 62

ROW_DTYPE = np.dtype([(name, "<i8") for name in ("begin_us", "end_us", "elp", "energy", "n_on", "n_off", "n_capped")])
"""One closed window: the integers of ``elpd.records.ElpSample``, in its order."""

ROW_COLUMNS = 7


def new_window() -> NDArray[np.int64]:
    """Return the state before the first edge."""
    window = np.zeros(WINDOW_SIZE, np.int64)
    window[CURSOR] = -1
    window[LATE_MARK] = -1
    window[NOW] = NEVER
    return window


@kernel("boolean(int64, int64[::1], int64[::1], int64[:, ::1])")
def move_to(t: Integer, window: NDArray[np.int64], edges: NDArray[np.int64], rows: NDArray[np.int64]) -> bool:
    """Close every window that ends at or before *t*; say whether events at *t* may be summed now.

    ``False`` means paused: no row left, or no edge after *t* is known and the caller wants to append some.
    """
    in_window = window[N_ON] + window[N_OFF]
    if window[LATE_MARK] >= 0:
        window[LATE] += in_window - window[LATE_MARK]
        window[LATE_MARK] = -1
    cursor = window[CURSOR]
    n_edges = window[N_EDGES]
    window[NOW] = t
    window[PAUSED] = 1
    window[LENGTH] = 0
    while cursor + 1 < n_edges and t >= edges[cursor + 1]:
        if cursor < 0:
            window[EARLY] += window[N_ON] + window[N_OFF]
        else:
            row = window[N_ROWS]
            if row == rows.shape[0]:
                window[CURSOR] = cursor
                return False
            rows[row, 0] = edges[cursor]
            rows[row, 1] = edges[cursor + 1]
            for column in range(5):
                rows[row, 2 + column] = window[ELP + column]
            window[N_ROWS] = row + 1
        for column in range(5):
            window[ELP + column] = 0
        cursor += 1
    window[CURSOR] = cursor
    if cursor + 1 == n_edges and window[OPEN_ENDED] == 0:
        return False
    window[PAUSED] = 0
    begin = edges[cursor] if cursor >= 0 else NEVER
    end = edges[cursor + 1] if cursor + 1 < n_edges else FOREVER
    window[BEGIN] = begin
    if t < begin:
        window[LATE_MARK] = window[N_ON] + window[N_OFF]
    else:
        window[LENGTH] = end - begin
    return True
