"""Dim light: photoreceptors are late by more than a depth of focus, but as much on the way back."""

from __future__ import annotations

import pytest
from scenarios import assert_invariants, play

from elpd.records import Outcome

DEPTH_OF_FOCUS_UM = 6.0
DIM = "sim.brightness=0.1"


@pytest.mark.parametrize("start_um", [-200.0, 200.0])
def test_in_dim_light_focus_is_passed_once_more_on_the_way_back(start_um: float) -> None:
    story = play(DIM, "sim.seed=50", f"sim.start_um={start_um}", "sim.camera=evk4")
    assert_invariants(story)
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert story.result.details["method"] == "two_crossings"
    final_um = story.errors["final_error_um"]
    assert final_um is not None
    assert abs(final_um) < 0.5 * DEPTH_OF_FOCUS_UM
    one_pass = next(iter(story.named("one pass")))
    assert one_pass["sigma_um"] > story.result.sigma_um
