"""Kinematics against a slow walk through time, and the trajectory model against boards whose truth is known."""

from __future__ import annotations

import math
import random
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lens_rigs import KINDS, SPEED_SPS, UM_PER_STEP, needs, rig

from elpd.errors import LensError
from elpd.motion.commanded import REST, Motion
from elpd.motion.kinematics import Piece, approach, in_segments, lay_out, ramp, state_at
from elpd.motion.readings import Timing
from elpd.motion.trajectory import Trajectory
from elpd.records import LensFlag, LensReport, StopMode
from elpd.units import HostNs

speeds = st.floats(-40_000, 40_000)
positions = st.floats(-8000, 8000)


def walk(pieces: tuple[Piece, ...], steps: float) -> tuple[list[float], list[float]]:
    """The slow twin: every piece in 1000 small steps of the mid-point rule."""
    xs, vs = [steps], [pieces[0].velocity_sps]
    for piece in pieces:
        if math.isinf(piece.duration_s):
            break
        dt, v = piece.duration_s / 1000, piece.velocity_sps
        for _ in range(1000):
            xs.append(xs[-1] + (v + 0.5 * piece.acceleration_sps2 * dt) * dt)
            v += piece.acceleration_sps2 * dt
            vs.append(v)
    return xs, vs


@given(steps=positions, velocity=speeds, target=positions, speed=st.floats(100, 40_000), a=st.floats(1e4, 1e6))
def test_an_approach_ends_at_rest_on_its_target(
    steps: float, velocity: float, target: float, speed: float, a: float
) -> None:
    pieces = approach(steps, velocity, target, speed, a)
    xs, vs = walk(pieces, steps)
    assert xs[-1] == pytest.approx(target, abs=1e-3)
    assert vs[-1] == pytest.approx(0.0, abs=1e-3)
    assert max(map(abs, vs)) <= max(speed, abs(velocity)) * (1 + 1e-9) + 1e-6
    assert all(abs(p.acceleration_sps2) <= a for p in pieces)
    assert all(p.duration_s >= 0 for p in pieces)
    for before, after in pairwise(pieces):
        assert before.velocity_sps + before.acceleration_sps2 * before.duration_s == pytest.approx(
            after.velocity_sps, abs=1e-3
        )
    assert state_at(lay_out(5, steps, pieces), 10**12)[0] == pytest.approx(target, abs=1e-3)


@given(velocity=speeds, target=speeds, a=st.floats(1e4, 1e6))
def test_a_ramp_arrives_at_its_speed(velocity: float, target: float, a: float) -> None:
    pieces = ramp(velocity, target, a)
    assert state_at(lay_out(0, 0.0, pieces), 10**11)[1] == target
    assert sum(p.duration_s for p in pieces[:-1]) == pytest.approx(abs(target - velocity) / a, abs=1e-9)


@given(target=st.floats(-8000, 8000), speed=st.floats(500, 40_000))
def test_segments_agree_with_the_profile_at_their_ends(target: float, speed: float) -> None:
    smooth = approach(0.0, 0.0, target, speed, 640_000.0)
    stepped = in_segments(smooth, 0.010)
    a, b = lay_out(0, 0.0, smooth), lay_out(0, 0.0, stepped)
    for knot in b:
        assert knot.steps == pytest.approx(state_at(a, knot.begin_ns)[0], abs=1e-2)
    assert all(p.acceleration_sps2 == 0.0 for p in stepped)


def report(steps: float, at_ms: float, *, moving: bool = False) -> LensReport:
    when = HostNs(round(at_ms * 1e6))
    return LensReport(steps, when, when, None, LensFlag.MOVING if moving else LensFlag.NONE)


def trajectory() -> Trajectory:
    return Trajectory(Timing(0, 0, quantum_steps=1.0))


def test_before_the_first_report_nothing_is_known() -> None:
    with pytest.raises(LensError, match="poll it first"):
        trajectory().position_at(HostNs(0))


def test_it_knows_only_as_far_back_as_its_memory() -> None:
    motor = Trajectory(Timing(0, 0, 1.0), history_s=1.0)
    motor.observe(report(0, 5000))
    assert motor.position_at(HostNs(4_500_000_000)).steps == 0.0
    with pytest.raises(LensError, match="remembered"):
        motor.position_at(HostNs(3_000_000_000))


def test_the_past_gets_better_when_a_late_report_comes() -> None:
    motor = trajectory()
    motor.observe(report(100, 0))
    motor.command(Motion(1e9, 10_000.0), 10_000_000, 2e6)
    motor.command(REST, 110_000_000, 0)
    before = motor.position_at(HostNs(60_000_000))
    # the motion began 1 ms late: everything on the way lies 10 steps back
    motor.observe(report(100 + 790, 90, moving=True))
    after = motor.position_at(HostNs(60_000_000))
    assert before.steps == pytest.approx(600, abs=0.5)
    assert after.steps == pytest.approx(590, abs=1.0)
    assert after.sigma_steps < before.sigma_steps / 5
    assert motor.position_at(HostNs(10**9)).steps == pytest.approx(1090, abs=1.0)


def test_an_absolute_target_does_not_depend_on_when_the_motion_began() -> None:
    motor = trajectory()
    motor.observe(report(0, 0))
    motor.command(Motion(1e6, target_steps=500.0, speed_sps=10_000.0), 10_000_000, 5e6)
    moving, resting = motor.position_at(HostNs(40_000_000)), motor.position_at(HostNs(10**9))
    assert moving.sigma_steps > 20
    assert resting.steps == pytest.approx(500.0)
    assert resting.sigma_steps < 0.2
    assert motor.at_rest_from() == pytest.approx(10e6 + 60e6, rel=1e-3)


def test_a_rounding_that_is_the_same_each_time_is_not_averaged_away() -> None:
    motor = trajectory()
    motor.observe(report(0, 0))
    motor.command(Motion(math.inf, 10_000.0), 10_000_000, 1e6)
    for n in range(1, 40):  # every 4 ms it is told where it was 0.45 steps ago: no speed tells more
        motor.observe(report(40 * n - 0.45, 10 + 4 * n, moving=True))
    asked = motor.position_at(HostNs(90_000_000))
    assert abs(asked.steps - 800.0) < 1.96 * asked.sigma_steps
    assert asked.sigma_steps < 0.5, "nor is it taken for more than it is"


def test_a_command_that_may_have_begun_early_makes_the_moments_before_it_vague() -> None:
    motor = trajectory()
    motor.observe(report(0, 0))
    motor.command(Motion(math.inf, 10_000.0), 10_000_000, 0.0)
    motor.command(REST, 110_000_000, 3e6)
    sure, vague = motor.position_at(HostNs(100_000_000)), motor.position_at(HostNs(109_000_000))
    assert sure.sigma_steps < 0.5
    assert vague.sigma_steps == pytest.approx(10_000 * (6.0 - 1.0) / 1000 / 2, rel=0.05)
    motor.observe(report(970, 130))  # it had stopped 3 ms early
    assert motor.position_at(HostNs(109_000_000)).steps == pytest.approx(970, abs=1.0)


def test_the_same_calls_give_the_same_bits() -> None:
    def once() -> list[float]:
        made = rig("grbl", seed=5)
        made.open()
        made.lens.run(SPEED_SPS, made.soon(300))
        estimates: list[float] = []
        made.live(200, lambda: (made.poll(), estimates.append(made.lens.position_at(made.clock.now_ns()).steps)))
        return estimates

    assert once() == once()


@pytest.mark.parametrize(
    ("kind", "live_rms_um", "late_rms_um", "rest_um"),
    [
        ("tic", 0.1, 0.1, 0.1),
        ("grbl", 1.0, 0.4, 0.6),
        ("tmcl", 0.4, 0.3, 0.1),
        ("zaber", 0.4, 0.3, 0.1),
        ("scf4", 0.4, 0.4, 0.1),
        ("avr", 0.7, 0.6, 0.1),
    ],
)
def test_the_truth_lies_within_two_sigma(kind: str, live_rms_um: float, late_rms_um: float, rest_um: float) -> None:
    assert kind in KINDS
    live: list[float] = []
    late: list[float] = []
    rest: list[float] = []
    covered: list[bool] = []
    widths: list[float] = []
    for seed in range(10):
        made = rig(kind, seed=seed)
        made.open()
        made.clock.pass_ms(1.0 + 0.37 * seed)
        asked: list[int] = []
        given_then = []

        def ask(made=made, asked=asked, given_then=given_then) -> None:  # noqa: ANN001
            made.poll()
            asked.append(made.clock.now_ns())
            given_then.append(made.lens.position_at(made.clock.now_ns()))

        way = 1 if seed % 2 else -1
        made.lens.run(way * SPEED_SPS, made.soon(600))
        made.live(70 + 1.3 * seed, ask)
        made.lens.run(-way * SPEED_SPS, made.soon(900))
        made.live(260, ask)
        stopped = made.clock.now_ns()
        made.lens.stop(StopMode.ABRUPT if made.lens.capabilities.abrupt_stop else StopMode.RAMPED)
        made.live(180, ask)

        truth = made.truth(asked)
        moving = np.abs(made.truth([t + 1000 for t in asked]) - truth) > 1e-4
        for estimates, errors in ((given_then, live), (_again(made, asked), late)):
            gap = np.array([e.steps for e in estimates]) - truth
            sigma = np.array([e.sigma_steps for e in estimates])
            covered.extend(np.abs(gap) < 2 * sigma)
            errors.extend(gap[moving])
            widths.extend(sigma[moving])
        at_rest = np.array(asked) > stopped + 150e6
        rest.extend((np.array([e.steps for e in given_then]) - truth)[at_rest])

    def rms_um(errors: list[float]) -> float:
        return float(np.sqrt(np.mean(np.square(errors)))) * UM_PER_STEP

    print(  # noqa: T201  (the measured widths are worth seeing)
        f"\n{kind}: live {rms_um(live):.3f} um rms, late {rms_um(late):.3f}, rest {rms_um(rest):.3f}; within 2 sigma "
        f"{np.mean(covered):.4f}; median sigma moving {np.median(widths) * UM_PER_STEP:.3f} um"
    )
    assert np.mean(covered) >= 0.95
    assert rms_um(live) <= live_rms_um
    assert rms_um(late) <= late_rms_um
    assert max(map(abs, rest)) * UM_PER_STEP <= rest_um


@pytest.mark.parametrize("kind", KINDS)
@needs("stops", "the controller takes no command while it moves; test_theia_board has its moves")
def test_it_stays_honest_under_any_commands(kind: str) -> None:
    covered: list[bool] = []
    for seed in range(5):
        choose = random.Random(seed)
        made = rig(kind, seed=seed, start_um=1250.0)
        made.open()
        asked: list[int] = []
        given_then = []

        def ask(made=made, asked=asked, given_then=given_then) -> None:  # noqa: ANN001
            made.poll()
            asked.append(made.clock.now_ns())
            given_then.append(made.lens.position_at(made.clock.now_ns()))

        for _ in range(8):
            what = choose.choice(["run", "run", "move", "stop"])
            if what == "run":
                way = choose.choice([-1, 1])
                speed_sps = min(choose.uniform(2000, 20_000), made.lens.limits.max_speed_sps)
                made.lens.run(way * speed_sps, made.soon(choose.uniform(50, 400)))
            elif what == "move":
                made.lens.move_to(
                    choose.randint(500, 7500), min(choose.uniform(2000, 30_000), made.lens.limits.max_speed_sps)
                )
            else:
                made.lens.stop(StopMode.RAMPED)
            made.live(choose.uniform(5, 250), ask)
        truth = made.truth(asked)
        assert -1e-6 <= truth.min() <= truth.max() <= 8000 + 1e-6, "limits always hold"
        for estimates in (given_then, _again(made, asked)):
            gap = np.array([e.steps for e in estimates]) - truth
            covered.extend(np.abs(gap) < 2 * np.array([e.sigma_steps for e in estimates]))
    assert np.mean(covered) >= 0.95


def _again(made, asked):  # noqa: ANN001, ANN202
    return [made.lens.position_at(HostNs(t)) for t in asked]
