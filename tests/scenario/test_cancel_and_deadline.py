"""Whoever asks for an end gets one, in every phase: the stop leaves at once, the lens goes to its declared place."""

from __future__ import annotations

import pytest
from scenarios import Event, Story, assert_invariants, play

from elpd.records import Outcome

MOMENTS = [
    ("settle_before", 1.0),
    ("expose", 10.0),
    ("expose", 60.0),
    ("choose", 5.0),
    ("sweep", 0.5),
    ("sweep", 20.0),
    ("sweep", 45.0),
    ("stop", 2.0),
    ("return", 5.0),
    ("return", 20.0),
]


@pytest.mark.parametrize("board", ["tic", "grbl"])
@pytest.mark.parametrize(("phase", "after_ms"), MOMENTS)
def test_a_cycle_is_cancelled_in_any_phase(board: str, phase: str, after_ms: float) -> None:
    story = play(f"sim.board={board}", "sim.seed=3", events=[Event(phase, after_ms, Story.cancel)])
    assert story.outcome is Outcome.CANCELLED
    assert story.cancelled_ns is not None
    assert_invariants(story)


@pytest.mark.parametrize("place", ["hold", "start", "preset"])
def test_after_a_cancelled_sweep_the_lens_is_where_it_was_declared_to_be(place: str) -> None:
    story = play(
        "sim.seed=3",
        f"focus.on_failure={place}",
        "focus.preset_um=1000.0",
        events=[Event("sweep", 30.0, Story.cancel)],
    )
    assert story.outcome is Outcome.CANCELLED
    assert_invariants(story)
    assert story.result is not None
    if place == "hold":
        moves = [command for command in story.commands if command.name == "move_to"]
        assert not moves


@pytest.mark.parametrize("deadline_ms", [5.0, 60.0, 115.0, 150.0, 190.0, 210.0])
def test_a_deadline_ends_the_cycle_wherever_it_is(deadline_ms: float) -> None:
    story = play("sim.seed=3", f"focus.deadline_ms={deadline_ms}")
    assert story.outcome is Outcome.DEADLINE
    assert_invariants(story)
    # going back to the start takes a while, but no new search begins
    assert story.result is not None
    assert story.result.duration_ms < deadline_ms + 250.0
