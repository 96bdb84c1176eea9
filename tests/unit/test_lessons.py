"""The filter that learns what a motion does, against plain matrices; how far off a motion may be and be believed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from elpd_drivers.lenses.line import Trouble
from elpd_drivers.lenses.motor import CONFIRMATIONS, Motor
from hypothesis import given
from hypothesis import strategies as st

from elpd.motion.commanded import Motion
from elpd.motion.lessons import Lessons, Sensitivity
from elpd.motion.readings import Timing
from elpd.motion.trajectory import HELD_UP_NS, Trajectory
from elpd.records import LensFlag, LensReport
from elpd.units import HostNs

TIMING = Timing(reply_ns=200_000, reply_sigma_ns=100_000, quantum_steps=1.0)
SPEED_SPS, ACCELERATION_SPS2 = 4000.0, 640_000.0
HELD_UP_MS = HELD_UP_NS / 1e6
small = st.floats(-3.0, 3.0)


def report(steps: float, at_ms: float, *, moving: bool = True) -> LensReport:
    when = HostNs(round(at_ms * 1e6))
    flags = LensFlag.MOVING if moving else LensFlag.NONE
    return LensReport(steps, when, HostNs(when + 400_000), None if moving else 0.0, flags)


def under_way(timing: Timing = TIMING) -> Trajectory:
    """Return the model of a long move that took effect at 10 ms."""
    trajectory = Trajectory(timing)
    trajectory.begin(report(0.0, 0.0, moving=False))
    motion = Motion(ACCELERATION_SPS2, 0.0, 20_000.0, SPEED_SPS)
    trajectory.command(motion, 10_000_000, 100_000)
    return trajectory


@given(st.lists(st.tuples(small, small, small, small, st.floats(0.1, 10.0)), min_size=1, max_size=8))
def test_it_is_a_kalman_filter(taught: list[tuple[float, float, float, float, float]]) -> None:
    lessons = Lessons.supposed(2.0, 0.5, 0.7, 0.3)
    x, c = np.array([0.0, 0.5, 0.0]), np.diag([2.0, 0.49, 0.09])
    for o, d, p, surprise, noise in taught:
        h = np.array([o, d, p])
        gain = c @ h / (h @ c @ h + noise)
        assert lessons.variance(Sensitivity(o, d, p)) == pytest.approx(h @ c @ h, rel=1e-6, abs=1e-9)
        lessons.correct(surprise, Sensitivity(o, d, p), noise)
        x, c = x + gain * surprise, c - np.outer(gain, h @ c)
        assert [lessons.offset, lessons.delay, lessons.pace] == pytest.approx(x.tolist(), rel=1e-6, abs=1e-9)
        assert lessons.shift(Sensitivity(o, d, p)) == pytest.approx(h @ x, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("share", [-1e-3, 1e-3])
def test_a_motor_that_keeps_another_pace_is_followed_and_rests_on_its_target(share: float) -> None:
    sure = under_way()
    paced = under_way(Timing(200_000, 100_000, 1.0, pace_sigma=1e-3))
    begun_ms = 10.0 + SPEED_SPS / ACCELERATION_SPS2 * 500.0
    covered = {id(sure): 0, id(paced): 0}
    for at_ms in range(30, 3000, 6):
        steps = SPEED_SPS * (1 + share) * (at_ms + 0.2 - begun_ms) / 1e3
        for model in (sure, paced):
            model.observe(report(round(steps), at_ms))
            estimate = model.position_at(HostNs(round((at_ms + 0.2) * 1e6)))
            covered[id(model)] += abs(estimate.steps - steps) <= 1.96 * estimate.sigma_steps
    assert covered[id(paced)] >= 0.95 * 495
    assert covered[id(sure)] < 0.5 * 495, "without it the model is too sure of itself"
    assert paced.position_at(HostNs(9_000_000_000)).steps == pytest.approx(20_000, abs=0.5)


@pytest.mark.parametrize("off_ms", [-0.9 * HELD_UP_MS, 0.9 * HELD_UP_MS])
def test_a_motion_held_up_for_less_than_the_silence_limit_goes_on(off_ms: float) -> None:
    model = under_way()
    here = model.position_at(HostNs(500_200_000)).steps + SPEED_SPS * off_ms / 1e3
    assert model.resume(report(here, 500.0))
    later = model.position_at(HostNs(600_200_000))
    assert later.steps == pytest.approx(here + 0.1 * SPEED_SPS, abs=2.0)
    assert model.position_at(HostNs(9_000_000_000)).steps == pytest.approx(20_000, abs=0.5)


@pytest.mark.parametrize("off_ms", [-1.1 * HELD_UP_MS, 1.1 * HELD_UP_MS, -math.inf])
def test_a_position_from_further_along_is_no_motion_that_was_held_up(off_ms: float) -> None:
    model = under_way()
    before = model.position_at(HostNs(500_200_000))
    here = before.steps + SPEED_SPS * off_ms / 1e3 if math.isfinite(off_ms) else -400.0
    assert not model.resume(report(here, 500.0))
    assert model.position_at(HostNs(500_200_000)) == before


@pytest.mark.parametrize(("back_ms", "believed"), [(0.8 * HELD_UP_MS, True), (3.0 * HELD_UP_MS, False)])
def test_a_count_that_jumps_back_is_a_fault_where_nothing_can_have_held_it_up(back_ms: float, believed: bool) -> None:  # noqa: FBT001
    motor = Motor(TIMING)
    motor.begin(report(0.0, 0.0, moving=False))
    motor.command(Motion(ACCELERATION_SPS2, 0.0, 20_000.0, SPEED_SPS), 10_000_000, 100_000)
    for at_ms in range(30, 500, 6):
        assert motor.believes(report(motor.state_at(round((at_ms + 0.2) * 1e6))[0], at_ms))
    jumped = [report(SPEED_SPS * (500.0 + 6 * n - 13.0 - back_ms) / 1e3, 500.0 + 6 * n) for n in range(CONFIRMATIONS)]
    if believed:
        assert [motor.believes(one) for one in jumped] == [False, False, True]
        return
    assert not any(motor.believes(one) for one in jumped[:-1])
    with pytest.raises(Trouble, match="times in a row"):
        motor.believes(jumped[-1])


@pytest.mark.parametrize(("late_ms", "believed"), [(60.0, True), (150.0, False)])
def test_a_stop_that_bites_late_is_the_motion_before_it(late_ms: float, believed: bool) -> None:  # noqa: FBT001
    model = under_way()
    model.command(Motion(ACCELERATION_SPS2), 1_000_000_000, 1_000_000)
    begun_ms = 10.0 + SPEED_SPS / ACCELERATION_SPS2 * 500.0
    here = SPEED_SPS * (1000.2 + late_ms - begun_ms) / 1e3
    assert model.resume(report(here, 1000.0 + late_ms)) is believed
