"""Word decoders against their slow twins, for any words and any cut."""

from typing import Any

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import cuts, evt2_words, evt3_stream, evt3_words, evt21_words, long_cuts, needs_lanes, pieces, seeds, sizes

from elpd.errors import UsageError
from elpd.events import evt2, evt3
from elpd.events.evt2 import Evt2Decoder, Evt21Decoder, swap_halves
from elpd.events.evt3 import Evt3Decoder
from elpd.events.evt3_fast import Evt3BlockDecoder
from elpd.events.registers import new_state, new_triggers
from elpd.events.simd import available
from elpd.records import Geometry, Trigger

CODECS = {
    "evt3": (Evt3Decoder, naive.decode_evt3, np.uint16),
    "evt3 by blocks": (Evt3BlockDecoder, naive.decode_evt3, np.uint16),
    "evt2": (Evt2Decoder, naive.decode_evt2, np.uint32),
    "evt21": (Evt21Decoder, naive.decode_evt21, np.uint64),
}


if not available():
    del CODECS["evt3 by blocks"]


def feed_all(decoder: Any, words: Any, cuts: list[int]) -> Any:
    columns, triggers = [], []
    for piece in pieces(words, cuts):
        columns.append([column.copy() for column in decoder.feed(piece)])
        triggers += decoder.triggers
    return [np.concatenate(column) for column in zip(*columns, strict=True)], triggers


def assert_equals_twin(codec: str, words: Any, width: int, height: int, cuts: list[int]) -> None:
    decoder_type, twin, dtype = CODECS[codec]
    decoder = decoder_type(Geometry(width, height))
    words = np.array(words, dtype)
    (t, x, y, p), triggers = feed_all(decoder, words, cuts)
    items, odd, rate = twin(words, width, height)
    events = [item[1:] for item in items if item[0] == "event"]
    assert list(zip(t.tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True)) == events
    assert triggers == [Trigger(item[1], item[2], bool(item[3])) for item in items if item[0] == "trigger"]
    assert {name: count for name, count in decoder.counters.items() if count} == {k: v for k, v in odd.items() if v}
    assert (decoder.rate_controller or (0, 0)) == rate


@settings(max_examples=300)
@given(evt3_words(), sizes, sizes, cuts)
def test_evt3_equals_its_twin_for_any_words_and_cuts(words: Any, width: int, height: int, cuts: list[int]) -> None:
    assert_equals_twin("evt3", words, width, height, cuts)


@needs_lanes
@settings(max_examples=300)
@given(words=evt3_words(), seed=seeds, width=sizes, height=sizes, cuts=cuts)
def test_evt3_by_blocks_equals_the_twin(words: Any, seed: int, width: int, height: int, cuts: list[int]) -> None:
    words = np.concatenate([np.array(words, np.uint16), evt3_stream(seed, 300, width, height)])
    assert_equals_twin("evt3 by blocks", words, width, height, cuts)


@needs_lanes
@settings(max_examples=60)
@given(seed=seeds, width=st.integers(1, 2048), height=st.integers(1, 2048), cuts=long_cuts)
def test_long_streams_decode_by_blocks_as_word_by_word(seed: int, width: int, height: int, cuts: list[int]) -> None:
    geometry = Geometry(width, height)
    words = evt3_stream(seed, 4000, width, height)
    slow, fast = Evt3Decoder(geometry), Evt3BlockDecoder(geometry)
    for one, other in zip(feed_all(slow, words, [])[0], feed_all(fast, words, cuts)[0], strict=True):
        assert (one == other).all()
    assert slow._state.tolist() == fast._state.tolist()


@settings(max_examples=300)
@given(evt2_words(), sizes, sizes, cuts)
def test_evt2_equals_its_twin_for_any_words_and_cuts(words: Any, width: int, height: int, cuts: list[int]) -> None:
    assert_equals_twin("evt2", words, width, height, cuts)


@settings(max_examples=300)
@given(evt21_words(), sizes, sizes, cuts)
def test_evt21_equals_its_twin_for_any_words_and_cuts(words: Any, width: int, height: int, cuts: list[int]) -> None:
    assert_equals_twin("evt21", words, width, height, cuts)


@pytest.mark.parametrize("codec", CODECS)
@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), cuts=cuts)
def test_random_bits_equal_the_twin(codec: str, seed: int, cuts: list[int]) -> None:
    dtype = CODECS[codec][2]
    words = np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, 600, dtype, endpoint=True)
    assert_equals_twin(codec, words, 1280, 720, cuts)


def test_evt3_wraps_every_16_seconds() -> None:
    words = [w for high in (0, 1000, 2000, 3000, 4000) * 3 for w in (0x8000 | high, 0x0001, 0x2002)]
    t = Evt3Decoder(Geometry(8, 8)).feed(np.array(words, np.uint16)).t
    assert t.tolist() == [(loop * 4096 + high) * 4096 for loop in range(3) for high in (0, 1000, 2000, 3000, 4000)]


def test_evt3_time_low_may_step_back() -> None:
    words = np.array([0x8001, 0x0001, 0x632B, 0x2001, 0x6320, 0x2002], np.uint16)
    assert Evt3Decoder(Geometry(8, 8)).feed(words).t.tolist() == [4096 + 0x32B, 4096 + 0x320]


def test_a_repeated_time_high_keeps_time_low_and_a_new_one_clears_it() -> None:
    words = np.array([0x8001, 0x0001, 0x6007, 0x8001, 0x2001, 0x8002, 0x2002], np.uint16)
    assert Evt3Decoder(Geometry(8, 8)).feed(words).t.tolist() == [4096 + 7, 8192]


def test_a_lost_vect_8_shifts_only_its_own_columns() -> None:
    words = np.array([0x8001, 0x0001, 0x3800, 0x4001, 0x4001, 0x3820, 0x4001, 0x4001, 0x5001], np.uint16)
    assert Evt3Decoder(Geometry(64, 8)).feed(words).x.tolist() == [0, 12, 32, 44, 56]


def test_after_a_loss_no_event_is_put_on_the_row_before_it() -> None:
    decoder = Evt3Decoder(Geometry(8, 8))
    decoder.feed(np.array([0x8001, 0x0001, 0x2001], np.uint16))
    decoder.forget_addresses()
    assert decoder.feed(np.array([0x2001, 0x0002, 0x2003], np.uint16)).y.tolist() == [2]
    assert decoder.counters["y_out_of_range"] == 1


def test_time_is_known_from_the_first_time_word_on() -> None:
    decoder = Evt3Decoder(Geometry(8, 8))
    assert decoder.time_us is None
    decoder.feed(np.array([0x2001, 0x8002, 0x6003], np.uint16))
    assert decoder.time_us == 2 * 4096 + 3


def test_evt2_wraps_after_2_to_the_34_us() -> None:
    words = np.array([0x8FFFFFFF, 0x10000000, 0x80000000, 0x10000000], np.uint32)
    assert np.diff(Evt2Decoder(Geometry(8, 8)).feed(words).t).tolist() == [64]


def test_exchanged_halves_are_put_right() -> None:
    words = np.array([0x8000000100000000, 0x1000000000000003], np.uint64)
    assert swap_halves(swap_halves(words)).tolist() == words.tolist()
    assert Evt21Decoder(Geometry(8, 8)).feed(words).x.tolist() == [0, 1]


@pytest.mark.parametrize("size", [(0, 5), (5, 2049)])
def test_a_sensor_beyond_11_bits_is_refused(size: Any) -> None:
    with pytest.raises(UsageError, match="11-bit"):
        Evt3Decoder(Geometry(*size))


@pytest.mark.parametrize(
    ("kernel", "dtype"), [(evt3.decode, "u2"), (evt2.decode_evt2, "u4"), (evt2.decode_evt21, "u8")]
)
@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), room=st.integers(0, 100))
def test_no_stream_writes_outside_its_outputs(kernel: Any, dtype: Any, seed: int, room: int) -> None:
    words = np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, 400, dtype, endpoint=True)
    padded = [np.full(room + 64, 123, kind) for kind in ("i8", "u2", "u2", "u1")]
    triggers = np.full((40, 3), 123, np.int64)
    outputs = [column[32 : 32 + room] for column in padded]
    kernel(words, 0, new_state(), 2048, 2048, *outputs, triggers[16:20])
    assert all((column[:32] == 123).all() and (column[32 + room :] == 123).all() for column in padded)
    assert (triggers[:16] == 123).all()
    assert (triggers[20:] == 123).all()


def test_more_triggers_than_there_is_room_for_are_counted() -> None:
    decoder = Evt3Decoder(Geometry(8, 8))
    room = len(new_triggers())
    decoder.feed(np.array([0x8001] + [0xA001] * (room + 3), np.uint16))
    assert len(decoder.triggers) == room
    assert decoder.counters["triggers_lost"] == 3
