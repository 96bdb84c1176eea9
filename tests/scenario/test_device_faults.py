"""Broken machinery: a latched error with a name, and the strongest stop, in time."""

from __future__ import annotations

import pytest
from elpd_drivers.sim.boards.tic import TicBoard
from scenarios import CAMERA_STOP_LIMIT_MS, Event, Story, assert_invariants, play

from elpd.errors import CameraError, LensError

SWEEP_FROM_S = 0.13
CAMERA_BATCH_MS = 3.0
"""What was on its way when the camera fell silent still arrives, and one turn of the loop passes."""


@pytest.mark.parametrize("board", ["tic", "grbl"])
@pytest.mark.parametrize("fault", ["camera_vanishes_at_s", "camera_silent_from_s"])
@pytest.mark.parametrize("at_s", [0.0, 0.02, 0.09, SWEEP_FROM_S + 0.01, SWEEP_FROM_S + 0.04, SWEEP_FROM_S + 0.06])
def test_a_camera_that_is_lost_stops_the_lens(board: str, fault: str, at_s: float) -> None:
    story = play(f"sim.board={board}", f"sim.{fault}={at_s}", "sim.seed=3")
    assert isinstance(story.error, CameraError)
    assert_invariants(story)
    if story.phases[-1] == "sweep":
        assert story.camera_started_ns is not None
        lost_ns = story.camera_started_ns + round(at_s * 1e9)
        assert (story.ended_ns - lost_ns) / 1e6 <= CAMERA_STOP_LIMIT_MS + CAMERA_BATCH_MS


@pytest.mark.parametrize("board", ["tic", "grbl"])
@pytest.mark.parametrize(("phase", "after_ms"), [("expose", 5.0), ("sweep", 20.0), ("return", 5.0)])
def test_a_lens_that_is_unplugged_is_an_error(board: str, phase: str, after_ms: float) -> None:
    story = play(f"sim.board={board}", "sim.seed=3", events=[Event(phase, after_ms, _unplug)])
    assert isinstance(story.error, LensError)
    assert story.misfortune_ns is not None
    assert (story.ended_ns - story.misfortune_ns) / 1e6 <= 100.0
    assert_invariants(story)


@pytest.mark.parametrize("board", ["tic", "grbl"])
@pytest.mark.parametrize(("phase", "after_ms"), [("expose", 5.0), ("sweep", 20.0), ("return", 5.0)])
def test_a_lens_that_does_not_answer_is_an_error_and_is_told_to_stop(board: str, phase: str, after_ms: float) -> None:
    story = play(f"sim.board={board}", "sim.seed=3", events=[Event(phase, after_ms, _deafen)])
    assert isinstance(story.error, LensError)
    assert story.misfortune_ns is not None
    assert (story.ended_ns - story.misfortune_ns) / 1e6 <= 150.0
    assert_invariants(story)
    # the stop arrived: only the way back was broken
    assert story.truth.mechanism.velocity_at(story.ended_ns + 100_000_000) == 0.0


@pytest.mark.parametrize("board", ["tic", "grbl", "tmcl", "zaber"])
def test_a_board_that_resets_in_the_middle_of_a_sweep_is_an_error(board: str) -> None:
    story = play(f"sim.board={board}", "sim.seed=3", events=[Event("sweep", 20.0, _reset)])
    assert isinstance(story.error, LensError)
    assert_invariants(story)


def _unplug(story: Story) -> None:
    story.truth.port.faults.disconnect_at_ns = story.parts.clock.now_ns()


def _deafen(story: Story) -> None:
    story.truth.port.faults.drop_to_host = True


def _reset(story: Story) -> None:
    board = story.truth.port.wire.board
    assert isinstance(board, TicBoard) or hasattr(board, "reset_at")
    board.reset_at(story.parts.clock.now_ns())
