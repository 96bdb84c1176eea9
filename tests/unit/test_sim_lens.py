"""The simulated lens: exact motion, and each imperfection by itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from elpd_drivers.sim.lens import LensMechanics, SimulatedLens
from hypothesis import given
from hypothesis import strategies as st

from elpd.motion.kinematics import Piece

MS = 1_000_000
A = 640_000.0
V = 12_800.0
QUIET = LensMechanics(ring_fraction=0.0)


def at(lens: SimulatedLens, ms: float) -> float:
    return float(lens.carriage_um(np.array([round(ms * MS)], dtype=np.int64))[0])


def test_it_stands_where_it_was_put() -> None:
    lens = SimulatedLens(start_um=700.0)
    assert at(lens, 0.0) == 700.0
    assert lens.rest_from_ns() is not None
    with pytest.raises(ValueError, match="outside the travel"):
        SimulatedLens(start_um=-1.0)


def test_a_trapezoid_is_exact() -> None:
    lens = SimulatedLens(LensMechanics(backlash_um=0.0, ring_fraction=0.0), start_um=1000.0)
    lens.move_to(0, 3200 + 1600, V, A)
    times = np.array([0, 10, 20, 60, 300], dtype=np.int64) * MS
    steps = lens.motor_steps(times) - 3200
    assert steps == pytest.approx([0, 32, 128, 128 + 512, 1600], abs=1e-6)
    assert lens.carriage_um(times) == pytest.approx(1000 + steps * 0.3125, abs=1e-6)
    assert lens.carriage_um(times.reshape(5, 1)).shape == (5, 1)


def test_a_halt_ends_on_a_whole_step() -> None:
    lens = SimulatedLens(QUIET)
    lens.set_velocity(0, V, A)
    lens.halt(round(50.0333 * MS))
    rest = lens.pulses_at(100 * MS)
    assert rest == pytest.approx(round(rest), abs=1e-6)
    assert 0 <= rest - lens.pulses_at(round(50.0333 * MS)) <= 1


@pytest.mark.parametrize("us", [0, 1, 30, 200, 800, 3000])
def test_a_motor_that_has_just_set_out_is_at_rest_at_once_when_it_is_halted(us: int) -> None:
    lens = SimulatedLens(QUIET, start_um=1000.0)
    lens.set_velocity(0, V, A)
    lens.halt(us * 1000)
    assert lens.velocity_at(us * 1000 + 5 * MS) == 0.0
    assert lens.pulses_at(us * 1000 + 5 * MS) % 1.0 == pytest.approx(0.0, abs=1e-6)
    assert 0.0 <= lens.pulses_at(100 * MS) - 3200.0 <= lens.pulses_at(us * 1000) - 3200.0 + 1.0


def test_backlash_is_a_play_that_must_be_crossed() -> None:
    lens = SimulatedLens(QUIET, start_um=1000.0)
    lens.move_to(0, 3264, V, A)
    assert at(lens, 100) == pytest.approx(1020 - 2)
    lens.move_to(100 * MS, 3200, V, A)
    assert at(lens, 200) == pytest.approx(1000 + 2)
    lens.move_to(200 * MS, 3206, V, A)
    assert at(lens, 300) == pytest.approx(1002), "inside the play nothing moves"
    lens.move_to(300 * MS, 3264, V, A)
    assert at(lens, 400) == pytest.approx(1018), "and the same side gives the same place"


def test_an_abrupt_stop_rings_and_dies_away() -> None:
    lens = SimulatedLens(start_um=500.0)
    lens.set_velocity(0, V, A)
    lens.halt(100 * MS)
    times = np.arange(100 * MS, 160 * MS, 50_000, dtype=np.int64)
    swing = lens.carriage_um(times) - at(lens, 300)
    after = swing[times > 100.2 * MS]
    assert 0.3 <= np.max(np.abs(after)) <= 1.0
    assert np.max(np.abs(swing[times > 125 * MS])) < 0.05
    crossings = np.flatnonzero(np.diff(np.sign(after[:250])))
    assert np.diff(crossings[:3]).mean() * 50e-6 == pytest.approx(1 / 300, rel=0.1)
    ramped = SimulatedLens(start_um=500.0)
    ramped.set_velocity(0, V, A)
    ramped.set_velocity(100 * MS, 0.0, A)
    assert at(ramped, 121) == pytest.approx(at(ramped, 300), abs=0.01)


@given(st.lists(st.tuples(st.integers(1, 40), st.integers(-30, 30)), min_size=1, max_size=30), st.integers(1, 400))
def test_the_swings_of_many_jumps_add_up(jumps: list[tuple[int, int]], apart_us: int) -> None:
    mechanics = LensMechanics(backlash_um=0.0, travel_um=1e6)
    swinging, quiet = (SimulatedLens(one, start_um=5e5) for one in (mechanics, replace(mechanics, ring_fraction=0.0)))
    now_ns, before, made = 0, 0.0, []
    for wait, pace in jumps:
        now_ns += wait * apart_us * 1000
        velocity = 400.0 * pace
        for lens in (swinging, quiet):
            lens.follow(now_ns, (Piece(math.inf, velocity, 0.0),))
        made.append((now_ns, velocity - before))
        before = velocity
    times = np.arange(-MS, now_ns + 30 * MS, 70_000, dtype=np.int64)
    expected = np.zeros(times.size)
    omega = 2 * math.pi * mechanics.ring_hz
    for at_ns, jump in made:
        swing_um = mechanics.ring_fraction * jump * mechanics.um_per_step / omega
        since_s = np.maximum(times - at_ns, 0) / 1e9
        expected -= swing_um * np.sin(omega * since_s) * np.exp(-1e3 * since_s / mechanics.ring_decay_ms)
    swing = swinging.carriage_um(times) - quiet.carriage_um(times)
    assert swing == pytest.approx(expected, abs=1e-8)
    alone = [float(swinging.carriage_um(times[i : i + 1])[0]) for i in range(0, times.size, 37)]
    assert alone == swinging.carriage_um(times)[::37].tolist(), "asking often or rarely gives the same answer"


def test_end_stops_lose_steps_silently_and_let_go_at_once() -> None:
    lens = SimulatedLens(QUIET, start_um=100.0)
    lens.move_to(0, -1000.0, V, A)
    assert lens.rotor_at(400 * MS) == -64.0
    assert lens.pulses_at(400 * MS) == pytest.approx(-1000)
    lens.move_to(400 * MS, -900.0, V, A)
    assert lens.rotor_at(600 * MS) == pytest.approx(36.0)


def test_limit_switches_are_foreseen_to_the_nanosecond() -> None:
    lens = SimulatedLens(QUIET, start_um=100.0)
    lens.set_velocity(0, -V, A)
    when = lens.reaches(-0.5, 0, upwards=False)
    assert when is not None
    assert lens.rotor_at(when) < -0.5 <= lens.rotor_at(when - 3)
    assert lens.reaches(9000.0, 0, upwards=True) is None


def test_a_stuck_lens_does_not_move_and_a_released_one_does() -> None:
    lens = SimulatedLens(QUIET)
    lens.set_velocity(0, V, A)
    before = lens.rotor_at(50 * MS)
    lens.stick(50 * MS)
    assert lens.rotor_at(100 * MS) == before
    assert lens.pulses_at(100 * MS) > before + 600
    lens.release(100 * MS)
    assert lens.rotor_at(150 * MS) == pytest.approx(before + 640)


def test_slipping_leaves_the_rotor_behind_for_good() -> None:
    lens = SimulatedLens(QUIET, start_um=1000.0)
    lens.set_velocity(0, V, A)
    lens.slip(50 * MS, 64.0)
    lens.move_to(60 * MS, 5000.0, V, A)
    assert lens.pulses_at(500 * MS) == pytest.approx(5000)
    assert lens.rotor_at(500 * MS) == pytest.approx(5000 - 64)


def test_above_its_stall_speed_the_rotor_stands_until_the_pulses_stop() -> None:
    lens = SimulatedLens(LensMechanics(stall_sps=10_000.0), start_um=1000.0)
    lens.set_velocity(0, V, A)
    lens.set_velocity(100 * MS, 5000.0, A)
    assert lens.rotor_at(200 * MS) < 3200 + 140
    lens.halt(200 * MS)
    stood = lens.rotor_at(300 * MS)
    lens.set_velocity(300 * MS, 5000.0, A)
    assert lens.rotor_at(400 * MS) > stood + 400


def test_microstep_error_repeats_with_the_electrical_cycle() -> None:
    lens = SimulatedLens(LensMechanics(microstep_error_um=0.5, backlash_um=0.0), start_um=0.0)
    lens.set_velocity(0, 6400.0, 1e9)
    times = np.arange(100 * MS, 300 * MS, MS, dtype=np.int64)
    error = lens.carriage_um(times) - lens.motor_steps(times) * 0.3125
    assert np.max(np.abs(error)) == pytest.approx(0.5, abs=0.02)
    assert error[:40] == pytest.approx(error[40:80], abs=1e-6)


commands = st.lists(
    st.tuples(st.integers(1, 60), st.sampled_from(["velocity", "move", "halt"]), st.floats(-1.0, 1.0)), max_size=8
)


@given(commands=commands)
def test_asking_does_not_change_the_answers(commands: list[tuple[int, str, float]]) -> None:
    asked, left_alone = SimulatedLens(), SimulatedLens()
    now = 0
    for wait_ms, what, value in commands:
        for lens in (asked, left_alone):
            if what == "velocity":
                lens.set_velocity(now, value * V, A)
            elif what == "move":
                lens.move_to(now, 4000 + value * 4200, V, A)
            else:
                lens.halt(now)
        asked.carriage_um(np.arange(now, now + wait_ms * MS, MS, dtype=np.int64))
        asked.advance(now)
        now += wait_ms * MS
    times = np.arange(0, now + 500 * MS, 3 * MS, dtype=np.int64)
    assert np.array_equal(asked.carriage_um(times), left_alone.carriage_um(times))
    rotor = np.array([asked.rotor_at(int(t)) for t in times])
    assert np.max(np.abs(np.diff(rotor))) <= V * 1.01 * 3e-3 + 1e-6, "the rotor never jumps"
    assert -64.001 <= rotor.min() <= rotor.max() <= 8064.001
    carriage = asked.carriage_um(times) / 0.3125
    assert np.max(np.abs(carriage - rotor)) <= (2.0 + 3.0) / 0.3125, "never further apart than play and ringing"


def test_the_past_is_remembered_for_seconds_and_then_forgotten() -> None:
    lens = SimulatedLens(QUIET, start_um=1000.0, history_s=2.0)
    for index in range(400):
        lens.move_to(index * 20 * MS, 3200 + (index % 2) * 10, V, A)
    recent = lens.motor_steps(np.arange(6500 * MS, 8000 * MS, MS, dtype=np.int64))
    assert recent.min() >= 3199.9
    assert len(lens._stretches) < 600
