"""A recording made long enough to measure: its words repeated whole, with time going on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.errors import UsageError
from elpd.events.decoder import EventArrays
from elpd.events.evt3_fast import evt3_decoder
from elpd.events.stream import open_recording
from elpd.records import Encoding, Geometry

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Words = NDArray[np.uint16]

PIECE_WORDS = 1 << 16
WINDOW_US = 1000


def payload(path: Path) -> tuple[Geometry, Words]:
    """Return the sensor's size and all EVT3 words of a file. Raises ``UsageError`` if there are none."""
    reader = open_recording(path)
    try:
        packets = [packet.data.copy() for packet in reader.packets() if packet.encoding is Encoding.EVT3]
        if not packets:
            raise UsageError(f"{path} holds no EVT3 words; the peers read nothing else")
        return reader.geometry or Geometry(1280, 720), np.concatenate(packets)
    finally:
        reader.close()


def pieces(words: Words) -> list[Words]:
    """Cut words as a camera's USB transfers would: 128 KiB each."""
    return np.split(words, range(PIECE_WORDS, words.size, PIECE_WORDS))


def tiled(words: Words, geometry: Geometry, n_words: int) -> Words:
    """Repeat the words, whole times; TIME_HIGH is rewritten so that no decoder sees a jump."""
    high = words >> 12 == 0x8
    highs = (words[high] & 0xFFF).astype(np.int64)
    decoder = evt3_decoder(geometry)
    decoder.feed(words)
    last_us = decoder.time_us
    if last_us is None:
        raise UsageError("the recording holds no time at all")
    span = (last_us >> 12) - int(highs[0]) + 1
    copies = []
    for copy in range(max(-(-n_words // words.size), 1)):
        shifted = words.copy()
        shifted[high] = 0x8000 | (highs + copy * span) & 0xFFF
        copies.append(shifted)
    return np.concatenate(copies)


def count(words: Words, geometry: Geometry) -> int:
    """Return how many events the words hold."""
    decoder = evt3_decoder(geometry)
    return sum(decoder.feed(piece).t.size for piece in pieces(words))


def events(words: Words, geometry: Geometry) -> EventArrays:
    """Return the words' events as columns of their own."""
    return EventArrays(*(column.copy() for column in evt3_decoder(geometry).feed(words)))


def beginning(words: Words, geometry: Geometry, windows: int) -> Words:
    """Return the words of the first *windows* windows that hold events."""
    decoder = evt3_decoder(geometry)
    begin_us = None
    for end in range(1024, words.size, 1024):
        t = decoder.feed(words[end - 1024 : end]).t
        begin_us = int(t[0]) if begin_us is None and t.size else begin_us
        if begin_us is not None and t.size and t[-1] >= begin_us + windows * WINDOW_US:
            return words[:end]
    return words
