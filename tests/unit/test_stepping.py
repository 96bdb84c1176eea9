"""A lens that cannot be stopped, driven in moves: none is interrupted, a stop is one away."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lens_rigs import SPEED_SPS, Rig, open_rig

from elpd.motion.stepping import SteppingLens
from elpd.records import StopMode
from elpd.units import Steps

MOVE_STEPS = 100


def stepping() -> tuple[Rig, SteppingLens]:
    made = open_rig("theia")
    return made, SteppingLens(made.lens, made.clock, MOVE_STEPS, SPEED_SPS)


def live(made: Rig, lens: SteppingLens, ms: float) -> None:
    made.live(ms, lens.poll)


def test_it_says_that_it_stops_and_how_long_that_takes() -> None:
    _, lens = stepping()
    told = lens.capabilities
    assert told.stop_on_command
    assert not told.abrupt_stop
    longest_ms = 1000.0 * MOVE_STEPS / min(SPEED_SPS, lens.limits.max_speed_sps)
    assert told.stop_onset_ms + 2 * told.stop_onset_sigma_ms >= longest_ms


def test_a_run_goes_on_move_by_move_until_it_is_stopped_at_the_end_of_one() -> None:
    made, lens = stepping()
    begin = made.rotor
    lens.run(SPEED_SPS, made.soon(5000))
    live(made, lens, 100)
    assert made.rotor > begin + 2 * MOVE_STEPS
    before = made.rotor
    lens.stop(StopMode.RAMPED)
    live(made, lens, 200)
    assert not made.moving
    assert before <= made.rotor <= before + MOVE_STEPS + 0.01
    moves = (made.rotor - begin) / MOVE_STEPS
    assert moves == pytest.approx(round(moves), abs=0.001)


def test_a_reversal_waits_for_the_end_of_a_move_and_for_no_more() -> None:
    made, lens = stepping()
    lens.run(SPEED_SPS, made.soon(5000))
    live(made, lens, 50)
    before = made.rotor
    lens.run(-SPEED_SPS, made.soon(5000))
    furthest = before
    for _ in range(100):
        live(made, lens, 1)
        furthest = max(furthest, made.rotor)
    assert furthest <= before + MOVE_STEPS + 0.01
    assert made.rotor < before


def test_a_place_is_gone_to_in_one_move_after_the_one_under_way() -> None:
    made, lens = stepping()
    lens.run(SPEED_SPS, made.soon(5000))
    live(made, lens, 50)
    lens.move_to(Steps(3000), SPEED_SPS)
    live(made, lens, 500)
    assert made.rotor == pytest.approx(3000, abs=0.01)
    assert lens.position_at(made.clock.now_ns()).steps == pytest.approx(3000)


def test_it_is_never_reported_at_rest_between_two_moves() -> None:
    made, lens = stepping()
    lens.run(SPEED_SPS, made.soon(60))
    rests = []
    for _ in range(200):
        made.live(1, lambda: None)
        report = lens.poll()
        if report is not None and not report.moving:
            rests.append(made.clock.now_ns())
    assert not made.moving
    assert rests
    assert made.motor.velocity_at(rests[0]) == 0.0
    live(made, lens, 100)
    assert made.rotor == pytest.approx(lens.position_at(made.clock.now_ns()).steps)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(["up", "down", "stop", "place"]), st.integers(1, 120)), max_size=12))
def test_no_story_leads_beyond_the_limits_or_into_a_move_that_is_interrupted(story: list[tuple[str, int]]) -> None:
    made, lens = stepping()
    for act, ms in story:
        if act == "stop":
            lens.stop(StopMode.ABRUPT)
        elif act == "place":
            lens.move_to(Steps(3200 + 7 * ms), SPEED_SPS)
        else:
            lens.run(SPEED_SPS if act == "up" else -SPEED_SPS, made.soon(3000))
        live(made, lens, ms)
        assert lens.limits.min_steps <= made.rotor <= lens.limits.max_steps
    lens.stop(StopMode.ABRUPT)
    live(made, lens, 500)
    assert not made.moving
    assert lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=0.01)
