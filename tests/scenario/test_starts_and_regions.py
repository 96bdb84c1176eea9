"""Cycles that begin in focus, beyond it or at a limit; regions that cannot be focused on."""

from __future__ import annotations

import math

import pytest
from scenarios import assert_invariants, play

from elpd.errors import UsageError
from elpd.focus.settings import FocusRequest
from elpd.records import Outcome, Roi

REVERSAL_UM = {"tic": 10.0, "grbl": 12.0}
"""GRBL plans a jog before it moves, and tells where it is in steps of its status line."""


@pytest.mark.parametrize("direction", ["up", "down"])
@pytest.mark.parametrize("start_um", [0.0, 2.0, -2.0, 6.0, -6.0, 15.0, -15.0])
def test_a_cycle_that_begins_in_or_near_focus_ends_there_or_says_that_it_does_not_know(
    start_um: float, direction: str
) -> None:
    story = play(f"sim.start_um={start_um}", f"lens.first_direction={direction}", "sim.seed=5")
    assert_invariants(story)
    assert story.outcome in {Outcome.FOCUSED, Outcome.NO_CROSSING, Outcome.LOW_CONFIDENCE}
    times = story.truth.mechanism.motor_steps(story.history_ns())
    travelled_um = (times.max() - times.min()) * story.parts.um_per_step
    assert travelled_um <= story.settings.max_travel_um + 400.0


@pytest.mark.parametrize("board", ["tic", "grbl"])
@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_first_direction_is_turned_round_within_micrometres(seed: int, board: str) -> None:
    wrong = "down" if seed % 2 else "up"
    start_um = -200.0 if wrong == "down" else 200.0
    story = play(f"sim.start_um={start_um}", f"lens.first_direction={wrong}", f"sim.seed={seed}", f"sim.board={board}")
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert story.result.reversals == 1
    assert all(travel_um <= REVERSAL_UM[board] for travel_um in story.reversal_travels_um)
    assert_invariants(story)


@pytest.mark.parametrize("direction", ["up", "down"])
def test_from_a_limit_focus_is_found_in_the_only_direction_there_is(direction: str) -> None:
    start_um = -2200.0 if direction == "up" else 2200.0
    story = play(f"sim.start_um={start_um}", f"lens.first_direction={direction}", "focus.max_travel_um=2500.0")
    assert_invariants(story)
    assert story.outcome is Outcome.FOCUSED


@pytest.mark.parametrize(("start_um", "direction"), [(-295.0, "down"), (295.0, "up")])
def test_beside_a_limit_the_wrong_direction_ends_there(start_um: float, direction: str) -> None:
    story = play(f"sim.start_um={start_um}", f"lens.first_direction={direction}", "sim.travel_um=610.0", "sim.seed=2")
    assert_invariants(story)
    assert story.outcome is Outcome.FOCUSED


@pytest.mark.parametrize(
    "roi",
    [
        Roi(310, 10, 20, 20),
        Roi(10, 230, 20, 20),
        Roi(-4, 10, 20, 20),
        Roi(10, -4, 20, 20),
        Roi(400, 300, 20, 20),
        Roi(10, 10, 1, 1),
        Roi(10, 10, 0, 0),
        Roi(10, 10, 0, 20),
        Roi(10, 10, -5, 20),
        Roi(10, 10, 7, 7),
    ],
)
def test_a_region_that_is_none_is_refused_before_anything_moves(roi: Roi) -> None:
    story = play(request=FocusRequest(roi=roi))
    assert isinstance(story.error, UsageError)
    assert "ROI" in str(story.error)
    assert not story.moved
    assert not story.commands
    assert_invariants(story)


def test_a_region_that_is_no_number_is_refused_before_anything_moves() -> None:
    story = play(request=FocusRequest(roi=Roi(math.nan, 10, 20, 20)))  # type: ignore[arg-type]
    assert isinstance(story.error, UsageError)
    assert not story.moved


def test_a_region_without_texture_is_refused_before_anything_moves() -> None:
    story = play("sim.scene=flat", request=FocusRequest(roi=Roi(100, 80, 60, 60)))
    assert story.outcome is Outcome.NO_TEXTURE
    assert story.result is not None
    assert "structure" in story.result.reason
    assert not story.moved
    assert_invariants(story)


@pytest.mark.parametrize("board", ["tic", "grbl"])
@pytest.mark.parametrize("start_um", [-20.0, -6.0, 0.0, 12.0])
def test_a_lens_that_begins_in_focus_or_beside_it_ends_in_focus(start_um: float, board: str) -> None:
    story = play(f"sim.start_um={start_um}", f"sim.board={board}", "sim.seed=5")
    assert story.outcome is Outcome.FOCUSED
    assert_invariants(story)
    assert abs(story.errors["final_error_um"] or 0.0) < story.settings.depth_of_focus_um / 2
