"""Word streams to test with: every kind of word, sense and nonsense, and places to cut them."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st
from numpy.typing import NDArray

from elpd.events.simd import available
from elpd.events.stream import EventStream, open_recording

needs_lanes = pytest.mark.skipif(not available(), reason="this processor has neither AVX-512 nor AVX2")
sizes = st.integers(1, 70)
seeds = st.integers(0, 2**32 - 1)
cuts = st.lists(st.integers(0, 300), max_size=6)
long_cuts = st.lists(st.integers(0, 5000), max_size=12)


def evt3_words() -> Any:
    """Words of every kind, with addresses and times that often make sense and sometimes do not."""
    small = st.integers(0, 80)
    content = st.one_of(small, small.map(lambda x: x | 0x800), st.integers(0, 0xFFF))
    kinds = st.sampled_from([0x0, 0x2, 0x2, 0x3, 0x4, 0x4, 0x5, 0x6, 0x6, 0x8, 0xA, 0xE, 0xF, 0xF, 0x7, 0x1, 0x9, 0xB])
    plain = st.tuples(kinds, content).map(lambda w: w[0] << 12 | w[1])
    wrap = st.sampled_from([0x8000, 0x8FFF, 0x8800, 0x87FF, 0x9999, 0xE014, 0xE016])
    one = st.one_of(plain, wrap, st.integers(0, 0xFFFF)).map(lambda word: [word])
    counts = st.tuples(st.sampled_from([0xE014, 0xE016]), content, content, content).map(
        lambda c: [c[0], 0xF000 | c[1], 0xF000 | c[2], 0x7000 | c[3]]
    )
    phrases = st.one_of(one, one, one, counts, counts.map(lambda words: words[:-1]))
    words = st.lists(phrases, max_size=150).map(lambda parts: [word for part in parts for word in part])
    return st.one_of(words, words.map(lambda rest: [0x8001, 0x0005, *rest]))


def evt3_stream(seed: int, size: int, width: int, height: int) -> NDArray[np.uint16]:
    """Words as cameras send them, mostly: rows of events, vectors whole and not, time that goes on, rate counters.

    The mix is drawn too, from nothing but single events to nothing but vectors, and so is how much of it is junk.
    """
    rng = np.random.default_rng(seed)
    columns, lines = width + max(1, width // 8), height + max(1, height // 8)
    junk = rng.choice([0.0, 0.0, 0.01, 0.2])
    weights = rng.random(7) ** 3 + 1e-6
    weights /= weights.sum()
    words: list[int] = [0x8001, 0x0000]
    high, low = 1, 0

    def some(limit: int) -> int:
        return int(rng.integers(0, max(limit, 1)))

    while len(words) < size:
        kind = int(rng.choice(7, p=weights))
        if rng.random() < junk:
            words.append(some(65536))
        elif kind == 0:
            words.append(min(some(lines), 4095))
        elif kind == 1:
            words += [0x2000 | some(2) << 11 | min(some(columns), 2047) for _ in range(1 + some(30))]
        elif kind == 2:
            whole = [0x3000 | some(2) << 11 | min(some(columns), 2047), 0x4000 | some(4096), 0x4000 | some(4096),
                     0x5000 | some(256)]  # fmt: skip
            words += whole if rng.random() < 0.7 else whole[some(4) : 1 + some(4)]
        elif kind == 3:
            low = low + some(30) if rng.random() < 0.95 else low - 11
            high, low = (high + 1 + (rng.random() < 0.02) * some(5000), 0) if low > 4095 else (high, max(low, 0))
            words += [0x8000 | high & 0xFFF] * some(3) + [0x6000 | low]
        elif kind == 4:
            words.append(0x8000 | high & 0xFFF)
        elif kind == 5:
            count = [0xE014 + 2 * some(2), 0xF000 | some(4096), 0xF000 | some(4096), 0x7000 | some(16)]
            words += count if rng.random() < 0.8 else count[: 1 + some(4)]
        else:
            words.append([0xA101, 0xA000, 0x9999, 0xE123, 0xF001, 0x7001, 0x1000][some(7)])
    return np.array(words[:size], np.uint16)


def evt2_words() -> Any:
    kinds = st.sampled_from([0x0, 0x1, 0x1, 0x8, 0xA, 0xE, 0xF, 0x3])
    event = st.tuples(kinds, st.integers(0, 63), st.integers(0, 90), st.integers(0, 90)).map(
        lambda w: w[0] << 28 | w[1] << 22 | w[2] << 11 | w[3]
    )
    wrap = st.sampled_from([0x80000000, 0x8FFFFFFF, 0x80000001])
    return st.lists(st.one_of(event, wrap, st.integers(0, 2**32 - 1)), max_size=200)


def evt21_words() -> Any:
    lower = st.one_of(st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 2**31, 2**32 - 1]))
    counter = st.sampled_from([0xE0000014, 0xE0000016, 0xEFC10016])
    upper = st.one_of(evt2_words().map(lambda words: words[0] if words else 0x80000000), counter)
    return st.lists(st.tuples(upper, lower).map(lambda w: w[0] << 32 | w[1]), max_size=60)


def pieces(words: Any, cuts: list[int]) -> list[NDArray[Any]]:
    """Cut an array at any places."""
    return np.split(words, sorted(cut % (len(words) + 1) for cut in cuts))


def opened(path: Path) -> Any:
    """Open a recording for a ``with`` block."""
    return closing(open_recording(path))


def read_columns(path: Path, max_bytes: int = 1 << 20) -> list[NDArray[Any]]:
    """Read a recording through; return t, x, y, p."""
    with opened(path) as reader:
        chunks = [[column.copy() for column in chunk[:4]] for chunk in EventStream(reader).chunks(max_bytes)]
    return [np.concatenate(column) for column in zip(*chunks, strict=True)]
