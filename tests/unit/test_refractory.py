import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from elpd.vision.refractory import MOST_US, Refractory, refractory_period, shortest_intervals

FOREVER = np.iinfo(np.int64).max


def slow_shortest(events: list[tuple[int, int, int]], keep: int) -> tuple[list[int], int]:
    last: dict[tuple[int, int], int] = {}
    intervals = []
    for t, x, y in events:
        if (x, y) in last and t > last[x, y]:
            intervals.append(t - last[x, y])
        last[x, y] = t
    return (sorted(intervals) + [FOREVER] * keep)[:keep], len(intervals)


@given(
    st.lists(st.tuples(st.integers(0, 50), st.integers(0, 3), st.integers(0, 2)), max_size=80),
    st.integers(1, 9),
    st.integers(0, 80),
)
def test_the_kernel_is_its_slow_twin_for_any_split(steps: list[tuple[int, int, int]], keep: int, cut: int) -> None:
    t = np.cumsum(np.array([step for step, _, _ in steps], np.int64))
    x = np.array([x for _, x, _ in steps], np.uint16)
    y = np.array([y for _, _, y in steps], np.uint16)
    last, shortest = np.full((3, 4), -1, np.int64), np.full(keep, FOREVER)
    count = sum(
        shortest_intervals(t[part], x[part], y[part], last, shortest) for part in (slice(cut), slice(cut, None))
    )
    assert (shortest.tolist(), count) == slow_shortest(list(zip(t.tolist(), x.tolist(), y.tolist(), strict=True)), keep)


def deaf_pixels(period_us: int, grid_us: int = 1) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16]]:
    """Poisson events of 40x40 pixels, each deaf for a while after each."""
    random = np.random.default_rng(3)
    waits = random.exponential(3000.0, (1600, 30)) + period_us
    t = (np.cumsum(waits, axis=1) // grid_us * grid_us).astype(np.int64)
    pixel = np.repeat(np.arange(1600), 30)
    order = np.argsort(t.ravel(), kind="stable")
    return t.ravel()[order], (pixel % 40).astype(np.uint16)[order], (pixel // 40).astype(np.uint16)[order]


def test_the_period_is_found_within_its_error() -> None:
    for period_us in (0, 100, 500, 900):
        found = refractory_period(*deaf_pixels(period_us), (40, 40))
        assert abs(found.period_us - period_us) < 3 * found.sigma_us + 2
        assert found.sigma_us < 40


def test_the_steepest_edge_in_view_is_not_taken_for_deafness() -> None:
    """Without noise intervals crowd where the picture changes fastest, and say nothing of what a pixel could do."""
    random = np.random.default_rng(5)
    waits = 600.0 + random.gamma(7.0, 200.0, (1600, 30))
    t = np.cumsum(waits, axis=1).astype(np.int64)
    pixel = np.repeat(np.arange(1600), 30)
    order = np.argsort(t.ravel(), kind="stable")
    x, y = (pixel % 40).astype(np.uint16)[order], (pixel // 40).astype(np.uint16)[order]
    found = refractory_period(t.ravel()[order], x, y, (40, 40))
    shortest_us = float(np.diff(waits.cumsum(axis=1), axis=1).min())
    assert shortest_us > 600.0
    assert found.period_us == pytest.approx(0.5 * shortest_us, rel=0.2), "it is anything below, evenly"
    assert found.sigma_us == pytest.approx(shortest_us / np.sqrt(12.0), rel=0.2)


def test_one_steep_edge_is_not_taken_for_deafness() -> None:
    """It makes several intervals alike, shorter than all others, far below the crowd."""
    random = np.random.default_rng(6)
    waits = 600.0 + random.gamma(5.0, 150.0, (1600, 30))
    waits[7] = 700.0 + random.normal(0.0, 10.0, 30)
    t = np.cumsum(waits, axis=1).astype(np.int64)
    pixel = np.repeat(np.arange(1600), 30)
    order = np.argsort(t.ravel(), kind="stable")
    x, y = (pixel % 40).astype(np.uint16)[order], (pixel // 40).astype(np.uint16)[order]
    found = refractory_period(t.ravel()[order], x, y, (40, 40))
    assert found.sigma_us > 150.0
    assert found.period_us < 400.0


def test_what_nobody_sets_is_not_believed() -> None:
    assert refractory_period(*deaf_pixels(1500), (40, 40)) == Refractory(0.5 * MOST_US, MOST_US / np.sqrt(12.0))


def test_a_grid_of_time_stamps_or_few_events_only_bound_the_period() -> None:
    anything = Refractory(0.5 * MOST_US, MOST_US / np.sqrt(12.0))
    assert refractory_period(*deaf_pixels(500, grid_us=1000), (40, 40)) == anything
    t, x, y = deaf_pixels(500)
    few = refractory_period(t[:2000], x[:2000], y[:2000], (40, 40))
    assert few.sigma_us > 100, "the period is anything below the shortest interval"
    assert abs(few.period_us - 500) < 2 * few.sigma_us
    none = np.empty(0, np.int64)
    assert refractory_period(none, none.astype(np.uint16), none.astype(np.uint16), (40, 40)) == anything


@pytest.mark.parametrize("grid_us", [100, 250, 1000])
def test_intervals_as_long_as_a_grid_makes_them_are_no_period(grid_us: int) -> None:
    """Edges in view leave intervals that crowd; on a grid the shortest ones are all alike, as if at a period."""
    random = np.random.default_rng(8)
    waits = 400.0 + random.gamma(4.0, 500.0, (1600, 30))
    t = (np.cumsum(waits, axis=1) // grid_us * grid_us).astype(np.int64)
    pixel = np.repeat(np.arange(1600), 30)
    order = np.argsort(t.ravel(), kind="stable")
    x, y = (pixel % 40).astype(np.uint16)[order], (pixel // 40).astype(np.uint16)[order]
    found = refractory_period(t.ravel()[order], x, y, (40, 40))
    assert abs(found.period_us - 400) < 2 * found.sigma_us
    assert found.sigma_us > 100
