"""Kernels against their slow twins, and what mirror pairs promise."""

from typing import Any

import naive_vision
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from elpd.vision.filters import PixelCap
from elpd.vision.pairs import find_pairs, weighted_mode


@st.composite
def event_columns(draw: Any, size: Any = 4, longest: Any = 120) -> Any:
    count = draw(st.integers(0, longest))
    gaps = draw(st.lists(st.integers(0, 3000), min_size=count, max_size=count))
    cells = draw(st.lists(st.integers(0, size * size - 1), min_size=count, max_size=count))
    on = draw(st.lists(st.integers(0, 1), min_size=count, max_size=count))
    cells = np.array(cells, np.int64)
    return (
        np.cumsum(np.array(gaps, np.int64)),
        (cells % size).astype(np.uint16),
        (cells // size).astype(np.uint16),
        np.array(on, np.uint8),
    )


@given(event_columns(), st.integers(1, 8), st.integers(8, 9000), st.integers(0, 120))
def test_the_cap_is_its_twin_for_any_cut(events: Any, burst: Any, decay_us: Any, cut: Any) -> None:
    t, x, y, _ = events
    cap = PixelCap(4, 4, burst=burst, decay_us=decay_us)
    kept = np.concatenate([cap.keep(t[:cut], x[:cut], y[:cut]), cap.keep(t[cut:], x[cut:], y[cut:])])
    assert kept.tolist() == naive_vision.cap_pixels(t.tolist(), x.tolist(), y.tolist(), burst, decay_us)


def test_a_hot_pixel_is_held_to_its_share_and_others_are_left_alone() -> None:
    hot = np.arange(0, 100_000, 50, dtype=np.int64)
    calm = np.arange(0, 100_000, 2_000, dtype=np.int64)
    t = np.concatenate([hot, calm])
    order = np.argsort(t, kind="stable")
    x = np.concatenate([np.zeros(hot.size), np.ones(calm.size)]).astype(np.uint16)[order]
    kept = PixelCap(1, 2).keep(t[order], x, np.zeros(t.size, np.uint16))
    assert kept[x == 1].all()
    assert kept[x == 0].sum() <= 8 + 100_000 * 8 // 5_000


@given(event_columns())
def test_pairs_are_their_twin(events: Any) -> None:
    t, x, y, on = events
    position = 0.01 * t + 3.0
    found = find_pairs(t, x, y, on, position, (4, 4))
    rows = zip(found.before, found.after, found.after_us, found.x, found.y, found.on, strict=True)
    expected = naive_vision.mirror_pairs(t.tolist(), x.tolist(), y.tolist(), on.tolist(), position.tolist())
    assert [tuple(one.item() for one in row) for row in rows] == expected


def test_pairs_find_the_turn_of_a_curve_whatever_contrast_and_threshold() -> None:
    """A pixel on a parabola, events at equal steps of level: each midpoint is the turn, for any step."""
    for step in (0.03, 0.1, 0.37):
        for start in (0.0, 0.4, 0.9):
            levels = np.arange(-1.0 + start * step, 0.0, step)
            rise = 10.0 - np.sqrt(-levels)
            # The first opposite event is one step below the last level, thus at the level before it.
            turn = 10.0 + np.sqrt(-levels[-2])
            position = np.append(rise, turn)
            t = np.arange(position.size, dtype=np.int64)
            zero = np.zeros(t.size, np.uint16)
            on = np.array([1] * rise.size + [0], np.uint8)
            pairs = find_pairs(t, zero, zero, on, position, (1, 1))
            np.testing.assert_allclose(pairs.middle, 10.0)


def test_the_mode_ignores_what_does_not_agree() -> None:
    rng = np.random.default_rng(3)
    values = np.concatenate([rng.normal(5.0, 0.5, 400), rng.uniform(-50.0, 5.0, 300)])
    mode = weighted_mode(values, np.ones(values.size), 0.5)
    assert abs(mode.at - 5.0) < 0.1
    assert 0.01 < mode.sigma < 0.1
    assert 0.5 < mode.share < 0.7


def test_the_mode_of_nothing_is_nothing() -> None:
    assert weighted_mode(np.empty(0), np.empty(0), 1.0) is None
    assert weighted_mode(np.ones(3), np.zeros(3), 1.0) is None
    assert weighted_mode(np.ones(3), np.ones(3), 0.0) is None
