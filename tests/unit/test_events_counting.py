"""Counting events in a region, without decoding them, against the slow decoders."""

from typing import Any

import naive
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import evt2_words, evt3_stream, evt3_words, evt21_words, seeds

from elpd.events.counting import EventCounter, count_evt3
from elpd.events.registers import HIGH, NO_ROW, NO_VECTOR, ROW, VECTOR_X, new_state
from elpd.records import CameraPacket, Encoding, Roi
from elpd.units import HostNs

WIDTH, HEIGHT = 70, 60
regions = st.builds(Roi, st.integers(0, 40), st.integers(0, 40), st.integers(1, 30), st.integers(1, 20))
TIME = {Encoding.EVT3: 0x8001, Encoding.EVT2: 0x8000_0001, Encoding.EVT21: 0x8000_0001 << 32}
TWINS = {
    Encoding.EVT3: (naive.decode_evt3, np.uint16),
    Encoding.EVT2: (naive.decode_evt2, np.uint32),
    Encoding.EVT21: (naive.decode_evt21, np.uint64),
}


def expected(words: Any, encoding: Encoding, roi: Roi) -> int:
    items, *_ = TWINS[encoding][0](words, 2048, 2048)
    events = [item for item in items if item[0] == "event"]
    return sum(roi.x <= x < roi.x + roi.width and roi.y <= y < roi.y + roi.height for _, _, x, y, _ in events)


def assert_counted(words: list[int], encoding: Encoding, roi: Roi) -> None:
    whole = np.array([TIME[encoding], *words], TWINS[encoding][1])
    packet = CameraPacket(whole, encoding, HostNs(0))
    counter = EventCounter(roi)
    assert [counter.count(packet) for _ in range(2)] == [expected(whole, encoding, roi)] * 2


@settings(max_examples=200)
@given(words=evt3_words(), seed=seeds, roi=regions)
def test_evt3(words: list[int], seed: int, roi: Roi) -> None:
    assert_counted([*words, *evt3_stream(seed, 200, WIDTH, HEIGHT).tolist()], Encoding.EVT3, roi)


@settings(max_examples=100)
@given(words=evt2_words(), roi=regions)
def test_evt2(words: list[int], roi: Roi) -> None:
    assert_counted(words, Encoding.EVT2, roi)


@settings(max_examples=100)
@given(words=evt21_words(), roi=regions)
def test_evt21(words: list[int], roi: Roi) -> None:
    assert_counted(words, Encoding.EVT21, roi)


@settings(max_examples=30)
@given(seed=seeds, roi=regions)
def test_word_by_word_is_as_by_blocks(seed: int, roi: Roi) -> None:
    words = evt3_stream(seed, 3000, WIDTH, HEIGHT)
    state = new_state()
    state[HIGH], state[ROW], state[VECTOR_X] = 0, NO_ROW, NO_VECTOR
    slow = count_evt3(words, 0, state, roi.x, roi.y, roi.width, roi.height)
    assert EventCounter(roi).count(CameraPacket(words, Encoding.EVT3, HostNs(0))) == slow
