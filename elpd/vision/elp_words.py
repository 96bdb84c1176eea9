"""Words to windows in one pass: decoding and summing fused, no event ever stored.

Each kernel comes in two builds from one body: plain, and with a causal per-pixel leaky rate cap that keeps a hot
pixel from speaking for the scene. The cap is a leaky bucket in integer arithmetic: a pixel may have ``CAP_EVENTS``
within ``CAP_US``, refilled one each ``CAP_US / CAP_EVENTS``; an event beyond is refused, counted, and does not fill
the bucket.

The hot path of a word is short on purpose: an address word indexes the table and adds; a time word makes one unsigned
comparison against the open window. Everything rare leaves through ``move_to`` or ``take_rare_words``. What the hot path
does not need stays in memory, and two counts share a register, because there are not enough of them (measured: 8.0 to
5.4 ns a word on a quiet EVK4 stream, with unsigned indexes, which spare a test for negative ones).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.events.bits import trailing_zeros
from elpd.events.evt3 import WORDS, skip_to_time, take_rare_words
from elpd.events.jit import kernel
from elpd.events.registers import HIGH, LOOP, LOW, MAX_SIDE, ROW, VECTOR_ON, VECTOR_X, Integer
from elpd.vision.elp_weights import OUT_OF_SENSOR_WEIGHT, OUTSIDE_WEIGHT, STRIDE
from elpd.vision.elp_windows import (
    BEGIN,
    ELP,
    ENERGY,
    LENGTH,
    N_CAPPED,
    N_OFF,
    N_ON,
    OUT_OF_SENSOR,
    OUTSIDE,
    move_to,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

CAP_EVENTS = 8
CAP_US = 5000
REFILL_US = CAP_US // CAP_EVENTS
DEPTH_US = CAP_US - REFILL_US

SIGNATURE = (
    f"int64({WORDS}, int64, int64[::1], int64[:, ::1], "
    "int16[::1], int64[::1], int64[::1], int64[:, ::1], int64, int64[::1])"
)


@kernel()
def store_sums(  # noqa: D103
    window: NDArray[np.int64], elp: Integer, energy: Integer, n_on: Integer, n: Integer, n_capped: Integer
) -> None:
    window[ELP] = elp
    window[ENERGY] = energy
    window[N_ON] = n_on
    window[N_OFF] = n - n_on
    window[N_CAPPED] = n_capped


def _build_evt3(capped: bool) -> Callable[..., int]:  # noqa: C901, FBT001  (one function: calls cost)
    @kernel(SIGNATURE)
    def evt3_to_windows(  # noqa: C901
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
    ) -> int:
        if state[HIGH] < 0:
            position = skip_to_time(words, position, state)
            if position == words.shape[0]:
                return position
            state[HIGH] = np.int64(words[position]) & 0xFFF
        base = (state[LOOP] << 24) + (state[HIGH] << 12)
        t = base + state[LOW]
        if not move_to(t, window, edges, rows):
            return position
        begin, length = window[BEGIN], np.uint64(window[LENGTH])
        elp, energy, n_capped = window[ELP], window[ENERGY], window[N_CAPPED]
        counts = (window[N_ON] << 32) + window[N_ON] + window[N_OFF]
        outside = 0
        last_row = table.shape[0] // STRIDE - 1
        offset = min(state[ROW], last_row) * STRIDE
        paused = False
        i = np.uint64(position)
        size = np.uint64(words.shape[0])
        while i < size:
            word = np.int64(words[i])
            i += np.uint64(1)
            kind = word >> 12
            if kind == 0x0:
                state[ROW] = word
                offset = min(word, last_row) * STRIDE
                # Nearly every row word is followed by a column: no need to ask what it is twice.
                if i == size:
                    break
                word = np.int64(words[i])
                if word >> 12 != 0x2:
                    continue
                i += np.uint64(1)
                kind = np.int64(0x2)
            if kind == 0x2:
                index = np.uint64(offset + (word & 0x7FF))
                weight = np.int64(table[index])
                if weight > OUTSIDE_WEIGHT:
                    if capped:
                        ready = max(bucket[index], t)
                        if ready - t > DEPTH_US:
                            n_capped += 1
                            continue
                        bucket[index] = ready + REFILL_US
                    on = (word >> 11) & 1
                    elp += (weight ^ -on) + on
                    energy += weight * weight
                    counts += 1 + (on << 32)
                else:
                    outside += 1 + ((weight == OUT_OF_SENSOR_WEIGHT) << 32)
                continue
            if kind == 0x6:
                t = base + (word & 0xFFF)
            elif kind == 0x8:
                content = word & 0xFFF
                high = (base >> 12) & 0xFFF
                if content == high:
                    continue
                if high >= 2048 + content:
                    base += 1 << 24
                base += (content - high) << 12
                t = base
            elif kind == 0x3:
                state[VECTOR_X] = word & 0x7FF
                state[VECTOR_ON] = (word >> 11) & 1
                continue
            elif kind in (0x4, 0x5):
                vector_x, vector_on = state[VECTOR_X], state[VECTOR_ON]
                mask = np.uint32(word & 0xFFF if kind == 0x4 else word & 0xFF)
                while mask != 0:
                    x = min(vector_x + np.int64(trailing_zeros(mask)), MAX_SIDE)
                    mask = np.uint32(mask & (mask - np.uint32(1)))
                    index = np.uint64(offset + x)
                    weight = np.int64(table[index])
                    if weight > OUTSIDE_WEIGHT:
                        if capped:
                            ready = max(bucket[index], t)
                            if ready - t > DEPTH_US:
                                n_capped += 1
                                continue
                            bucket[index] = ready + REFILL_US
                        elp += (weight ^ -vector_on) + vector_on
                        energy += weight * weight
                        counts += 1 + (vector_on << 32)
                    else:
                        outside += 1 + ((weight == OUT_OF_SENSOR_WEIGHT) << 32)
                state[VECTOR_X] = min(vector_x + (12 if kind == 0x4 else 8), 2 * MAX_SIDE)
                continue
            else:
                i = take_rare_words(words, i, t, state, triggers)
                continue
            if np.uint64(t - begin) >= length:
                store_sums(window, elp, energy, counts >> 32, counts & 0xFFFFFFFF, n_capped)
                paused = not move_to(t, window, edges, rows)
                begin, length = window[BEGIN], np.uint64(window[LENGTH])
                elp, energy, n_capped = window[ELP], window[ENERGY], window[N_CAPPED]
                counts = (window[N_ON] << 32) + window[N_ON] + window[N_OFF]
                if paused:
                    break
        position = np.int64(i)
        store_sums(window, elp, energy, counts >> 32, counts & 0xFFFFFFFF, n_capped)
        window[OUTSIDE] += outside & 0xFFFFFFFF
        window[OUT_OF_SENSOR] += outside >> 32
        state[LOOP], state[HIGH], state[LOW] = base >> 24, (base >> 12) & 0xFFF, t - base
        if not paused:
            move_to(max(t, complete_until_us), window, edges, rows)
        return position

    return evt3_to_windows


evt3_to_windows = _build_evt3(capped=False)
evt3_to_windows_capped = _build_evt3(capped=True)
