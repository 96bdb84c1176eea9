"""The lag that mirror pairs tell, and how well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes_of_turns import turns_of_a_lag

from elpd.vision.lag import Lag, average_lag, expected_lag, weights_of_lines
from elpd.vision.pairs import Mode
from elpd.vision.turns import Line, Slowness, Turns, blocks_of, lateness
from elpd.vision.witness import LOPSIDED_PAIRS, SYSTEMATIC_PAIRS, EventWitnesses


def test_the_lag_of_dark_pixels_is_measured() -> None:
    turns, slowness = turns_of_a_lag(0.15)
    line, late = turns.line(slowness)
    assert line is not None
    assert line.slope == pytest.approx(0.15, abs=3.0 * line.sigma)
    assert line.sigma < 0.04
    assert turns.mode - line.slope * float(late.mean()) == pytest.approx(50.0, abs=0.3)
    lag = expected_lag(line, median=1.0)
    assert (lag.at, lag.sigma) == (line.slope, line.sigma)


def test_the_error_of_a_line_is_true_where_objects_share_what_is_wrong_with_them() -> None:
    errors = []
    for seed in range(40):
        turns, slowness = turns_of_a_lag(0.15, seed=seed, shared=1.0)
        line, _ = replace(turns, along=0.0).line(slowness)
        assert line is not None
        errors.append((line.slope - 0.15) / line.sigma)
    assert 0.6 < float(np.sqrt(np.mean(np.square(errors)))) < 1.5


def test_what_is_dark_beside_its_neighbours_may_be_slow_or_not() -> None:
    turns, slowness = turns_of_a_lag(0.15, contrast=2.0)
    turns = replace(turns, along=0.0)
    line, _ = turns.line(slowness)
    fooled, _ = turns.line(Slowness(slowness.times, np.zeros_like(slowness.times)))
    assert line is not None
    assert fooled is not None
    assert line.slope == pytest.approx(0.15, abs=3.0 * line.sigma)
    assert abs(fooled.slope - 0.15) > 5.0 * fooled.sigma
    assert abs(line.slope - 0.15) < 0.6 * abs(fooled.slope - 0.15)
    # Where local contrast does nothing both ways agree, and nothing is in doubt.
    plain, same = turns_of_a_lag(0.15)
    sure, _ = replace(plain, along=0.0).line(same)
    assert sure is not None
    assert line.sigma > 2.0 * sure.sigma


def test_slow_pixels_are_less_late_than_their_slowness_where_their_pairs_come_soon_after_focus() -> None:
    turns, slowness = turns_of_a_lag(1.5, reach=(2.0, 15.0), kernel=8.0)
    line, late = turns.line(slowness)
    assert line is not None
    assert float(late.mean()) < 0.9 * float(slowness.times.mean())
    assert line.slope == pytest.approx(1.5, rel=0.1)
    assert turns.mode - line.slope * float(late.mean()) == pytest.approx(50.0, abs=1.5)
    assert turns.share(line, late) > 0.95
    assert turns.share(None, late) == 0.0


@given(st.floats(1.0, 12.0), st.floats(0.0, 300.0), st.floats(0.01, 5.0))
def test_lateness_is_what_its_equation_says(times: float, gap: float, lag: float) -> None:
    share = float(lateness(np.array([times]), np.array([gap]), lag)[0]) / times
    assert 0.0 <= share <= 1.0
    left = -np.expm1(-0.5 * gap / (lag * times) - share)
    # At no gap the equation touches its root, and Newton's steps halve.
    assert share == pytest.approx(left, abs=1e-4 if gap > 0.1 * lag * times else 0.1)


def test_without_a_lag_all_pixels_are_as_late_as_they_are_slow() -> None:
    times = np.array([1.0, 5.0])
    assert lateness(times, np.array([3.0, 3.0]), 0.0) is times
    assert lateness(times, np.array([3.0, 3.0]), -0.2) is times


def test_what_scatters_about_the_line_may_lie_along_it_too() -> None:
    turns, slowness = turns_of_a_lag(0.15)
    bare, _ = replace(turns, along=0.0).line(slowness)
    doubted, _ = turns.line(slowness)
    assert bare is not None
    assert doubted is not None
    assert doubted.slope == bare.slope
    scattered = replace(turns, middle=turns.middle + np.random.default_rng(5).normal(0.0, 4.0, turns.middle.size))
    worse, _ = scattered.line(slowness)
    assert worse is not None
    assert bare.sigma < 0.5 * doubted.sigma
    assert worse.sigma == pytest.approx(doubted.sigma * worse.scatter / doubted.scatter, rel=0.3)
    # Nothing else is left to say than what is known of photoreceptors.
    assert expected_lag(replace(bare, sigma=1e3), 1.0) == expected_lag(None, 1.0)


def test_pairs_that_motion_makes_tell_no_lag() -> None:
    turns, slowness = turns_of_a_lag(0.15)
    random = np.random.default_rng(1)
    astray = replace(turns, middle=turns.mode + random.uniform(-1.0, 1.0, turns.middle.size) * turns.reach)
    line, late = astray.line(slowness)
    assert line is None
    assert late is slowness.times


def test_pixels_of_one_brightness_few_pairs_or_a_small_part_of_the_picture_tell_no_lag() -> None:
    turns, slowness = turns_of_a_lag(0.15)
    same = Slowness(np.ones_like(slowness.times), np.zeros_like(slowness.times))
    assert turns.line(same)[0] is None
    none = np.where(np.arange(turns.weights.size) < 30, 1.0, 0.0)
    assert replace(turns, weights=none).line(slowness)[0] is None
    assert replace(turns, block=turns.block % 4).line(slowness)[0] is None


def test_a_lag_is_never_negative_and_unmeasured_is_what_may_be_expected() -> None:
    turns, slowness = turns_of_a_lag(-0.1)
    line, _ = turns.line(slowness)
    assert line is not None
    assert line.slope < 0.0
    assert expected_lag(line, median=1.0) == Lag(0.0, line.sigma)
    unmeasured = expected_lag(None, median=0.7)
    assert unmeasured.at == pytest.approx(0.7 * np.exp(0.5 * (0.5 * np.log(10.0)) ** 2), rel=1e-3)
    assert unmeasured.sigma > 3.0 * 0.7, "a lag of five times the usual one is no surprise"
    assert expected_lag(None, median=0.0) == Lag()
    # A measurement may be far beyond what is usual, and is not drawn back.
    assert expected_lag(Line(2.0, 0.5, 1.0, 100.0), median=0.5) == Lag(2.0, 0.5)


def test_the_slowness_that_explains_the_pairs_has_the_say() -> None:
    turns, slowness = turns_of_a_lag(0.15)
    shuffled = np.random.default_rng(3).permutation(slowness.times.size)
    other = Slowness(slowness.times[shuffled], slowness.beyond[shuffled])
    lines = [turns.line(one)[0] for one in (slowness, other)]
    share = weights_of_lines(lines)
    assert share[0] > 0.7
    assert weights_of_lines([None, None]).tolist() == [0.5, 0.5]
    both = average_lag([Lag(1.0, 0.1), Lag(3.0, 0.1)], np.array([1.0, 1.0]))
    assert both.at == pytest.approx(2.0)
    assert both.sigma == pytest.approx(1.0, abs=0.01)


def test_a_picture_is_cut_into_sixteen_blocks() -> None:
    y, x = (one.ravel().astype(np.uint16) for one in np.mgrid[:37, :50])
    blocks = blocks_of(x, y, (37, 50))
    assert sorted(set(blocks.tolist())) == list(range(16))
    assert blocks[0] == 0
    assert blocks[-1] == 15


def test_slowness_is_told_apart_into_what_is_local_and_what_is_not() -> None:
    times = np.full((60, 60), 2.0)
    times[:, 30:] = 8.0
    times[20, 10] = 6.0
    slowness = Slowness.of(times)
    assert slowness.beyond[50, 5] == pytest.approx(0.0, abs=1e-3)
    assert slowness.beyond[50, 55] == pytest.approx(0.0, abs=1e-3)
    assert slowness.beyond[20, 10] == pytest.approx(np.log(3.0), abs=0.1)
    here = slowness.at(np.array([20], np.uint16), np.array([10], np.uint16))
    assert here.times.tolist() == [6.0]


@pytest.mark.parametrize("seed", [1, 4, 6])
def test_pairs_in_two_heaps_have_no_line_between_them(seed: int) -> None:
    rng, count = np.random.default_rng(seed), 300
    middle = np.where(rng.random(count) < 0.5, -30.0, 30.0)
    even = np.ones(count)
    turns = Turns(middle, even, even, np.arange(count) % 64, 0.0, 8.0, 33.0)
    line, late = turns.line(Slowness(rng.uniform(1.0, 20.0, count), np.zeros(count)))
    assert line is None or abs(20.0 * line.slope) < 1.0, "at most along one of them"
    assert late.shape == (count,)


def test_long_pairs_know_focus_the_less_the_more_lopsided_a_lens_may_be() -> None:
    """Of pairs as long as six widths a mean over many passes says no better where focus is; of short ones it does."""
    count, width = 200, 30.0
    middle = np.random.default_rng(3).normal(0.0, 1.0, count)

    def optics(widths: float) -> float:
        gap = np.full(count, widths * width)
        turns = Turns(middle, gap, np.ones(count), np.arange(count) % 16, 0.0, 4.5, 24.0)
        assert turns.mean_square_gap == pytest.approx((widths * width) ** 2)
        said = EventWitnesses(None, Mode(0.0, 0.1, float(count), 1.0), Lag(), turns=turns)
        return next(one.optics for one in said.witnesses(width=width) if one.name == "pairs")

    assert optics(0.1) == pytest.approx(SYSTEMATIC_PAIRS * width, rel=0.02)
    assert optics(6.0) == pytest.approx(36.0 * LOPSIDED_PAIRS * width, rel=0.02)


def test_no_pairs_have_no_length() -> None:
    nothing = np.zeros(0)
    assert Turns(nothing, nothing, nothing, nothing.astype(np.int64), 0.0, 1.0, 1.0).mean_square_gap == 0.0
