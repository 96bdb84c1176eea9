"""The fused kernels against their slow twin, and the rules of windows as stories."""

from typing import Any

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from streams import cuts, evt2_words, evt3_stream, evt3_words, evt21_words, long_cuts, needs_lanes, pieces, seeds, sizes

from elpd.errors import UsageError
from elpd.events.evt3_encode import Evt3Encoder
from elpd.events.evt3_lists import LISTS
from elpd.events.registers import new_state
from elpd.records import CameraPacket, Encoding
from elpd.vision import elp_lanes, elp_words
from elpd.vision.elp import ElpWindows
from elpd.vision.elp_weights import OUT_OF_SENSOR_WEIGHT, STRIDE
from elpd.vision.elp_windows import NEVER, new_window

WORDS = {
    Encoding.EVT3: (naive.decode_evt3, np.uint16),
    Encoding.EVT2: (naive.decode_evt2, np.uint32),
    Encoding.EVT21: (naive.decode_evt21, np.uint64),
}
edge_steps = st.lists(st.integers(1, 5000), max_size=40)
DTYPES = {
    "neuromorphic-drivers, packed 13 bytes": [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")],
    "dv-processing, 16 bytes": np.dtype([("timestamp", "<i8"), ("x", "<i2"), ("y", "<i2"), ("polarity", "i1")],
                                        align=True),
    "Metavision EventCD": np.dtype({"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"],
                                    "offsets": [0, 2, 4, 8], "itemsize": 16}),
    "32-bit time": [("t", "<u4"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")],
    "minus one for OFF": [("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "<i2")],
    "narrow": [("t", "<i4"), ("x", "u1"), ("y", "u1"), ("p", "i1")],
    "big-endian": [("t", ">i8"), ("x", ">u2"), ("y", ">u2"), ("p", ">i2")],
    "wide": [("t", "<i8"), ("x", "<i4"), ("y", "<i8"), ("p", "<i4")],
}  # fmt: skip


def packet(data: Any, encoding: Encoding, until: Any = None, *, gap: bool = False) -> CameraPacket:
    return CameraPacket(data, encoding, 0, complete_until_us=until, gap_before=gap)


def feed_all(meter: Any, encoding: Encoding, data: Any, cuts: list[int]) -> Any:
    closed = [meter.feed(packet(piece, encoding)).copy() for piece in pieces(data, cuts)]
    return [row for rows in closed for row in rows.tolist()]


def world(seed: int, width: int, height: int) -> Any:
    rng = np.random.default_rng(seed)
    weights = rng.integers(-1020, 1021, (height, width))
    inside = rng.random((height, width)) < 0.7
    inside[0, 0] = True
    return weights, inside


def edges_from(begin: int, steps: list[int]) -> Any:
    return [begin, *(begin + np.cumsum(steps)).tolist()]


def assert_words_equal_twin(
    encoding: Encoding,
    words: Any,
    width: int,
    height: int,
    cuts: list[int],
    steps: list[int],
    seed: int,
    *,
    rate_cap: bool,
    kernel: Any = None,
) -> None:
    twin, dtype = WORDS[encoding]
    words = np.array(words, dtype)
    weights, inside = world(seed, width, height)
    items, odd, _ = twin(words, width, height)
    begin = min((item[1] for item in items), default=0) + seed % 3000 - 1000
    edges = edges_from(begin, steps)
    support_us = (0, 30, 700)[seed % 3] if rate_cap else 0
    meter = ElpWindows(weights, inside, rate_cap=rate_cap, support_us=support_us)
    if kernel is not None:
        meter._words[encoding] = kernel
    meter.extend_edges(edges)
    rows = feed_all(meter, encoding, words, cuts)
    expected, nowhere = naive.elp_windows(items, weights, inside, edges, rate_cap=rate_cap, support_us=support_us)
    assert rows == expected
    counted = {name: count for name, count in meter.counters.items() if count}
    odd = {name: count for name, count in odd.items() if count and not name.endswith("out_of_range")}
    assert counted == odd | {name: count for name, count in nowhere.items() if count}


@settings(max_examples=300)
@given(words=evt3_words(), width=sizes, height=sizes, cuts=cuts, steps=edge_steps, seed=seeds, rate_cap=st.booleans())
def test_evt3_windows_equal_the_twin(
    *, words: list[int], width: int, height: int, cuts: list[int], steps: list[int], seed: int, rate_cap: bool
) -> None:
    scalar = (elp_words.evt3_to_windows, elp_words.evt3_to_windows_capped)[rate_cap]
    assert_words_equal_twin(Encoding.EVT3, words, width, height, cuts, steps, seed, rate_cap=rate_cap, kernel=scalar)


@needs_lanes
@settings(max_examples=300)
@given(
    words=evt3_words(), width=sizes, height=sizes, cuts=cuts, steps=edge_steps, seed=seeds, rate_cap=st.booleans()
)  # fmt: skip
def test_evt3_windows_by_blocks_equal_the_twin(
    *, words: list[int], width: int, height: int, cuts: list[int], steps: list[int], seed: int, rate_cap: bool
) -> None:
    words = np.concatenate([np.array(words, np.uint16), evt3_stream(seed, 300, width, height)])
    assert_words_equal_twin(Encoding.EVT3, words, width, height, cuts, steps, seed, rate_cap=rate_cap)


@needs_lanes
@settings(max_examples=100)
@given(
    seed=seeds, width=st.integers(1, 2048), height=st.integers(1, 200), cuts=long_cuts, window_us=st.integers(1, 9000),
    rate_cap=st.booleans(), open_ended=st.booleans(),
)  # fmt: skip
def test_long_streams_sum_by_blocks_as_word_by_word(
    *, seed: int, width: int, height: int, cuts: list[int], window_us: int, rate_cap: bool, open_ended: bool
) -> None:
    weights = np.random.default_rng(seed).integers(-32766, 32767, (height, width))
    inside = weights % 5 != 0
    inside[0, 0] = True
    words = evt3_stream(seed, 4000, width, height)
    support_us = (0, 200)[seed % 2] if rate_cap else 0
    even_us = None if open_ended else window_us
    slow, fast = (
        ElpWindows(weights, inside, window_us=even_us, rate_cap=rate_cap, support_us=support_us) for _ in range(2)
    )
    slow._words[Encoding.EVT3] = (elp_words.evt3_to_windows, elp_words.evt3_to_windows_capped)[rate_cap]
    if open_ended:
        for meter in (slow, fast):
            meter.extend_edges([4096 + window_us * step for step in range(3)])
    assert feed_all(slow, Encoding.EVT3, words, []) == feed_all(fast, Encoding.EVT3, words, cuts)
    assert slow.counters == fast.counters
    assert slow._state.tolist() == fast._state.tolist()
    assert (slow._bucket == fast._bucket).all()


@settings(max_examples=300)
@given(words=evt2_words(), width=sizes, height=sizes, cuts=cuts, steps=edge_steps, seed=seeds, rate_cap=st.booleans())
def test_evt2_windows_equal_the_twin(
    *, words: list[int], width: int, height: int, cuts: list[int], steps: list[int], seed: int, rate_cap: bool
) -> None:
    assert_words_equal_twin(Encoding.EVT2, words, width, height, cuts, steps, seed, rate_cap=rate_cap)


@settings(max_examples=300)
@given(words=evt21_words(), width=sizes, height=sizes, cuts=cuts, steps=edge_steps, seed=seeds, rate_cap=st.booleans())
def test_evt21_windows_equal_the_twin(
    *, words: list[int], width: int, height: int, cuts: list[int], steps: list[int], seed: int, rate_cap: bool
) -> None:
    assert_words_equal_twin(Encoding.EVT21, words, width, height, cuts, steps, seed, rate_cap=rate_cap)


@pytest.mark.parametrize("dtype", DTYPES.values(), ids=DTYPES.keys())
@settings(max_examples=25)
@given(
    seed=seeds,
    n=st.integers(0, 300),
    cuts=cuts,
    steps=edge_steps,
    rate_cap=st.booleans(),
    in_order=st.booleans(),
)
def test_array_windows_equal_the_twin_in_every_layout(
    dtype: Any, seed: int, n: int, cuts: list[int], steps: list[int], *, rate_cap: bool, in_order: bool
) -> None:
    rng = np.random.default_rng(seed)
    t = rng.integers(0, 20000, n)
    if in_order:
        t.sort()
    x, y = rng.integers(0, 60, n), rng.integers(0, 50, n)
    on = rng.integers(0, 2, n)
    events = np.zeros(n, dtype)
    names = events.dtype.names
    t_name = next(name for name in names if name.startswith("t"))
    p_name = next(name for name in names if name in ("on", "p", "polarity"))
    events[t_name], events["x"], events["y"] = t, x, y
    signed = events.dtype[p_name].kind == "i" and seed % 2
    events[p_name] = np.where(on == 1, 1, -1 if signed else 0)
    events.flags.writeable = bool(seed % 3)
    weights, inside = world(seed, 48, 40)
    edges = edges_from(seed % 5000, steps)
    meter = ElpWindows(weights, inside, rate_cap=rate_cap)
    meter.extend_edges(edges)
    rows = feed_all(meter, Encoding.ARRAY, events, cuts)
    items = naive.decode_arrays(t, x, y, on, 48, 40)
    expected, nowhere = naive.elp_windows(items, weights, inside, edges, rate_cap=rate_cap)
    assert rows == expected
    counted = meter.counters
    assert all(counted[name] == nowhere[name] for name in ("late", "early", "outside", "out_of_sensor"))


def simple(**options: Any) -> ElpWindows:
    return ElpWindows(np.full((8, 8), 3), **options)


def events(*rows: Any) -> NDArray[Any]:
    return np.array([(*row, 1) for row in rows], [("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1")])


def test_elp_is_minus_the_sum_of_polarity_times_weight() -> None:
    meter = ElpWindows(np.array([[5, -7]]))
    meter.extend_edges([0, 10])
    data = np.array([(1, 0, 0, 1), (2, 1, 0, 1), (3, 0, 0, 0), (3, 0, 0, 0)],
                    [("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1")])  # fmt: skip
    rows = meter.feed(packet(data, Encoding.ARRAY, until=10))
    assert rows.tolist() == [(0, 10, -5 + 7 + 5 + 5, 25 + 49 + 25 + 25, 2, 2, 0)]


def test_windows_are_half_open() -> None:
    meter = simple(window_us=10, origin_us=0)
    rows = meter.feed(packet(events((0, 1, 1), (9, 1, 1), (10, 1, 1)), Encoding.ARRAY, until=20))
    assert rows["n_on"].tolist() == [2, 1]


def test_a_promise_closes_empty_windows_and_no_promise_keeps_them_open() -> None:
    meter = simple(window_us=10, origin_us=0)
    assert len(meter.feed(packet(events((3, 1, 1)), Encoding.ARRAY))) == 0
    rows = meter.feed(packet(events(), Encoding.ARRAY, until=40))
    assert rows["n_on"].tolist() == [1, 0, 0, 0]
    assert rows["end_us"].tolist() == [10, 20, 30, 40]


def test_a_late_event_goes_to_the_open_window_and_is_counted() -> None:
    meter = simple(window_us=10, origin_us=0)
    rows = meter.feed(packet(events((3, 1, 1), (12, 1, 1), (8, 1, 1), (13, 1, 1)), Encoding.ARRAY, until=20))
    assert rows["n_on"].tolist() == [1, 3]
    assert meter.counters["late"] == 1


def test_a_ninth_event_within_5_ms_is_refused_and_a_later_one_is_not() -> None:
    meter = simple(window_us=100_000, origin_us=0, rate_cap=True)
    burst = events(*[(100, 1, 1)] * 9, (724, 1, 1), (725, 1, 1), (725, 2, 2))
    row = meter.feed(packet(burst, Encoding.ARRAY, until=100_000))[0]
    assert (row["n_on"], row["n_capped"]) == (10, 2)


def test_uneven_edges_may_be_appended_ahead_of_time() -> None:
    meter = simple()
    meter.extend_edges([0, 10])
    assert meter.feed(packet(events((12, 1, 1)), Encoding.ARRAY))["n_on"].tolist() == [0]
    meter.extend_edges([15, 40])
    assert meter.feed(packet(events((50, 1, 1)), Encoding.ARRAY)).tolist() == [
        (10, 15, -3, 9, 1, 0, 0), (15, 40, 0, 0, 0, 0, 0)]  # fmt: skip


def test_edges_that_time_has_passed_are_refused() -> None:
    meter = simple()
    meter.extend_edges([0, 10])
    meter.feed(packet(events((12, 1, 1)), Encoding.ARRAY))
    with pytest.raises(UsageError, match="too late"):
        meter.extend_edges([11])
    with pytest.raises(UsageError, match="ascend"):
        meter.extend_edges([10])


def test_a_jump_in_time_gives_one_long_window() -> None:
    meter = simple(window_us=10, origin_us=0)
    rows = meter.feed(packet(events((5, 1, 1), (10**12 + 3, 1, 1), (10**12 + 13, 1, 1)), Encoding.ARRAY)).copy()
    assert len(rows) < 300
    assert rows["n_on"].sum() == 2
    assert (rows["begin_us"][1:] == rows["end_us"][:-1]).all()
    assert rows["end_us"][-1] == 10**12 + 10


def test_more_windows_than_rows_are_all_handed_out() -> None:
    meter = simple(window_us=1, origin_us=0)
    rows = meter.feed(packet(events((3999, 1, 1)), Encoding.ARRAY, until=4000))
    assert rows["begin_us"].tolist() == list(range(4000))


def test_a_gap_forgets_the_row() -> None:
    meter = simple(window_us=4096, origin_us=0)
    meter.feed(packet(np.array([0x8000, 0x0001, 0x2001], np.uint16), Encoding.EVT3))
    rows = meter.feed(packet(np.array([0x2001, 0x0001, 0x2002], np.uint16), Encoding.EVT3, until=4096, gap=True))
    assert rows["n_on"].tolist() + rows["n_off"].tolist() == [0, 2]


def test_triggers_and_rate_counters_are_seen_on_the_way() -> None:
    meter = simple(window_us=10)
    words = np.array(
        [0x8001, 0x6005, 0xA301, 0xE014, 0xF007, 0xF001, 0x7000, 0xE016, 0xF002, 0xF000, 0x7000], np.uint16
    )
    meter.feed(packet(words, Encoding.EVT3))
    assert [(edge.t_us, edge.id, edge.rising) for edge in meter.take_triggers()] == [(4101, 3, True)]
    assert meter.take_triggers() == ()
    assert meter.rate_controller == (4096 + 7, 2)


def test_words_and_arrays_of_the_same_events_give_the_same_windows() -> None:
    rng = np.random.default_rng(7)
    t = np.sort(rng.integers(0, 50_000, 5000))
    x, y, p = rng.integers(0, 64, 5000), rng.integers(0, 48, 5000), rng.integers(0, 2, 5000)
    weights = rng.integers(-500, 500, (48, 64))
    data = np.zeros(5000, [("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1")])
    data["t"], data["x"], data["y"], data["p"] = t, x, y, p
    words = Evt3Encoder(64).encode(t, x, y, p)
    by_words, by_array = (ElpWindows(weights, window_us=500, origin_us=0) for _ in range(2))
    assert (
        by_words.feed(packet(words, Encoding.EVT3, until=50_000)).tolist()
        == by_array.feed(packet(data, Encoding.ARRAY, until=50_000)).tolist()
    )


def guarded(size: int, dtype: Any) -> tuple[Any, Any]:
    """An array, and the larger one of a known value that it lies in."""
    around = np.full(size + 128, 77, dtype)
    return around[64 : 64 + size], around


@pytest.mark.parametrize("capped", [False, True])
@pytest.mark.parametrize("scalar", [False, True])
@settings(max_examples=40)
@given(seed=seeds, n_rows=st.integers(0, 6), n_edges=st.integers(2, 6), height=st.integers(0, 3))
def test_no_stream_touches_anything_but_its_own(
    *, seed: int, n_rows: int, n_edges: int, height: int, scalar: bool, capped: bool
) -> None:
    rng = np.random.default_rng(seed)
    words = rng.integers(0, 0xFFFF, 3000, np.uint16, endpoint=True)
    if seed % 2:  # as many events as words can hold
        words[rng.random(3000) < 0.97] = 0x4FFF
    sizes = {
        "rows": 7 * n_rows,
        "edges": n_edges,
        "window": 18,
        "state": 24,
        "triggers": 3,
        "ledger": elp_words.PENDING,
    }
    arrays = {name: guarded(size, np.int64) for name, size in sizes.items()}
    table, around_table = guarded((height + 1) * STRIDE, np.int16)
    table[:] = OUT_OF_SENSOR_WEIGHT
    around_table[:64] = around_table[-64:] = 30000  # a weight: read, it would show
    bucket, around_bucket = guarded(table.size, np.int64)
    lists, around_lists = guarded(LISTS, np.uint32)
    window, state, edges = (arrays[name][0] for name in ("window", "state", "edges"))
    window[:], state[:] = new_window(), new_state()
    edges[:] = np.arange(n_edges) * 1_000_000
    window[6], window[15] = n_edges, 1
    kernels = (elp_words.evt3_to_windows, elp_words.evt3_to_windows_capped) if scalar else elp_lanes.kernels()
    kernels[capped](
        words, 0, state, arrays["triggers"][0].reshape(1, 3), table, window, edges, arrays["rows"][0].reshape(-1, 7),
        NEVER, bucket, lists, arrays["ledger"][0],
    )  # fmt: skip
    assert window[0] == window[1] == 0
    for _, around in (*arrays.values(), (bucket, around_bucket), (lists, around_lists)):
        assert (around[:64] == 77).all()
        assert (around[-64:] == 77).all()
    assert (bucket == 77).all()


@pytest.mark.parametrize(
    ("weights", "inside", "message"),
    [
        (np.zeros((4, 4)), None, "integers"),
        (np.zeros((4, 3000), np.int64), None, "at most"),
        (np.zeros((4, 4), np.int64), np.zeros((4, 4), bool), "0 pixels"),
        (np.zeros((4, 4), np.int64), np.ones((5, 4), bool), "does not fit"),
        (np.full((4, 4), 40000), None, "exceeds"),
    ],
)
def test_weights_that_make_no_sense_are_refused(weights: Any, inside: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ElpWindows(weights, inside)


@pytest.mark.parametrize(
    "dtype",
    [[("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "u1")], [("t", "i8"), ("x", "u2"), ("y", "u2")], np.dtype("u2")],
)
def test_arrays_that_are_not_events_are_refused(dtype: Any) -> None:
    with pytest.raises(UsageError, match="event"):
        simple(window_us=10).feed(packet(np.zeros(3, dtype), Encoding.ARRAY))
