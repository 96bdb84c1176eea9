import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from elpd.vision.refractory import MOST_US, Deafness, Refractory, refractory_period, shortest_intervals

FOREVER = np.iinfo(np.int64).max


def slow_shortest(events: list[tuple[int, int, int, int]], keep: int) -> tuple[list[int], list[int], int]:
    last: dict[tuple[int, int], tuple[int, int]] = {}
    intervals, opposite = [], []
    for t, x, y, on in events:
        if (x, y) in last and t > last[x, y][0]:
            intervals.append(t - last[x, y][0])
            if on != last[x, y][1]:
                opposite.append(intervals[-1])
        last[x, y] = t, on
    kept, kept_opposite = ((sorted(one) + [FOREVER] * keep)[:keep] for one in (intervals, opposite))
    return kept, kept_opposite, len(intervals)


@given(
    st.lists(st.tuples(st.integers(0, 50), st.integers(0, 3), st.integers(0, 2), st.integers(0, 1)), max_size=80),
    st.integers(1, 9),
    st.integers(0, 80),
)
def test_the_kernel_is_its_slow_twin_for_any_split(steps: list[tuple[int, int, int, int]], keep: int, cut: int) -> None:
    t = np.cumsum(np.array([step[0] for step in steps], np.int64))
    x, y = (np.array([step[k] for step in steps], np.uint16) for k in (1, 2))
    on = np.array([step[3] for step in steps], np.uint8)
    last, shortest, opposite = np.full((3, 4), -1, np.int64), np.full(keep, FOREVER), np.full(keep, FOREVER)
    count = sum(
        shortest_intervals(t[part], x[part], y[part], on[part], last, shortest, opposite)
        for part in (slice(cut), slice(cut, None))
    )
    events = list(zip(t.tolist(), x.tolist(), y.tolist(), on.tolist(), strict=True))
    assert (shortest.tolist(), opposite.tolist(), count) == slow_shortest(events, keep)


Columns = tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]


def in_order(waits: NDArray[np.float64], grid_us: int = 1, on: NDArray[np.uint8] | None = None) -> Columns:
    """Return events of 40x40 pixels in time order by how long each waits, (pixels, events); ON events only."""
    t = (np.cumsum(waits, axis=1) // grid_us * grid_us).astype(np.int64).ravel()
    pixel = np.repeat(np.arange(waits.shape[0]), waits.shape[1])
    signs = np.ones(t.size, np.uint8) if on is None else on.ravel()
    order = np.argsort(t, kind="stable")
    return t[order], (pixel % 40).astype(np.uint16)[order], (pixel // 40).astype(np.uint16)[order], signs[order]


def deaf_pixels(period_us: int, grid_us: int = 1) -> Columns:
    """Poisson events of 40x40 pixels, each deaf for a while after each."""
    return in_order(np.random.default_rng(3).exponential(3000.0, (1600, 30)) + period_us, grid_us)


def test_the_period_is_found_within_its_error() -> None:
    for period_us in (0, 100, 500, 900):
        found = refractory_period(*deaf_pixels(period_us), (40, 40))
        assert abs(found.period_us - period_us) < 3 * found.sigma_us + 2
        assert found.sigma_us < 40


def test_the_steepest_edge_in_view_is_not_taken_for_deafness() -> None:
    """Without noise intervals crowd where the picture changes fastest, and say nothing of what a pixel could do."""
    random = np.random.default_rng(5)
    waits = 600.0 + random.gamma(7.0, 200.0, (1600, 30))
    found = refractory_period(*in_order(waits), (40, 40))
    shortest_us = float(np.diff(waits.cumsum(axis=1), axis=1).min())
    assert shortest_us > 600.0
    assert found.period_us == pytest.approx(0.5 * shortest_us, rel=0.2), "it is anything below, evenly"
    assert found.sigma_us == pytest.approx(shortest_us / np.sqrt(12.0), rel=0.2)


def test_one_steep_edge_is_not_taken_for_deafness() -> None:
    """It makes several intervals alike, shorter than all others, far below the crowd."""
    random = np.random.default_rng(6)
    waits = 600.0 + random.gamma(5.0, 150.0, (1600, 30))
    waits[7] = 700.0 + random.normal(0.0, 10.0, 30)
    found = refractory_period(*in_order(waits), (40, 40))
    assert found.sigma_us > 150.0
    assert found.period_us < 400.0


def test_what_nobody_sets_is_not_believed() -> None:
    assert refractory_period(*deaf_pixels(1500), (40, 40)) == Refractory(0.5 * MOST_US, MOST_US / np.sqrt(12.0))


def test_a_grid_of_time_stamps_or_few_events_only_bound_the_period() -> None:
    anything = Refractory(0.5 * MOST_US, MOST_US / np.sqrt(12.0))
    assert refractory_period(*deaf_pixels(500, grid_us=1000), (40, 40)) == anything
    few = refractory_period(*(column[:2000] for column in deaf_pixels(500)), (40, 40))
    assert few.sigma_us > 100, "the period is anything below the shortest interval"
    assert abs(few.period_us - 500) < 2 * few.sigma_us
    assert refractory_period(*(column[:0] for column in deaf_pixels(500)), (40, 40)) == anything


@pytest.mark.parametrize("grid_us", [100, 250, 1000])
def test_intervals_as_long_as_a_grid_makes_them_are_no_period(grid_us: int) -> None:
    """Edges in view leave intervals that crowd; on a grid the shortest ones are all alike, as if at a period."""
    random = np.random.default_rng(8)
    waits = 400.0 + random.gamma(4.0, 500.0, (1600, 30))
    found = refractory_period(*in_order(waits, grid_us), (40, 40))
    assert abs(found.period_us - 400) < 2 * found.sigma_us
    assert found.sigma_us > 100


def edges_and_noise(period_us: float, seed: int, noise: float = 0.003) -> Columns:
    """Edges make events of one sign, never close together; a few of the other sign come of noise at any time after."""
    random = np.random.default_rng(seed)
    waits = period_us + 150.0 + random.gamma(5.0, 150.0, (1600, 60))
    on = np.ones(waits.shape, np.uint8)
    stray = random.random(waits.shape) < noise
    waits[stray] = period_us + random.uniform(0.0, 4000.0, int(stray.sum()))
    on[stray] = 0
    return in_order(waits, 1, on)


def test_where_edges_crowd_the_few_opposite_events_of_noise_tell_the_period() -> None:
    found = [refractory_period(*edges_and_noise(500.0, seed), (40, 40)) for seed in range(40)]
    sigma_us = np.array([one.sigma_us for one in found])
    error_us = np.array([one.period_us for one in found]) - 500.0
    assert sigma_us.max() < 100.0
    assert abs(error_us.mean()) < 0.5 * sigma_us.mean()
    assert np.mean(np.abs(error_us) < 2.0 * sigma_us) > 0.85
    without = refractory_period(*edges_and_noise(500.0, 0, noise=0.0), (40, 40))
    assert without.sigma_us > 150.0


def test_the_longer_it_listens_the_better_it_knows() -> None:
    deafness, sigmas = Deafness((40, 40)), []
    for seed in range(4):
        t_us, x, y, on = edges_and_noise(500.0, seed)
        deafness.add(t_us + seed * 200_000, x, y, on)
        sigmas.append(deafness.period().sigma_us)
    assert sigmas[-1] < 0.5 * sigmas[0]
    assert abs(deafness.period().period_us - 500.0) < 3.0 * sigmas[-1]


def test_a_slip_of_the_time_stamps_is_no_period() -> None:
    t_us, x, y, on = edges_and_noise(500.0, 1)
    slipped = np.append(t_us, t_us[-1] + 3), np.append(x, x[-1]), np.append(y, y[-1]), np.append(on, 1 - on[-1])
    assert refractory_period(*slipped, (40, 40)) == refractory_period(t_us, x, y, on, (40, 40))
