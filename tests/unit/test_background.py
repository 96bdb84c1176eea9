"""The filter of background activity: against its slow twin, and what it lets through."""

import naive
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.errors import UsageError
from elpd.records import Geometry, Roi
from elpd.vision.background import BackgroundActivity
from elpd.vision.elp import ElpWindows
from elpd.vision.memory import EventMemory

EVENTS = st.lists(st.tuples(st.integers(-3, 40), st.integers(0, 8), st.integers(0, 6)), max_size=150)


@given(EVENTS, st.integers(1, 200), st.integers(0, 5), st.integers(0, 5), st.lists(st.integers(0, 150), max_size=3))
def test_any_events_equal_the_slow_twin_however_cut(
    steps: list[tuple[int, int, int]], support_us: int, left: int, top: int, cuts: list[int]
) -> None:
    table = np.array(steps, np.int64).reshape(-1, 3)
    t, x, y = np.cumsum(table[:, 0]), table[:, 1].astype(np.uint16), table[:, 2].astype(np.uint16)
    background = BackgroundActivity(7, 9, support_us, left=left, top=top)
    parts = [sorted(cuts)] * 3
    kept = [background.keep(*piece) for piece in zip(*map(np.split, (t, x, y), parts), strict=True)]
    cells: dict[tuple[int, int], tuple[int, int, int]] = {}
    slow = [
        not naive.alone(cells, when, column + left, row + top, support_us)
        for when, column, row in zip(t.tolist(), x.tolist(), y.tolist(), strict=True)
    ]
    assert np.concatenate(kept).tolist() == slow


def test_an_edge_passes_and_lone_or_hot_pixels_do_not() -> None:
    background = BackgroundActivity(4, 8, 1000)
    t = np.array([0, 10, 20, 30, 5000, 9000, 9100, 9200], np.int64)
    x = np.array([0, 1, 0, 1, 0, 6, 6, 6], np.uint16)
    y = np.array([0, 0, 1, 1, 0, 2, 2, 2], np.uint16)
    assert background.keep(t, x, y).tolist() == [False, True, True, True, False, False, False, False]


def test_the_memory_of_a_sweep_hears_what_the_windows_hear() -> None:
    rng = np.random.default_rng(4)
    roi, geometry = Roi(13, 11, 20, 18), Geometry(64, 48)
    n = 6000
    t = np.cumsum(rng.integers(0, 12, n)).astype(np.int64)
    x, y = rng.integers(0, 64, n).astype(np.uint16), rng.integers(0, 48, n).astype(np.uint16)
    on = rng.integers(0, 2, n).astype(np.uint8)
    memory = EventMemory(roi, geometry, support_us=400)
    memory.add(t, x, y, on)
    heard = np.zeros((48, 64), np.bool_)
    heard[memory._top : memory._bottom, memory._left : memory._right] = True
    windows = ElpWindows(np.ones((48, 64), np.int64), heard, window_us=1000, rate_cap=True, support_us=400)
    rows = windows.feed_arrays(t, x, y, on, complete_until_us=int(t[-1]) + 2000)
    assert rows["n_capped"].sum() == memory.capped > 500
    assert (rows["n_on"] + rows["n_off"]).sum() == memory._count > 200


def test_it_goes_with_the_rate_cap() -> None:
    with pytest.raises(UsageError, match="goes with rate_cap"):
        ElpWindows(np.ones((8, 8), np.int64), support_us=5)
