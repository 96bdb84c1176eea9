"""The fused kernels of ``elpd.vision.elp_words``, 32 words per step: same arguments, same sums, to the bit.

What a block of words means is worked out by ``elpd.events.evt3_lanes``; what remains is a list of table indexes, which
are looked up sixteen at a time. Words that close a window or change the upper part of time are taken here, and the last
words of a piece by the scalar kernel, so that both keep the same registers at every cut.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.events.evt3 import skip_to_time
from elpd.events.evt3_lanes import AHEAD, take_blocks, take_change_of_time, take_timed_blocks
from elpd.events.evt3_lists import COLUMNS, LISTS, LOWS, ROWS, TIMES
from elpd.events.jit import kernel
from elpd.events.registers import HIGH, LOOP, LOW
from elpd.events.simd import available
from elpd.records import Encoding
from elpd.vision.elp_gather import to_addresses, weigh, weigh_pixels, widen
from elpd.vision.elp_weights import OUT_OF_SENSOR_WEIGHT, OUTSIDE_WEIGHT, STRIDE
from elpd.vision.elp_windows import BEGIN, ELP, ENERGY, LENGTH, N_OFF, N_ON, OUT_OF_SENSOR, OUTSIDE, move_to
from elpd.vision.elp_words import (
    PENDING,
    SIGNATURE,
    evt3_to_windows,
    evt3_to_windows_capped,
    served,
    sum_capped,
    sum_pending,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from elpd.events.registers import Integer

LOWS_IN_HIGH = 4096


if available():  # elsewhere it does not compile

    @kernel()
    def _add(found: tuple[int, int, int, int, int], n: Integer, window: NDArray[np.int64]) -> None:
        elp, energy, n_inside, n_on, out_of_sensor = found
        window[ELP] += elp
        window[ENERGY] += energy
        window[N_ON] += n_on
        window[N_OFF] += n_inside - n_on
        window[OUTSIDE] += n - n_inside
        window[OUT_OF_SENSOR] += out_of_sensor

    @kernel()
    def _sum_list(lists: NDArray[np.uint32], n: Integer, table: NDArray[np.int16], window: NDArray[np.int64]) -> None:
        """Add the first *n* events of a list of addresses to the open window."""
        _add(weigh(lists, n, table, OUTSIDE_WEIGHT, OUT_OF_SENSOR_WEIGHT), n, window)

    @kernel()
    def _sum_pixels(
        lists: NDArray[np.uint32], n: Integer, table: NDArray[np.int16], last_row: int, window: NDArray[np.int64]
    ) -> None:
        """Add the first *n* events of the lists of columns and rows to the open window."""
        found = weigh_pixels(lists, COLUMNS, ROWS, n, last_row, STRIDE, table, OUTSIDE_WEIGHT, OUT_OF_SENSOR_WEIGHT)
        _add(found, n, window)

    sum_list: Callable[..., None] = _sum_list
else:
    sum_list = sum_pending
"""Adds the first so many events of a list to the open window: the fastest for this processor."""


def _build_evt3(capped: bool) -> Callable[..., int]:  # noqa: FBT001  (a compile-time constant of the kernel)
    # Kernels are named below and not closed over, because numba's cache cannot know a kernel in a closure again.
    @kernel(SIGNATURE, serves=served(Encoding.EVT3, capped=capped))
    def evt3_to_windows_by_blocks(
        words: NDArray[np.uint16],
        position: int,
        state: NDArray[np.int64],
        triggers: NDArray[np.int64],
        table: NDArray[np.int16],
        window: NDArray[np.int64],
        edges: NDArray[np.int64],
        rows: NDArray[np.int64],
        complete_until_us: int,
        bucket: NDArray[np.int64],
        lists: NDArray[np.uint32],
        ledger: NDArray[np.int64],
    ) -> int:
        if state[HIGH] < 0:
            position = skip_to_time(words, position, state)
            if position == words.shape[0]:
                return position
            state[HIGH] = np.int64(words[position]) & 0xFFF
        base = (state[LOOP] << 24) + (state[HIGH] << 12)
        if not move_to(base + state[LOW], window, edges, rows):
            return position
        last_row = table.shape[0] // STRIDE - 1
        while position + AHEAD <= words.shape[0]:
            since = window[BEGIN] - base
            low_from = min(max(since, 0), LOWS_IN_HIGH)
            low_until = min(max(since + window[LENGTH], low_from), LOWS_IN_HIGH)
            if capped:
                position, n, stopped = take_timed_blocks(
                    words, position, state, triggers, low_from, low_until, lists, ledger
                )
                to_addresses(lists, COLUMNS, ROWS, n, last_row, STRIDE, 0)
                widen(lists, LOWS, n, TIMES)
                sum_capped(lists, lists, TIMES, base, n, table, window, bucket)
            else:
                position, n, stopped = take_blocks(words, position, state, triggers, low_from, low_until, lists, ledger)
                _sum_pixels(lists, n, table, last_row, window)
            if not stopped:
                continue
            take_change_of_time(words[position], state)
            position += 1
            base = (state[LOOP] << 24) + (state[HIGH] << 12)
            t = base + state[LOW]
            if np.uint64(t - window[BEGIN]) >= np.uint64(window[LENGTH]) and not move_to(t, window, edges, rows):
                return position
        if capped:
            return evt3_to_windows_capped(
                words, position, state, triggers, table, window, edges, rows, complete_until_us, bucket, lists, ledger
            )
        return evt3_to_windows(
            words, position, state, triggers, table, window, edges, rows, complete_until_us, bucket, lists, ledger
        )

    return evt3_to_windows_by_blocks


def kernels() -> tuple[Callable[..., int], Callable[..., int]]:
    """Return the fastest fused EVT3 kernels for this processor: without and with the rate cap."""
    if not available():
        return evt3_to_windows, evt3_to_windows_capped
    return _evt3_to_windows, _evt3_to_windows_capped


def scratch() -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Return the memory that any fused EVT3 kernel works in."""
    return np.zeros(LISTS, np.uint32), np.zeros(PENDING, np.int64)


if available():  # elsewhere it does not compile
    _evt3_to_windows = _build_evt3(capped=False)
    _evt3_to_windows_capped = _build_evt3(capped=True)
