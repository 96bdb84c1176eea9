"""A lens with a cam: the same step moves the image further at one end of the travel than at the other."""

from __future__ import annotations

import numpy as np
import pytest
from elpd_drivers.sim.rig import Cam
from scenarios import assert_invariants, play

from elpd.records import Outcome

UNEVENNESS = 0.25
TRAVEL_UM = 2500.0
UM_PER_STEP = 0.3125


def table(points: int = 41) -> str:
    """Return what a careful owner would have measured, as a config value."""
    carriage_um = np.linspace(0.0, TRAVEL_UM, points)
    image_um = Cam(UNEVENNESS, TRAVEL_UM).image_um(carriage_um)
    rows = (
        f"[{carriage / UM_PER_STEP:.1f}, {image:.4f}]" for carriage, image in zip(carriage_um, image_um, strict=True)
    )
    return f"[{', '.join(rows)}]"


@pytest.mark.parametrize("seed", [3, 11])
def test_focus_is_found_and_told_in_micrometres_of_the_table(seed: int) -> None:
    story = play(f"sim.cam={UNEVENNESS}", f"lens.steps_to_um={table()}", f"sim.seed={seed}", "sim.start_um=-180")
    assert story.outcome is Outcome.FOCUSED
    assert_invariants(story)
    dof_um = story.settings.depth_of_focus_um
    assert abs(story.errors["final_error_um"] or 0.0) < dof_um
    assert abs(story.errors["estimate_error_um"] or 0.0) < dof_um


def test_a_ruler_that_is_wrong_is_wrong_in_the_number_and_not_in_the_focus() -> None:
    """Focus is a place on the motor, found and approached in steps: without its table a lens focuses all the same."""
    story = play(f"sim.cam={UNEVENNESS}", "sim.seed=3", "sim.start_um=-180")
    assert story.outcome is Outcome.FOCUSED
    assert abs(story.errors["final_error_um"] or 0.0) < story.settings.depth_of_focus_um
