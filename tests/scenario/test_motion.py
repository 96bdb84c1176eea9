"""Scenes that move: the direction is found all the same, and one pass over focus is not trusted where it cannot be."""

from __future__ import annotations

import numpy as np
import pytest
from scenarios import Story, assert_invariants, play

from elpd.records import Outcome

DEPTH_OF_FOCUS_UM = 6.0


def shown(motion: str, seed: int, start_um: float = -200.0) -> Story:
    story = play(f"sim.motion={motion}", "sim.camera=davis346", f"sim.seed={seed}", f"sim.start_um={start_um}")
    assert_invariants(story)
    return story


@pytest.mark.parametrize("motion", ["violent", "shake"])
@pytest.mark.parametrize("start_um", [-200.0, 200.0])
def test_a_moving_scene_is_focused_or_refused_and_the_first_verdict_is_right(motion: str, start_um: float) -> None:
    for seed in (1, 2):
        story = shown(motion, seed, start_um)
        assert story.outcome in {Outcome.FOCUSED, Outcome.LOW_CONFIDENCE}
        if story.outcome is Outcome.FOCUSED:
            final_um = story.errors["final_error_um"]
            assert final_um is not None
            assert abs(final_um) <= DEPTH_OF_FOCUS_UM
        first = story.named("sweep")[0]
        away = (first["sign"] > 0) == (start_um > 0)
        assert (first["end"] == "behind") == away
        assert story.result is not None
        assert story.result.reversals == int(away)


def test_where_one_pass_is_not_enough_a_second_is_made_and_its_time_is_told() -> None:
    story = shown("shake", 1)
    assert story.result is not None
    assert story.result.details["method"] == "two_crossings"
    told_ms = {phase.name: phase.ms for phase in story.result.phases}
    assert story.phases.index("stop") < story.phases.index("recross")
    assert told_ms["recross"] > 20.0


@pytest.mark.parametrize("start_um", [-200.0, 200.0])
def test_a_cross_again_is_the_way_back_and_ends_where_focus_has_been_seen_to_pass(start_um: float) -> None:
    """From 200 um away: the ramp and 50 ms of sweep, the turn, 20 ms back over focus, 20 ms to it."""
    story = shown("violent", 3, start_um)
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert story.result.details["method"] == "two_crossings"
    told_ms = {phase.name: phase.ms for phase in story.result.phases}
    assert told_ms["recross"] < 60.0
    if not story.result.reversals:
        assert sum(told_ms[name] for name in ("sweep", "stop", "recross", "return", "verify")) < 160.0


def test_a_play_that_was_measured_is_what_two_passes_allow_for() -> None:
    """Half of what the rig has beyond the middle of what it may have, 4 um and 0 to 6, is what they were short by."""
    rig = ("sim.motion=violent", "sim.camera=davis346", "sim.seed=3", "sim.start_um=-200")
    told, measured = (play(*rig, *more).result for more in ((), ("lens.measured_play_um=[4.0, 0.1]",)))
    assert told is not None
    assert measured is not None
    assert told.focus_um is not None
    assert measured.focus_um is not None
    assert measured.details["method"] == "two_crossings"
    assert abs(measured.focus_um - told.focus_um) == pytest.approx(0.5 * (4.0 - 3.0), abs=0.1)
    assert measured.sigma_um < told.sigma_um


def test_a_doubtful_answer_is_looked_at_again_and_a_scene_that_lies_elsewhere_then_moves() -> None:
    story = shown("violent", 902)
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert story.result.details["method"] == "two_crossings"
    begun = next(fields for fields in story.named("one pass"))
    assert begun["sigma_um"] > story.settings.max_sigma_dof * story.settings.depth_of_focus_um


def test_a_clear_hill_is_believed_however_much_the_hand_has_shuffled() -> None:
    story = play("sim.camera=evk4", "sim.motion=shake", "sim.seed=900", "sim.start_um=200", "sim.scene=brick")
    assert_invariants(story)
    assert story.outcome is Outcome.FOCUSED


def test_where_one_pass_is_enough_no_second_is_made() -> None:
    once = "sim.camera=evk4", "sim.seed=1", "sim.start_um=-200"
    assert "recross" in play(*once).phases, "it knows focus better"
    # A second pass knows focus to half the play, of which the bound counts.
    assert "recross" not in play(*once, "lens.backlash_um=10").phases
    story = play(*once, "focus.cross_again=needed")
    assert_invariants(story)
    assert story.outcome is Outcome.FOCUSED
    assert "recross" not in story.phases
    assert story.result is not None
    assert story.result.details["method"] != "two_crossings"


def test_the_cross_again_leads_back_over_focus_far_enough_to_see_it_passed() -> None:
    story = shown("violent", 2)  # of the first the sensor at rest sees no motion
    assert "recross" in story.phases
    assert story.result is not None
    sign = story.result.details["sweep_sign"]
    places_um = story.truth.mechanism.motor_steps(story.history_ns()) * story.truth.mechanism.mechanics.um_per_step
    focus_um = story.truth.focus_um(sign)
    assert focus_um is not None
    ahead_um = sign * (places_um - focus_um)
    over = int(np.argmax(ahead_um > 0.0))
    assert ahead_um[over:].min() < -2.0 * DEPTH_OF_FOCUS_UM, "a way back that is no pass turns at the play"
