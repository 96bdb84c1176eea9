"""What replies teach about when a controller looked: how they scatter, what they share, how late it was at most."""

from __future__ import annotations

import numpy as np
import pytest
from elpd_drivers.sim.world import random_stream
from hypothesis import given
from hypothesis import strategies as st

from elpd.motion.commanded import Motion
from elpd.motion.epoch import Epoch
from elpd.motion.kinematics import Knot
from elpd.motion.reply_time import ReplyTime

VELOCITY_SPS = 12_800.0
OTHER = 0.3**2


def after_replies(scatter_s: float, count: int, sigma_ns: float = 100_000.0) -> ReplyTime:
    draw = random_stream(3, "replies")
    learnt = ReplyTime(300_000, sigma_ns)
    for _ in range(count):
        late_s, other = draw.normal(0.0, scatter_s), draw.normal(0.0, OTHER**0.5)
        learnt.scattered(float(VELOCITY_SPS * late_s + other), VELOCITY_SPS, OTHER)
    return learnt


def test_before_any_reply_half_of_the_variance_is_chance_and_more_than_half_may_be_shared() -> None:
    supposed = ReplyTime(300_000, 100_000)
    assert supposed.chance_s == pytest.approx(100e-6 / 2**0.5)
    assert supposed.common_s == pytest.approx(100e-6 * (0.5 + 0.5 * 0.5**0.5) ** 0.5, rel=0.01)
    assert supposed.usual_ns == 300_000


@pytest.mark.parametrize("scatter_us", [0.0, 40.0, 80.0])
def test_what_replies_scatter_is_not_shared_and_the_rest_is(scatter_us: float) -> None:
    learnt = after_replies(scatter_us * 1e-6, 2000)
    assert learnt.chance_s == pytest.approx(scatter_us * 1e-6, abs=8e-6)
    assert learnt.common_s == pytest.approx((100**2 - scatter_us**2) ** 0.5 * 1e-6, abs=8e-6)


def test_few_replies_change_little() -> None:
    assert after_replies(0.0, 1).chance_s > 0.8 * ReplyTime(0, 100_000).chance_s


def test_an_accident_counts_as_three_standard_deviations() -> None:
    learnt = after_replies(0.0, 200)
    before = learnt.chance_s
    learnt.scattered(1e6, VELOCITY_SPS, OTHER)
    assert learnt.chance_s < before + 10e-6


def test_nothing_was_sampled_after_it_had_come() -> None:
    learnt = ReplyTime(600_000, 350_000)
    assert not learnt.took(150_000)
    assert not learnt.took(150_000), "one reply, or two, may have been taken for another's"
    assert learnt.took(150_000)
    assert 0 < learnt.usual_ns < 600_000
    assert learnt.common_s < 200e-6
    assert not learnt.took(900_000)


def test_a_time_that_is_known_exactly_stays_known() -> None:
    exact = ReplyTime(70_000, 0.0)
    exact.scattered(3.0, VELOCITY_SPS, OTHER)
    assert not exact.took(10)
    assert (exact.usual_ns, exact.chance_s, exact.common_s) == (70_000, 0.0, 0.0)


@given(quickest_us=st.floats(20, 3000), usual_us=st.floats(50, 1500), sigma_us=st.floats(20, 800))
def test_the_shared_delay_is_a_normal_one_cut_off(quickest_us: float, usual_us: float, sigma_us: float) -> None:
    learnt = ReplyTime(usual_us * 1000, sigma_us * 1000)
    for _ in range(3):
        learnt.took(quickest_us * 1000)
    chance_us = sigma_us / 2**0.5
    shared_us = sigma_us * (0.5 + 0.5 * 0.5**0.5) ** 0.5
    times_us = np.linspace(0.0, quickest_us + 3**0.5 * chance_us, 20_001)  # the slow twin: a sum
    weight = np.exp(-0.5 * ((times_us - usual_us) / shared_us) ** 2)
    if weight.sum() * (times_us[1] - times_us[0]) < 1e-4 * shared_us:
        return  # supposed far outside of what was seen: the bounds alone are left
    mean_us = np.average(times_us, weights=weight)
    spread_us = np.sqrt(np.average((times_us - mean_us) ** 2, weights=weight))
    assert learnt.common_s * 1e6 == pytest.approx(spread_us, rel=0.01)
    assert learnt.usual_ns / 1000 == pytest.approx(mean_us, abs=0.11 * spread_us)


def shared_by(times_ns: list[int]) -> float:
    """Return which share of a rounding error reports at those times share, of a motor that makes 3.2 steps per ms."""
    epoch = Epoch(0, 0, Motion(1e6, 3200.0), 0.0)
    epoch.path = epoch.further = [Knot(0, 0.4, 3200.0, 0.0)]
    epoch.note_places(times_ns, 3.2)
    return epoch.alike


def test_a_rounding_is_shared_as_far_as_places_between_two_positions_are_alike() -> None:
    draw = random_stream(5, "places")
    assert shared_by([]) == 1.0
    assert shared_by([1_000_000 * n for n in range(50)]) == pytest.approx(1.0)
    assert shared_by([500_000 * n for n in range(50)]) == pytest.approx(0.0, abs=1e-9)
    scattered = [shared_by([int(at) for at in draw.uniform(0, 1e9, 25)]) for _ in range(400)]
    assert np.mean(scattered) == pytest.approx(1 / 25, rel=0.2)
