"""Windows: exact sums for any cut, ends by time, travel and events, and nothing decided by a recording's end."""

from dataclasses import replace
from typing import Any

import naive_vision
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.errors import UsageError
from elpd.records import Roi
from elpd.vision.filters import PixelCap
from elpd.vision.meter import Meter, WindowsByEvents, WindowsByTime, WindowsByTravel, sum_windows
from elpd.vision.reference import reference_from_frame
from elpd.vision.ruler import Ruler

ROI = Roi(1, 1, 4, 3)
WEIGHTS = np.random.default_rng(1).integers(-2000, 2000, (6, 7)).astype(np.int16)


def reference() -> Any:
    return replace(reference_from_frame(np.zeros(WEIGHTS.shape, np.uint8), ROI), weights=WEIGHTS)


@st.composite
def events(draw: Any, longest: Any = 150) -> Any:
    count = draw(st.integers(0, longest))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    t = np.sort(rng.integers(0, 4000, count)).astype(np.int64)
    x, y = rng.integers(0, 7, count).astype(np.uint16), rng.integers(0, 6, count).astype(np.uint16)
    return t, x, y, rng.integers(0, 2, count).astype(np.uint8)


@given(events(), st.lists(st.integers(0, 4500), min_size=2, max_size=9, unique=True))
def test_sums_are_their_twin(columns: Any, edges: Any) -> None:
    edges_us = np.array(sorted(edges), np.int64)
    sums = np.zeros((edges_us.size - 1, 4), np.int64)
    sum_windows(*columns, WEIGHTS, 1, 1, 5, 4, edges_us, sums)
    lists = [column.tolist() for column in columns]
    assert sums.tolist() == naive_vision.sum_windows(*lists, WEIGHTS, (1, 1, 5, 4), edges_us.tolist())


@pytest.mark.parametrize(
    "windows", [WindowsByTime(250), WindowsByEvents(9), WindowsByTravel(Ruler.of_speed(1000), 0.4)]
)
@given(columns=events(), cuts=st.lists(st.integers(0, 150), max_size=5))
def test_samples_do_not_depend_on_the_cut(windows: Any, columns: Any, cuts: Any) -> None:
    def samples(places: Any) -> Any:
        meter = Meter(ROI, windows, 0)
        meter.set_reference(reference())
        found = []
        for begin, end in zip([0, *places], [*places, columns[0].size], strict=True):
            found += meter.feed(*(column[begin:end] for column in columns))
        return found

    # Events of one stamp that arrive in two pieces belong to one window by events only if they arrive together.
    places = sorted(
        {int(np.searchsorted(columns[0], columns[0][min(cut, columns[0].size - 1)])) for cut in cuts}
        if columns[0].size
        else set()
    )
    assert [(one.begin_us, one.end_us, one.elp, one.energy) for one in samples(places)] == [
        (one.begin_us, one.end_us, one.elp, one.energy) for one in samples([])
    ]


def test_a_window_is_closed_by_what_comes_after_it_not_by_the_end() -> None:
    meter = Meter(ROI, WindowsByTime(1000), 0)
    meter.set_reference(reference())
    one = (np.array([500], np.int64), np.array([2], np.uint16), np.array([2], np.uint16), np.array([1], np.uint8))
    assert meter.feed(*one) == []
    (closed,) = meter.feed(*(column[:0] for column in one), 1000)
    assert (closed.begin_us, closed.end_us, closed.n_on) == (0, 1000, 1)
    assert closed.elp == -int(WEIGHTS[2, 2])


def test_silence_gives_empty_windows() -> None:
    meter = Meter(ROI, WindowsByTime(100), 0)
    nothing = (np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.uint8))
    assert [one.n_on + one.n_off for one in meter.feed(*nothing, 1000)] == [0] * 10


def test_windows_by_travel_follow_an_accelerating_lens() -> None:
    t_us = np.linspace(0.0, 1e5, 101)
    ruler = Ruler.of_path(t_us, 1e-9 * t_us**2)  # to 10 um
    windows = WindowsByTravel(ruler, 0.5)
    edges = [50_000]
    for _ in range(10):
        edges.append(windows.edge_after(edges[-1]))
    travelled = np.diff(ruler.at(np.array(edges)))
    np.testing.assert_allclose(travelled, 0.5, atol=1e-3)
    assert (np.diff(edges, 2) <= 0).all()


def test_a_hot_pixel_is_counted_apart() -> None:
    t = np.arange(0, 20_000, 10, dtype=np.int64)
    same = np.full(t.size, 2, np.uint16)
    meter = Meter(ROI, WindowsByTime(20_000), 0, cap=PixelCap(6, 7))
    meter.set_reference(reference())
    (sample,) = meter.feed(t, same, same, np.ones(t.size, np.uint8), 20_000)
    assert sample.n_on + sample.n_capped == t.size
    assert sample.n_on <= 8 + 20_000 * 8 // 5_000


def test_rulers_say_where_and_when() -> None:
    path = Ruler.of_path(np.array([0.0, 100.0, 200.0, 300.0]), np.array([0.0, 10.0, 10.0, -10.0]))
    assert path.position(50.0) == 5.0
    assert path.stretch(50.0) == (0.0, 100.0, 1.0)
    assert path.stretch(150.0) == (0.0, 100.0, 1.0)
    assert path.stretch(250.0) == (200.0, 300.0, -1.0)
    assert path.time_of(0.0, 250.0) == 250.0
    assert Ruler.of_speed(-800.0).time_of(0.4, 0.0) == pytest.approx(500.0)
    assert not Ruler.of_time().in_um
    with pytest.raises(UsageError, match="rise"):
        Ruler.of_path(np.array([0.0, 0.0]), np.array([0.0, 1.0]))
    with pytest.raises(UsageError, match="zero"):
        Ruler.of_speed(0.0)
