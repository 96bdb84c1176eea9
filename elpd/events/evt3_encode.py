"""Events to EVT3 words, as a camera would send them.

For simulated sensors and for writing recordings. Events are taken in the order given, which should be that of time;
ones of equal time are best grouped by row, then polarity, then column, because runs of five or more within 32 columns
then become a vector triple (base, 12, 12, 8), as in a real stream. TIME_HIGH is repeated, as a real camera does,
whenever 16 us have passed since the last one and there is something to say.

The format has 24 bits of time, and a decoder counts wraps: a pause that would hide one is bridged with TIME_HIGH
words, so that decoding gives back the times that were encoded, from zero on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import UsageError
from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.events.registers import Integer

WIDTH, LAST_HIGH, LAST_LOW, LAST_ROW, HIGH_SENT_US, NEXT_BASE, BASE_ON = 0, 1, 2, 3, 4, 5, 6
STATE_SIZE = 7

WORDS_PER_EVENT = 4  # TIME_HIGH, TIME_LOW, ADDR_Y, ADDR_X
HIGH_REPEAT_US = 16
BRIDGE = 1024  # steps of TIME_HIGH that no decoder mistakes for a wrap or a step back
VECTOR_PAYS_FROM = 5  # events; a triple costs four words


def new_encoder_state(width: int) -> NDArray[np.int64]:
    """Return the state before the first event; vectors are never sent where they would pass *width*."""
    state = np.full(STATE_SIZE, -1, np.int64)
    state[WIDTH] = width
    state[LAST_HIGH] = 0
    state[HIGH_SENT_US] = -HIGH_REPEAT_US
    return state


@kernel()
def put_time(t: int, state: NDArray[np.int64], out: NDArray[np.uint16], n: int) -> int:
    """Write the words that set the time; return the new count, or -1 when *out* is full."""
    high = t >> 12
    if high != state[LAST_HIGH] or t - state[HIGH_SENT_US] >= HIGH_REPEAT_US:
        last = state[LAST_HIGH]
        while high - last >= 2 * BRIDGE:
            last += BRIDGE
            if n == out.shape[0]:
                return -1
            out[n] = 0x8000 | (last & 0xFFF)
            n += 1
        if n == out.shape[0]:
            return -1
        out[n] = 0x8000 | (high & 0xFFF)
        n += 1
        if high != state[LAST_HIGH] or state[LAST_LOW] < 0:
            state[LAST_LOW] = 0
        state[LAST_HIGH] = high
        state[HIGH_SENT_US] = t
    low = t & 0xFFF
    if low != state[LAST_LOW]:
        if n == out.shape[0]:
            return -1
        out[n] = 0x6000 | low
        n += 1
        state[LAST_LOW] = low
    return n


_COLUMNS = ", ".join(f'Array({name}, 1, "C", readonly=True)' for name in ("int64", "uint16", "uint16", "uint8"))


@kernel(f"int64({_COLUMNS}, int64[::1], uint16[::1])")
def encode(
    t: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    state: NDArray[np.int64],
    out: NDArray[np.uint16],
) -> int:
    """Encode events into *out*, carrying *state* from call to call.

    Parameters
    ----------
    t, x, y, p : (n,) int64 us from zero, uint16, uint16, uint8 (1 is ON)
    state : int64, from ``new_encoder_state``
    out : uint16
        ``WORDS_PER_EVENT`` words per event always suffice, plus one for each 4.19 s of silence.

    Returns
    -------
    int
        How many words were written; -1 if *out* was too small, which leaves *state* unusable.
    """
    n = 0
    i = 0
    while i < t.shape[0]:
        n = put_time(t[i], state, out, n)
        if n < 0:
            return -1
        row = np.int64(y[i]) & 0x7FF
        if row != state[LAST_ROW]:
            if n == out.shape[0]:
                return -1
            out[n] = row
            n += 1
            state[LAST_ROW] = row
        base = np.int64(x[i]) & 0x7E0
        on = np.int64(p[i] == 1)
        mask: Integer = 0
        run = 0
        if base + 32 <= state[WIDTH]:
            last = np.int64(-1)
            while i + run < t.shape[0]:
                j = i + run
                column = np.int64(x[j])
                if t[j] != t[i] or y[j] != y[i] or (p[j] == 1) != (on == 1) or column <= last or column >= base + 32:
                    break
                mask |= 1 << (column - base)
                last = column
                run += 1
        if run >= VECTOR_PAYS_FROM:
            if n + 4 > out.shape[0]:
                return -1
            if state[NEXT_BASE] != base or state[BASE_ON] != on:
                out[n] = 0x3000 | (on << 11) | base
                n += 1
            out[n] = 0x4000 | (mask & 0xFFF)
            out[n + 1] = 0x4000 | ((mask >> 12) & 0xFFF)
            out[n + 2] = 0x5000 | ((mask >> 24) & 0xFF)
            n += 3
            state[NEXT_BASE] = base + 32
            state[BASE_ON] = on
            i += run
        else:
            if n == out.shape[0]:
                return -1
            out[n] = 0x2000 | (on << 11) | (np.int64(x[i]) & 0x7FF)
            n += 1
            i += 1
    return n


@kernel("int64(int64, int64[::1], uint16[::1])")
def encode_time(t: int, state: NDArray[np.int64], out: NDArray[np.uint16]) -> int:
    """Write the words that say only that it is *t* now; return their number, or -1 when *out* is too small."""
    return put_time(t, state, out, 0)


class Evt3Encoder:
    """Encode events to EVT3 words, with buffers of its own.

    Parameters
    ----------
    width : int
        Columns of the sensor.
    """

    def __init__(self, width: int) -> None:
        self._state = new_encoder_state(width)
        self._out = np.empty(4096, np.uint16)

    def encode(self, t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> NDArray[np.uint16]:
        """Encode the next events; the words returned are valid until the next call.

        Raises
        ------
        UsageError
            If a time is negative, or beyond what bridging can reach (a day).
        """
        t = np.ascontiguousarray(t, np.int64)
        if t.size and not 0 <= int(t.min()) <= int(t.max()) < 86_400_000_000:
            raise UsageError(f"EVT3 times run from 0 to one day; got {t.min()} .. {t.max()} us; subtract the first one")
        silence = int(t.max() - self._state[LAST_HIGH] * 4096) // 4_194_304 + 2 if t.size else 0
        self._reserve(WORDS_PER_EVENT * t.size + max(silence, 0) + 2)
        columns = (np.ascontiguousarray(x, np.uint16), np.ascontiguousarray(y, np.uint16))
        n = encode(t, *columns, np.ascontiguousarray(p, np.uint8), self._state, self._out)
        assert n >= 0, "the buffer holds the worst case"
        return self._out[:n]

    def encode_time(self, t_us: int) -> NDArray[np.uint16]:
        """Return the words that say only that it is *t_us* now, valid until the next call."""
        self._reserve(max(t_us - int(self._state[LAST_HIGH]) * 4096, 0) // 4_194_304 + 8)
        return self._out[: encode_time(t_us, self._state, self._out)]

    def encode_trigger(self, t_us: int, channel: int, *, rising: bool) -> NDArray[np.uint16]:
        """Return the words of a trigger edge at *t_us*, valid until the next call."""
        n = self.encode_time(t_us).size
        self._out[n] = 0xA000 | (channel & 0xF) << 8 | rising
        return self._out[: n + 1]

    def _reserve(self, capacity: int) -> None:
        if self._out.size < capacity:
            self._out = np.empty(2 * capacity, np.uint16)
