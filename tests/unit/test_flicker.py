"""A lamp is told from noise, from motion and from nothing; whole periods leave nothing of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elpd.records import Geometry, Roi
from elpd.vision.flicker import FALSE_ALARM, find_flicker, find_line, residue, stamp_grid_us
from elpd.vision.resting import Resting, hot_pixels
from elpd.vision.whole_periods import WholePeriods

SPAN_US = 48_000


def noise(seed: int, count: int, bias: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    t, on = np.sort(rng.integers(0, SPAN_US, count)), (rng.random(count) < bias).astype(np.uint8)
    return t, rng.integers(0, 500, count), on


def lamp(hz: float, seed: int = 0, pixels: int = 500, depth: float = 3.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every pixel follows a sine of *depth* thresholds from its own offset."""
    t = np.arange(0, SPAN_US, 50)
    offset = np.random.default_rng(seed).random(pixels)
    level = np.floor(depth * np.sin(2e-6 * np.pi * hz * t)[None, :] + offset[:, None]).astype(int)
    pixel, step = np.nonzero(np.diff(level, axis=1))
    change = np.diff(level, axis=1)[pixel, step]
    order = np.argsort(t[step], kind="stable")
    return t[step][order], pixel[order].astype(np.int64), (change[order] > 0).astype(np.uint8)


@pytest.mark.parametrize("bias", [0.5, 0.8])
def test_noise_is_not_taken_for_a_lamp(bias: float) -> None:
    assert FALSE_ALARM * 20 < 0.01
    assert not any(find_flicker(*noise(seed, 3000, bias), 0, SPAN_US) for seed in range(20))


def test_scarce_events_say_nothing() -> None:
    t, pixel, on = lamp(100.0, pixels=2, depth=1.0)
    assert find_flicker(t[:10], pixel[:10], on[:10], 0, SPAN_US) is None
    assert find_flicker(t, pixel, on, 0, 1000) is None


@pytest.mark.parametrize("hz", [90.0, 100.0, 120.0, 240.0, 700.0])
def test_a_lamp_is_found_and_its_frequency_measured(hz: float) -> None:
    t, pixel, on = lamp(hz)
    found = find_flicker(t, pixel, on, 0, SPAN_US)
    assert found is not None
    assert found.frequency_hz == pytest.approx(hz, rel=2e-3)
    assert found.share > 0.8


def test_a_lamp_is_found_among_other_events_but_not_when_they_are_most() -> None:
    swinging = lamp(100.0)
    few, many = (
        tuple(np.concatenate(two) for two in zip(swinging, noise(1, times * swinging[0].size), strict=True))
        for times in (1, 20)
    )
    assert find_flicker(*few, 0, SPAN_US) is not None
    assert find_flicker(*many, 0, SPAN_US) is None


def passing(columns: int, hz: float, rows: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A square, bright on its way in and dark on its way out, whose edges enter a new column *hz* times a second."""
    into = np.repeat(np.arange(columns), rows)
    t_us = np.rint(1e6 / hz * into).astype(np.int64) + np.tile(np.arange(rows), columns)
    pixel = np.tile(np.arange(rows), columns) * 200 + into
    kept = t_us < SPAN_US
    return t_us[kept], pixel[kept], np.ones(int(kept.sum()), np.uint8)


def test_an_edge_that_goes_from_column_to_column_makes_a_line_but_is_no_lamp() -> None:
    front, noisy = passing(15, 300.0), noise(3, 600)
    rear = front[0] + 1_500, front[1] + 30, 1 - front[2]
    t, pixel, on = (np.concatenate(columns) for columns in zip(front, rear, noisy, strict=True))
    line = find_line(t, on, 0, SPAN_US)
    assert line is not None
    assert line.frequency_hz == pytest.approx(300.0, rel=0.01)
    assert find_flicker(t, pixel, on, 0, SPAN_US) is None


def test_pixels_that_are_all_left_behind_by_the_middle_show_no_lamp() -> None:
    t, pixel, on = lamp(100.0)
    pixel = np.where(t < SPAN_US // 2, pixel, pixel + 500)
    assert find_line(t, on, 0, SPAN_US) is not None
    assert find_flicker(t, pixel, on, 0, SPAN_US) is None


def test_a_lamp_is_found_although_an_edge_goes_by() -> None:
    t, pixel, on = (np.concatenate(two) for two in zip(lamp(100.0), passing(15, 300.0), strict=True))
    assert find_flicker(t, pixel, on, 0, SPAN_US) is not None


@pytest.mark.parametrize("grid_us", [1000, 1000 / 3, 500, 250, 200])
def test_the_grid_of_a_coarse_clock_is_no_lamp_and_hides_none(grid_us: float) -> None:
    t, pixel, on = lamp(2.0, depth=40.0)  # what a sweep does: every pixel once up and down
    stamps = np.rint(np.ceil(t / grid_us) * grid_us).astype(np.int64)
    assert stamp_grid_us(stamps) == pytest.approx(grid_us, abs=1.0)
    assert find_line(stamps, on, 0, SPAN_US) is None
    between = np.random.default_rng(4).random(stamps.size) < 0.05
    strayed = stamps - np.where(between & (stamps % 5 == 0), int(grid_us) // 2, 0)
    assert find_line(np.sort(strayed), on, 0, SPAN_US) is None
    t, pixel, on = lamp(100.0)
    found = find_flicker(np.rint(np.ceil(t / grid_us) * grid_us).astype(np.int64), pixel, on, 0, SPAN_US)
    assert found is not None
    assert found.frequency_hz == pytest.approx(100.0, rel=5e-3)


def test_stamps_at_random_lie_on_no_grid() -> None:
    assert stamp_grid_us(noise(2, 3000)[0]) < 20
    assert stamp_grid_us(np.array([7], dtype=np.int64)) == 1


def test_whole_periods_of_pixels_that_follow_leave_nothing_and_others_are_seen() -> None:
    t, pixel, on = lamp(100.0)
    found = find_flicker(t, pixel, on, 0, SPAN_US)
    assert found is not None
    assert residue(t, pixel, on, found, SPAN_US) < 1.0
    deaf = on.astype(bool) | (np.random.default_rng(1).random(on.size) < 0.5)
    assert residue(t[deaf], pixel[deaf], on[deaf], found, SPAN_US) > 2.0


def test_net_events_of_whole_periods_are_few_and_of_one_time() -> None:
    t, pixel, on = lamp(100.0)
    periods = WholePeriods(np.ones((20, 25), bool), 0)
    periods.add(t, (pixel % 25).astype(np.uint16), (pixel // 25).astype(np.uint16), on)
    first = periods.close(0, 10_000)
    assert np.all(first.t_us == 5_000)
    assert first.x.size < 0.2 * (t < 10_000).sum()


@given(st.lists(st.tuples(st.integers(0, 99), st.integers(0, 11), st.booleans()), max_size=60), st.integers(0, 100))
@settings(deadline=None)
def test_net_events_equal_the_sum_pixel_by_pixel(events: list[tuple[int, int, bool]], end_us: int) -> None:
    events = sorted(events)
    t, pixel, on = (np.array(column) for column in zip(*events, strict=True)) if events else (np.empty(0, int),) * 3
    periods = WholePeriods(np.ones((3, 4), bool), 0)
    x, y = (pixel % 4).astype(np.uint16), (pixel // 4).astype(np.uint16)
    periods.add(t.astype(np.int64), x, y, on.astype(np.uint8))
    net = periods.close(0, end_us)
    level = [sum(1 if up else -1 for when, which, up in events if which == k and when < end_us) for k in range(12)]
    told = [0] * 12
    for column, row, up in zip(net.x.tolist(), net.y.tolist(), net.on.tolist(), strict=True):
        told[4 * row + column] += 1 if up else -1
    assert told == level
    assert net.x.size == sum(abs(one) for one in level)
    rest = periods.close(end_us, 200)
    assert rest.x.size <= sum(when >= end_us for when, _, _ in events)


def test_hot_pixels_stand_out_of_their_neighbours_and_edges_do_not() -> None:
    count = np.random.default_rng(0).poisson(0.05, (60, 80))
    count[10, 10] = 30
    count[30:32, :] += 12  # an edge that trembles: neighbours fire alike
    assert np.argwhere(hot_pixels(count)).tolist() == [[10, 10]]


def test_noise_makes_no_hot_pixels() -> None:
    rng = np.random.default_rng(3)
    assert not any(hot_pixels(rng.poisson(rate, (300, 300))).any() for rate in (0.0, 0.01, 0.3, 3.0))


def test_a_resting_sensor_tells_rate_elp_and_hot_pixels() -> None:
    rng = np.random.default_rng(5)
    count, geometry, roi = 4000, Geometry(64, 48), Roi(16, 16, 32, 16)
    t = np.sort(rng.integers(0, 20_000, count))
    x, y = rng.integers(0, 64, count).astype(np.uint16), rng.integers(0, 48, count).astype(np.uint16)
    on = (rng.random(count) < 0.5).astype(np.uint8)
    x[::80], y[::80] = 20, 20
    weights = np.zeros((48, 64), np.int16)
    weights[16:32, 16:48] = rng.integers(-50, 50, (16, 32))
    resting = Resting(roi, geometry)
    for part in np.array_split(np.arange(count), 7):
        resting.add(t[part], x[part], y[part], on[part], None)
    assert not resting.restless
    rest = resting.settle(weights)
    kept = (x != 20) | (y != 20)
    inside = kept & (x >= 16) & (x < 48) & (y >= 16) & (y < 32)
    elp = -int(((2 * on.astype(int) - 1) * weights[y, x])[kept].sum())
    assert np.argwhere(resting.hot).tolist() == [[20, 20]]
    assert resting.events == inside.sum()
    assert rest.elp_per_us == pytest.approx(elp / resting.duration_us)
    assert rest.events_per_us == pytest.approx(inside.sum() / resting.duration_us)
    assert resting.flicker is None


def test_a_resting_sensor_under_a_lamp_is_restless_and_counts_what_periods_leave() -> None:
    t, pixel, on = lamp(100.0)
    resting = Resting(Roi(0, 0, 25, 20), Geometry(25, 20))
    resting.add(t, (pixel % 25).astype(np.uint16), (pixel // 25).astype(np.uint16), on, SPAN_US)
    assert resting.restless
    resting.settle(np.ones((20, 25), np.int16))
    assert resting.flicker is not None
    assert resting.events < 0.2 * t.size
    assert not resting.hot.any()
