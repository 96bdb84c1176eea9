"""Events to EVT2 and EVT2.1 words, as a camera would send them.

For writing recordings. A TIME_HIGH is sent whenever it changes. Both formats have 34 bits of time and a decoder counts
turns, so a step that would hide one is bridged with TIME_HIGH words, and a step back that would look like one is
refused; smaller steps back decode as they were. EVT2.1 gathers consecutive events of one time, polarity, row and
32 columns, ascending, in one word.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import UsageError
from elpd.events.evt2 import HALF_RANGE, HIGH_BITS, LOW_BITS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

BRIDGE = HALF_RANGE // 2
"""Steps of TIME_HIGH that no decoder mistakes for a wrap or a step back (2.4 h)."""

TIME_HIGH, TRIGGER = 0x8, 0xA


class _Time:
    """Finds the TIME_HIGH words that a run of times needs."""

    def __init__(self) -> None:
        self._high = 0
        self._sent = False

    def highs(self, t: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return before which of the times a TIME_HIGH is needed, and its content (28 bits).

        Raises
        ------
        UsageError
            For a negative time, or a step back that a decoder would take for a wrap.
        """
        if t.size and int(t.min()) < 0:
            raise UsageError(f"EVT2 times begin at zero; got {t.min()} us; subtract the first one")
        high = t >> LOW_BITS
        steps = np.diff(high, prepend=self._high)
        back = (steps <= -HALF_RANGE) | ((steps < 0) & (high >> HIGH_BITS != (high - steps) >> HIGH_BITS))
        if back.any():
            at = int(np.argmax(back))
            raise UsageError(
                f"time steps back by {-int(steps[at]) << LOW_BITS} us to {int(t[at])} us, which EVT2 cannot say; "
                "write a format with whole times (npz, csv, hdf5)"
            )
        where = np.flatnonzero(steps)
        if t.size and not self._sent:
            where = np.union1d(where, [0])
        positions, contents = [], []
        far = steps[where] >= HALF_RANGE
        if far.any():
            for at in where[far].tolist():
                bridge = np.arange(int(high[at] - steps[at]) + BRIDGE, int(high[at]), BRIDGE)
                positions.append(np.full(bridge.size, at))
                contents.append(bridge)
        positions.append(where)
        contents.append(high[where])
        if t.size:
            self._high, self._sent = int(high[-1]), True
        at_all, content = np.concatenate(positions), np.concatenate(contents)
        order = np.lexsort((content, at_all)) if far.any() else slice(None)
        return at_all[order], content[order] & ((1 << HIGH_BITS) - 1)


class Evt2Encoder:
    """Encode events to EVT2 words (uint32)."""

    def __init__(self) -> None:
        self._time = _Time()

    def encode(self, t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> NDArray[np.uint32]:
        """Encode the next events. Raises ``UsageError`` for times that cannot be said."""
        t, x, y, p = (np.asarray(column, np.int64) for column in (t, x, y, p))
        words = (p == 1).astype(np.int64) << 28 | (t & 0x3F) << 22 | x << 11 | y
        return _with_highs(self._time, t, words, lambda high: TIME_HIGH << 28 | high).astype(np.uint32)

    def encode_trigger(self, t_us: int, channel: int, *, rising: bool) -> NDArray[np.uint32]:
        """Return the words of a trigger edge."""
        t = np.array([t_us], np.int64)
        words = TRIGGER << 28 | (t & 0x3F) << 22 | (channel & 0x1F) << 8 | int(rising)
        return _with_highs(self._time, t, words, lambda high: TIME_HIGH << 28 | high).astype(np.uint32)


class Evt21Encoder:
    """Encode events to EVT2.1 words (uint64, documented order)."""

    def __init__(self) -> None:
        self._time = _Time()

    def encode(self, t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> NDArray[np.uint64]:
        """Encode the next events. Raises ``UsageError`` for times that cannot be said."""
        t, x, y, p = (np.asarray(column, np.int64) for column in (t, x, y, p))
        upper = (p == 1).astype(np.int64) << 28 | (t & 0x3F) << 22 | (x & ~31) << 11 | y
        begins = np.ones(t.size, np.bool_)
        begins[1:] = (np.diff(upper) != 0) | (np.diff(t) != 0) | (np.diff(x) <= 0)
        first = np.flatnonzero(begins)
        masks = np.bitwise_or.reduceat(np.int64(1) << (x & 31), first) if first.size else first
        words = upper[first] << 32 | masks
        return _with_highs(self._time, t[first], words, lambda high: (TIME_HIGH << 28 | high) << 32).view(np.uint64)

    def encode_trigger(self, t_us: int, channel: int, *, rising: bool) -> NDArray[np.uint64]:
        """Return the words of a trigger edge."""
        t = np.array([t_us], np.int64)
        words = (TRIGGER << 28 | (t & 0x3F) << 22 | (channel & 0x1F) << 8 | int(rising)) << 32
        return _with_highs(self._time, t, words, lambda high: (TIME_HIGH << 28 | high) << 32).view(np.uint64)


def _with_highs(
    time: _Time,
    t: NDArray[np.int64],
    words: NDArray[np.int64],
    as_word: Callable[[NDArray[np.int64]], NDArray[np.int64]],
) -> NDArray[np.int64]:
    """Return *words*, of times *t*, with the TIME_HIGH words that they need among them."""
    where, highs = time.highs(t)
    return np.insert(words, where, as_word(highs))
