"""EVT3 words straight to first ON times: every kernel against decoding and latching in slow steps, however cut."""

from collections.abc import Callable
from typing import Any

import naive
import naive_map
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shared import RECORDINGS, needs_shared
from streams import evt3_stream, evt3_words, long_cuts, needs_lanes, opened, pieces, seeds

from elpd.events.registers import new_state, new_triggers
from elpd.events.stream import PacketDecoder
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs
from elpd.vision.first_events import FirstEventMap
from elpd.vision.latch import EMPTY, MAX_INTERVAL_US, SLOTS, Latch, new_latch
from elpd.vision.latch_lanes import latch_kernel, scratch
from elpd.vision.latch_words import evt3_to_latch

KERNELS = [
    pytest.param(lambda: evt3_to_latch, id="word_by_word"),
    pytest.param(latch_kernel, id="by_blocks", marks=needs_lanes),
]
EVERYTHING = 1 << 20
SIDES = st.sampled_from([7, 31, 32, 33, 64, 70, 2048])


def latched(
    kernel: Any, words: NDArray[np.uint16], at: list[int], interval: tuple[int, int], size: tuple[int, int]
) -> Latch:
    latch, state, memory = new_latch(*size), new_state(), scratch()
    for piece in pieces(words, at):
        kernel(piece, 0, state, new_triggers(), *interval, *size, *latch, *memory)
    return latch


def check(
    kernel: Any, words: NDArray[np.uint16], at: list[int], part: tuple[float, float], size: tuple[int, int]
) -> None:
    """Compare with decoding all words slowly, then latching what they hold."""
    items, _, _ = naive.decode_evt3(words, EVERYTHING, EVERYTHING)
    events = [item[1:] for item in items if item[0] == "event"]
    times = sorted({event[0] for event in events} | {4100})
    begin_us = times[int(part[0] * (len(times) - 1))]
    end_us = times[int(part[1] * (len(times) - 1))]
    interval = (begin_us, min(max(begin_us + 1, end_us), begin_us + MAX_INTERVAL_US))
    t, x, y, on = np.array(events, np.int64).reshape(-1, 4).T
    width, height = size
    slow = naive_map.latch_first_on(t, x, y, on, *interval, width, height)
    fast = latched(kernel, words, at, interval, size)
    np.testing.assert_array_equal(fast.slots.reshape(SLOTS, height, -1)[:, :, :width], slow[0])
    np.testing.assert_array_equal(fast.before.reshape(height, -1)[:, :width], slow[1])
    assert fast.tally[:3].tolist() == slow[2][:3]
    if not any(item[0] == "outside" for item in items):  # a row that no word has said is outside, too
        assert fast.tally[3] == slow[2][3]
    assert (fast.slots.reshape(SLOTS, height, -1)[:, :, width:] == EMPTY).all()


PART = st.tuples(st.floats(0, 1), st.floats(0, 1))


@pytest.mark.parametrize("kernel", KERNELS)
def test_any_words_equal_their_slow_twin_however_cut(kernel: Callable[[], Any]) -> None:
    @settings(max_examples=200)
    @given(evt3_words(), long_cuts, PART, SIDES, st.integers(1, 70))
    def agree(words: Any, at: list[int], part: tuple[float, float], width: int, height: int) -> None:
        check(kernel(), np.array(words, np.uint16), at, part, (width, height))

    agree()


@pytest.mark.parametrize("kernel", KERNELS)
def test_streams_as_cameras_send_them_equal_their_slow_twin(kernel: Callable[[], Any]) -> None:
    @settings(max_examples=60)
    @given(seeds, st.integers(40, 1500), long_cuts, PART, SIDES)
    def agree(seed: int, size: int, at: list[int], part: tuple[float, float], width: int) -> None:
        check(kernel(), evt3_stream(seed, size, width, 40), at, part, (width, 40))

    agree()


def vectors(seed: int, bits: float, rows: int, width: int) -> NDArray[np.uint16]:
    """Rows of ON vectors over the whole width, again and again, and single events between them."""
    rng = np.random.default_rng(seed)
    words = [0x8001]
    for k in range(rows):
        words += [0x6000 | 3 * k & 0xFFF, k % 5]
        for first in range(0, width + 32, 32):
            mask = int(np.packbits(rng.random(32) < bits, bitorder="little").view("<u4")[0])
            shift = int(rng.integers(0, 32)) * (rng.random() < 0.2)
            words += [0x3000 | (rng.random() < 0.9) << 11 | first + shift, 0x4000 | mask & 0xFFF]
            words += [0x4000 | mask >> 12 & 0xFFF, 0x5000 | mask >> 24]
            if rng.random() < 0.3:
                words.append(0x2800 | int(rng.integers(0, width)))
    return np.array(words, np.uint16)


@pytest.mark.parametrize("kernel", KERNELS)
def test_full_vectors_over_the_same_pixels_equal_their_slow_twin(kernel: Callable[[], Any]) -> None:
    @settings(max_examples=40)
    @given(seeds, st.floats(0.2, 1.0), st.integers(20, 60), long_cuts, PART, st.sampled_from([64, 70, 160]))
    def agree(seed: int, bits: float, rows: int, at: list[int], part: tuple[float, float], width: int) -> None:
        check(kernel(), vectors(seed, bits, rows, width), at, part, (width, 4))

    agree()


def test_pixels_that_have_all_their_times_are_known_to_be_full() -> None:
    words = vectors(1, 1.0, 200, 320)
    latch = latched(latch_kernel(), words, [], (0, 1 << 24), (320, 4))
    has_all = (latch.slots.reshape(SLOTS, -1) != EMPTY).all(axis=0).reshape(-1, 32)
    known = (latch.full[:, None] >> np.arange(32, dtype=np.uint32) & 1).astype(bool)
    assert not (known & ~has_all).any()
    assert has_all.mean() > 0.99


@needs_shared
@pytest.mark.parametrize("given_interval", [False, True])
def test_a_real_opening_gives_the_map_that_its_decoded_events_give(given_interval: bool) -> None:  # noqa: FBT001
    geometry = Geometry(1280, 720)
    with opened(RECORDINGS / "evk4_aperture_opening.raw") as reader:
        words = np.concatenate([packet.data for packet in reader.packets()])
    decoder = PacketDecoder(geometry)
    whole = decoder.feed(CameraPacket(words, Encoding.EVT3, HostNs(0)))
    times = whole.t
    interval = (int(times[times.size // 9]), int(times[times.size // 2])) if given_interval else (None, None)
    apart, fused = FirstEventMap(geometry, *interval), FirstEventMap(geometry, *interval)
    apart.add(*whole)
    for piece in np.array_split(words, 23):
        fused.add_packet(CameraPacket(piece, Encoding.EVT3, HostNs(0)))
    assert (fused.begin_us, fused.first_us, fused.n_on, fused.n_before, fused.complete) == (
        apart.begin_us, apart.first_us, apart.n_on, apart.n_before, apart.complete
    )  # fmt: skip
    one, other = apart.believed(), fused.believed()
    np.testing.assert_array_equal(one.times_us, other.times_us)
    np.testing.assert_array_equal(one.hot, other.hot)


def test_events_as_columns_and_as_words_share_one_map() -> None:
    geometry = Geometry(64, 4)
    words = vectors(3, 0.6, 90, 64)
    first, rest = words[:400], words[400:]
    decoder = PacketDecoder(geometry)
    mixed, fused = FirstEventMap(geometry, 0), FirstEventMap(geometry, 0)
    for k, piece in enumerate((first, rest)):
        packet = CameraPacket(piece, Encoding.EVT3, HostNs(0))
        fused.add_packet(packet)
        events = decoder.feed(packet)
        if k == 0:
            mixed.add_packet(packet)
        else:
            mixed.add(*events)
    np.testing.assert_array_equal(mixed.raw_times_us(), fused.raw_times_us())
    assert mixed.n_on == fused.n_on


def test_without_a_beginning_the_interval_begins_at_the_first_event_inside_the_sensor() -> None:
    words = np.array([0x8001, 0x6005, 0x0009, 0x2803, 0x6007, 0x0001, 0x2003, 0x6009, 0x2803], np.uint16)
    gathered = FirstEventMap(Geometry(8, 4))
    for word in words:
        gathered.add_packet(CameraPacket(np.array([word], np.uint16), Encoding.EVT3, HostNs(0)))
    assert (gathered.begin_us, gathered.last_us, gathered.n_on) == (0x1007, 0x1009, 1)
    assert gathered.raw_times_us()[1, 3] == 2
