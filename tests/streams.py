"""Word streams to test with: every kind of word, sense and nonsense, and places to cut them."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from elpd.events.stream import EventStream, open_recording

sizes = st.integers(1, 70)
cuts = st.lists(st.integers(0, 300), max_size=6)


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
