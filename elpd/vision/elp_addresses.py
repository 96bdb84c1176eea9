"""Events that carry their own time and address, to windows: arrays, EVT2 and EVT2.1.

The same windows, table and cap as ``elpd.vision.elp_words``; here the unsigned comparison against the open window comes
with every event and is as good as never taken, so that finding a window's end costs less than searching for it would,
and events may come in any order. Arrays are read where they lie, in whatever layout a camera library packed them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.bits import trailing_zeros
from elpd.events.evt2 import (
    EVT2_WORDS,
    EVT21_WORDS,
    HIGH_BITS,
    LOW_BITS,
    take_rare_evt2_word,
    take_rare_evt21_word,
    take_time_high,
)
from elpd.events.jit import kernel
from elpd.events.registers import BEFORE_TIME, HIGH, LOOP, LOW, MAX_SIDE, Integer
from elpd.vision.elp_weights import OUT_OF_SENSOR_WEIGHT, OUTSIDE_WEIGHT, STRIDE
from elpd.vision.elp_windows import (
    BEGIN,
    ELP,
    ENERGY,
    LENGTH,
    N_CAPPED,
    N_OFF,
    N_ON,
    NEVER,
    OUT_OF_SENSOR,
    OUTSIDE,
    move_to,
)
from elpd.vision.elp_words import DEPTH_US, REFILL_US

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

_WINDOWS = "int16[::1], int64[::1], int64[::1], int64[:, ::1], int64, int64[::1]"
ARRAYS_SIGNATURES = tuple(
    f'int64(Array({t}, 1, "A", readonly=True, aligned=False), Array(uint16, 1, "A", readonly=True, aligned=False), '
    'Array(uint16, 1, "A", readonly=True, aligned=False), Array(uint8, 1, "A", readonly=True, aligned=False), '
    f"int64, {_WINDOWS})"
    for t in ("int64", "uint32")
)
"""Any stride, any alignment, writable or not: every other layout converts to these without a copy."""


@kernel()
def add_event(
    t: Integer,
    x: Integer,
    y: Integer,
    on: Integer,
    capped: bool,  # noqa: FBT001  (a constant of the caller)
    table: NDArray[np.int16],
    window: NDArray[np.int64],
    bucket: NDArray[np.int64],
) -> None:
    """Add one event to the open window."""
    last_row = table.shape[0] // STRIDE - 1
    index = np.uint64(min(y, last_row) * STRIDE + min(x, MAX_SIDE))
    weight = np.int64(table[index])
    if weight <= OUTSIDE_WEIGHT:
        window[OUTSIDE] += 1
        window[OUT_OF_SENSOR] += weight == OUT_OF_SENSOR_WEIGHT
        return
    if capped:
        ready = max(bucket[index], t)
        if ready - t > DEPTH_US:
            window[N_CAPPED] += 1
            return
        bucket[index] = ready + REFILL_US
    window[ELP] += (weight ^ -on) + on
    window[ENERGY] += weight * weight
    window[N_ON] += on
    window[N_OFF] += 1 - on


@kernel()
def store_sums(
    window: NDArray[np.int64], elp: Integer, energy: Integer, n_on: Integer, n: Integer, n_capped: Integer
) -> None:
    """Put the sums of the open window back where they are kept."""
    window[ELP] = elp
    window[ENERGY] = energy
    window[N_ON] = n_on
    window[N_OFF] = n - n_on
    window[N_CAPPED] = n_capped


def _build_arrays(capped: bool) -> Callable[..., int]:  # noqa: FBT001  (a compile-time constant of the kernel)
    @kernel(*ARRAYS_SIGNATURES)
    def arrays_to_windows(
        ts: NDArray[np.int64],
        xs: NDArray[np.uint16],
        ys: NDArray[np.uint16],
        ps: NDArray[np.uint8],
        position: int,
        table: NDArray[np.int16],
        window: NDArray[np.int64],
        edges: NDArray[np.int64],
        rows: NDArray[np.int64],
        complete_until_us: int,
        bucket: NDArray[np.int64],
    ) -> int:
        begin, length = np.int64(0), np.uint64(0)
        elp, energy, n_on, n_capped = window[ELP], window[ENERGY], window[N_ON], window[N_CAPPED]
        n = n_on + window[N_OFF]
        outside = 0
        out_of_sensor = 0
        last_row = table.shape[0] // STRIDE - 1
        t: Any = np.int64(NEVER)
        while position < ts.shape[0]:
            t = np.int64(ts[position])
            if np.uint64(t - begin) >= length:
                store_sums(window, elp, energy, n_on, n, n_capped)
                if not move_to(t, window, edges, rows):
                    window[OUTSIDE] += outside
                    window[OUT_OF_SENSOR] += out_of_sensor
                    return position
                begin, length = window[BEGIN], np.uint64(window[LENGTH])
                elp, energy, n_on, n_capped = window[ELP], window[ENERGY], window[N_ON], window[N_CAPPED]
                n = n_on + window[N_OFF]
            index = np.uint64(
                min(np.int64(ys[position]), last_row) * STRIDE + min(np.int64(xs[position]), np.int64(MAX_SIDE))
            )
            on = np.int64(ps[position] == 1)
            position += 1
            weight = np.int64(table[index])
            if weight > OUTSIDE_WEIGHT:
                if capped:
                    ready = max(bucket[index], t)
                    if ready - t > DEPTH_US:
                        n_capped += 1
                        continue
                    bucket[index] = ready + REFILL_US
                elp += (weight ^ -on) + on
                energy += weight * weight
                n_on += on
                n += 1
            else:
                outside += 1
                out_of_sensor += weight == OUT_OF_SENSOR_WEIGHT
        store_sums(window, elp, energy, n_on, n, n_capped)
        window[OUTSIDE] += outside
        window[OUT_OF_SENSOR] += out_of_sensor
        if max(t, complete_until_us) > NEVER:
            move_to(max(t, complete_until_us), window, edges, rows)
        return position

    return arrays_to_windows


@kernel()
def reach(
    state: NDArray[np.int64], window: NDArray[np.int64], edges: NDArray[np.int64], rows: NDArray[np.int64]
) -> bool:
    """Let the time of the registers close windows; say whether to go on."""
    t = (((state[LOOP] << HIGH_BITS) + state[HIGH]) << LOW_BITS) + state[LOW]
    if np.uint64(t - window[BEGIN]) < np.uint64(window[LENGTH]):
        return True
    return bool(move_to(t, window, edges, rows))


@kernel()
def finish(
    state: NDArray[np.int64],
    window: NDArray[np.int64],
    edges: NDArray[np.int64],
    rows: NDArray[np.int64],
    complete_until_us: int,
) -> None:
    """Settle the count of late events and close what the caller's promise closes."""
    t: Any = np.int64(NEVER)
    if state[HIGH] >= 0:
        t = (((state[LOOP] << HIGH_BITS) + state[HIGH]) << LOW_BITS) + state[LOW]
    if max(t, complete_until_us) > NEVER:
        move_to(max(t, complete_until_us), window, edges, rows)


def _build_evt2(capped: bool) -> Callable[..., int]:  # noqa: FBT001  (a compile-time constant of the kernel)
    @kernel(f"int64({EVT2_WORDS}, int64, int64[::1], int64[:, ::1], {_WINDOWS})")
    def evt2_to_windows(
        words: NDArray[np.uint32],
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
        window[LENGTH] = 0
        while position < words.shape[0]:
            word = np.int64(words[position])
            kind = word >> 28
            if kind == 0x8:
                take_time_high(word & 0xFFFFFFF, state)
                if not reach(state, window, edges, rows):
                    return position
            elif state[HIGH] < 0:
                state[BEFORE_TIME] += 1
            else:
                t = (((state[LOOP] << HIGH_BITS) + state[HIGH]) << LOW_BITS) + ((word >> 22) & 0x3F)
                if kind > 0x1:
                    take_rare_evt2_word(word, t, state, triggers)
                else:
                    state[LOW] = t & 0x3F
                    if np.uint64(t - window[BEGIN]) >= np.uint64(window[LENGTH]) and not move_to(
                        t, window, edges, rows
                    ):
                        return position
                    add_event(t, (word >> 11) & 0x7FF, word & 0x7FF, kind, capped, table, window, bucket)
            position += 1
        finish(state, window, edges, rows, complete_until_us)
        return position

    return evt2_to_windows


def _build_evt21(capped: bool) -> Callable[..., int]:  # noqa: FBT001  (a compile-time constant of the kernel)
    @kernel(f"int64({EVT21_WORDS}, int64, int64[::1], int64[:, ::1], {_WINDOWS})")
    def evt21_to_windows(
        words: NDArray[np.uint64],
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
        window[LENGTH] = 0
        while position < words.shape[0]:
            upper = np.int64(words[position] >> np.uint64(32))
            lower = np.uint32(words[position] & np.uint64(0xFFFFFFFF))
            kind = upper >> 28
            if kind == 0x8:
                take_time_high(upper & 0xFFFFFFF, state)
                if not reach(state, window, edges, rows):
                    return position
            elif state[HIGH] < 0:
                state[BEFORE_TIME] += 1
            else:
                t = (((state[LOOP] << HIGH_BITS) + state[HIGH]) << LOW_BITS) + ((upper >> 22) & 0x3F)
                if kind > 0x1:
                    take_rare_evt21_word(kind, upper, np.int64(lower), t, state, triggers)
                elif lower != 0:
                    state[LOW] = t & 0x3F
                    if np.uint64(t - window[BEGIN]) >= np.uint64(window[LENGTH]) and not move_to(
                        t, window, edges, rows
                    ):
                        return position
                    while lower != 0:
                        x = ((upper >> 11) & 0x7FF) + np.int64(trailing_zeros(lower))
                        lower = np.uint32(lower & (lower - np.uint32(1)))
                        add_event(t, x, upper & 0x7FF, kind, capped, table, window, bucket)
            position += 1
        finish(state, window, edges, rows, complete_until_us)
        return position

    return evt21_to_windows


arrays_to_windows = _build_arrays(capped=False)
arrays_to_windows_capped = _build_arrays(capped=True)
evt2_to_windows = _build_evt2(capped=False)
evt2_to_windows_capped = _build_evt2(capped=True)
evt21_to_windows = _build_evt21(capped=False)
evt21_to_windows_capped = _build_evt21(capped=True)
