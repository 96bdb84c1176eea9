"""First ON times: kernels against their slow twins, any split of the stream, noise told from light."""

from __future__ import annotations

import itertools

import naive_map
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from openings import natural_scene, record

from elpd.errors import UsageError
from elpd.events.evt3_encode import Evt3Encoder
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs
from elpd.vision.first_events import FirstEventMap
from elpd.vision.first_times import HOT, UNFIRED, believe, relative_jitter
from elpd.vision.latch import EMPTY, SLOTS, latch_first_on, new_latch, stride

WIDTH, HEIGHT = 7, 5
EVENTS = st.lists(
    st.tuples(st.integers(0, 60), st.integers(0, WIDTH), st.integers(0, HEIGHT), st.sampled_from([0, 1, 1, 255])),
    max_size=120,
)


def columns(events: list[tuple[int, int, int, int]]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    table = np.array(events, np.int64).reshape(-1, 4)
    return (
        table[:, 0].copy(),
        table[:, 1].astype(np.uint16),
        table[:, 2].astype(np.uint16),
        table[:, 3].astype(np.uint8),
    )


@given(EVENTS, st.integers(0, 40), st.integers(1, 40))
def test_latching_equals_its_slow_twin(events: list[tuple[int, int, int, int]], begin_us: int, length_us: int) -> None:
    t, x, y, on = columns(events)
    latch = new_latch(WIDTH, HEIGHT)
    latch_first_on(
        t, x, y, on, t.size, begin_us, begin_us + length_us, WIDTH, HEIGHT, *latch, np.empty((2, 7), np.int64)
    )
    slow_slots, slow_before, slow_tally = naive_map.latch_first_on(
        t, x, y, on, begin_us, begin_us + length_us, WIDTH, HEIGHT
    )
    slots, before = latch.slots.reshape(SLOTS, HEIGHT, -1), latch.before.reshape(HEIGHT, -1)
    assert slots.shape[2] == stride(WIDTH)
    np.testing.assert_array_equal(slots[:, :, :WIDTH], slow_slots)
    np.testing.assert_array_equal(before[:, :WIDTH], slow_before)
    assert latch.tally.tolist() == slow_tally


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0), st.floats(0.002, 0.3))
@settings(max_examples=60)
def test_believing_equals_its_slow_twin(seed: int, fired: float, jitter: float) -> None:
    random = np.random.default_rng(seed)
    slots = np.sort(random.integers(0, 40, (SLOTS, 6, 7)) ** 3, axis=0).astype(np.int32)
    slots[random.random(slots.shape) > fired] = EMPTY
    slots.sort(axis=0)
    choice = np.where(slots[0] == EMPTY, UNFIRED, np.uint8(0)).astype(np.uint8)
    choice[random.random(choice.shape) < 0.05] = HOT
    times = np.where(choice == 0, slots[0], EMPTY).astype(np.int32)
    for _ in range(3):
        new_times, new_choice = np.empty_like(times), np.empty_like(choice)
        moved = believe(times, choice, new_times, new_choice, slots, jitter)
        slow_times, slow_choice, slow_moved = naive_map.believe(times, choice, slots, jitter)
        np.testing.assert_array_equal(new_times, slow_times)
        np.testing.assert_array_equal(new_choice, slow_choice)
        assert moved == slow_moved
        times, choice = new_times, new_choice


@given(st.lists(st.integers(0, 400), max_size=6), st.booleans())
@settings(max_examples=30)
def test_any_split_of_the_stream_gives_the_same_map(cuts: list[int], given_interval: bool) -> None:  # noqa: FBT001
    opening = record(natural_scene(3, 12, 16), mismatch=0.05, noise_hz=20, lead_us=2000, seed=3)
    interval = (opening.open_us, opening.open_us + 15_000) if given_interval else (None, None)
    whole = FirstEventMap(Geometry(16, 12), *interval)
    whole.add(opening.t_us, opening.x, opening.y, opening.on)
    split = FirstEventMap(Geometry(16, 12), *interval)
    edges = [0, *sorted(cuts), opening.t_us.size]
    for first, last in itertools.pairwise(edges):
        piece = slice(first, last)
        split.add(opening.t_us[piece], opening.x[piece], opening.y[piece], opening.on[piece])
    assert (split.begin_us, split.n_on, split.n_before) == (whole.begin_us, whole.n_on, whole.n_before)
    one, other = whole.believed(), split.believed()
    np.testing.assert_array_equal(one.times_us, other.times_us)
    np.testing.assert_array_equal(one.hot, other.hot)


def test_words_and_structured_arrays_give_the_same_map_as_columns() -> None:
    opening = record(natural_scene(4, 24, 32), mismatch=0.05, noise_hz=5, seed=4)
    geometry = Geometry(32, 24)
    plain = FirstEventMap(geometry)
    plain.add(opening.t_us, opening.x, opening.y, opening.on)
    array = np.empty(opening.t_us.size, [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    for name, column in zip("txyp", (opening.t_us, opening.x, opening.y, opening.on), strict=True):
        array[name] = column
    words = Evt3Encoder(32).encode(opening.t_us, opening.x, opening.y, opening.on)
    for data, encoding in ((array, Encoding.ARRAY), (words, Encoding.EVT3)):
        packed = FirstEventMap(geometry)
        for piece in np.array_split(data, 7):
            packed.add_packet(CameraPacket(piece, encoding, HostNs(0)))
        np.testing.assert_array_equal(packed.raw_times_us(), plain.raw_times_us())


def test_noise_before_the_light_is_not_believed() -> None:
    opening = record(natural_scene(1), mismatch=0.05, noise_hz=4, lead_us=50_000, seed=1)
    clean = record(natural_scene(1), mismatch=0.05, lead_us=50_000, seed=1)
    noisy, quiet = FirstEventMap(Geometry(160, 120), 5_000_000), FirstEventMap(Geometry(160, 120), 5_000_000)
    noisy.add(opening.t_us, opening.x, opening.y, opening.on)
    quiet.add(clean.t_us, clean.x, clean.y, clean.on)
    truth = quiet.raw_times_us()
    corrupted = noisy.raw_times_us() < truth - 2000
    assert corrupted.mean() > 0.08
    first = noisy.believed()
    wrong = (first.times_us != EMPTY) & (first.times_us < truth - 2000)
    assert wrong.sum() < 0.05 * corrupted.sum()
    assert first.hot.mean() < 0.01


def test_noise_before_a_known_opening_is_counted_and_marks_hot_pixels() -> None:
    hot = [(10, 10), (50, 80), (0, 0), (51, 81)]
    opening = record(natural_scene(1), mismatch=0.05, noise_hz=5, hot=hot, lead_us=20_000, seed=2)
    gathered = FirstEventMap(Geometry(160, 120), opening.open_us)
    gathered.add(opening.t_us, opening.x, opening.y, opening.on)
    assert gathered.n_before == int((opening.on[opening.t_us < opening.open_us] == 1).sum())
    first = gathered.believed()
    assert all(first.hot[pixel] for pixel in hot)
    assert first.hot.sum() < len(hot) + 20


def test_jitter_is_that_of_the_sensor_whatever_the_texture() -> None:
    random = np.random.default_rng(5)
    slope = np.exp(np.linspace(8, 10, 200))[None, :] * np.ones((150, 1))
    times = (slope * np.exp(random.normal(0, 0.04, slope.shape))).astype(np.int32)
    assert relative_jitter(times) == pytest.approx(0.04, rel=0.1)


def test_an_event_stamp_before_the_newest_one_is_taken_as_it_comes() -> None:
    gathered = FirstEventMap(Geometry(4, 4), 100, 200)
    gathered.add(
        np.array([150, 139, 99, 205], np.int64),
        np.array([1, 2, 3, 3], np.uint16),
        np.zeros(4, np.uint16),
        np.ones(4, np.uint8),
    )
    assert gathered.raw_times_us()[0].tolist() == [EMPTY, 50, 39, EMPTY]
    assert (gathered.n_on, gathered.n_before, gathered.complete) == (2, 1, True)


def test_read_only_and_empty_packets_are_fine() -> None:
    gathered = FirstEventMap(Geometry(4, 4))
    empty = np.empty(0, np.int64)
    gathered.add(empty, empty, empty, empty)
    assert gathered.begin_us is None
    arrays = [np.array([5], kind) for kind in (np.int64, np.uint16, np.uint16)] + [np.array([1], np.uint8)]
    for array in arrays:
        array.flags.writeable = False
    gathered.add(*arrays)
    assert gathered.n_outside == 1


@pytest.mark.parametrize(("begin_us", "end_us"), [(5, 5), (5, 4), (0, 2**31)])
def test_an_interval_that_cannot_be_mapped_is_refused(begin_us: int, end_us: int) -> None:
    with pytest.raises(UsageError, match="aperture opening of"):
        FirstEventMap(Geometry(4, 4), begin_us, end_us)


def test_without_any_on_event_there_is_no_map() -> None:
    with pytest.raises(UsageError, match="no ON event came"):
        FirstEventMap(Geometry(4, 4), 0, 10).believed()
