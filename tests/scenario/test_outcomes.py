"""Every outcome that a cycle can have, reached by the misfortune that it names."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from elpd_drivers.sim.scene import scene_canvas
from scenarios import Event, SpyLens, Story, assert_invariants, play
from scripted_rig import CAPABILITIES, Lens, scripted_rig

from elpd.config import load
from elpd.errors import UsageError
from elpd.focus.cycle import FocusCycle
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.records import CommandStamp, Outcome, Roi

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.units import HostNs


class Unstoppable(Lens):
    capabilities = replace(CAPABILITIES, stop_on_command=False)


class SilentSink:
    def note(self, event: str, /, **fields: object) -> None:
        pass


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    """A picture of the scene, as somebody might have taken it earlier."""
    canvas = scene_canvas("camera", 320, 240, 0)
    path = tmp_path / "scene.png"
    cv2.imwrite(str(path), np.round(255 * cv2.GaussianBlur(canvas, (0, 0), 2.0)).astype(np.uint8))
    return path


@pytest.mark.parametrize(
    ("board", "start_um"),
    [
        ("tic", -200.0),
        ("tic", 200.0),
        ("grbl", -200.0),
        ("grbl", 200.0),
        ("tmcl", 200.0),
        ("zaber", -200.0),
        ("scf4", 200.0),
    ],
)
def test_focused(board: str, start_um: float) -> None:
    story = play(f"sim.board={board}", f"sim.start_um={start_um}", "sim.seed=3")
    assert story.outcome is Outcome.FOCUSED
    assert_invariants(story)


@pytest.mark.parametrize(("start_um", "speed_um_s"), [(-200.0, 4000.0), (200.0, 400.0)])
def test_focused_by_a_lens_that_cannot_be_stopped(start_um: float, speed_um_s: float) -> None:
    story = play("sim.board=theia", f"sim.start_um={start_um}", f"sim.speed_um_s={speed_um_s}", "sim.seed=11")
    assert story.outcome is Outcome.FOCUSED
    assert_invariants(story)
    assert abs(story.errors["final_error_um"] or 0.0) < story.settings.depth_of_focus_um / 2


def test_a_bare_lens_that_cannot_be_stopped_is_refused_before_anything_happens() -> None:
    parts = scripted_rig([0, 0], lens=Unstoppable)  # two looks at the clock, and nothing else
    cycle = FocusCycle(parts, CycleSettings.from_config(load()), FocusRequest(), SilentSink())
    with pytest.raises(UsageError, match="nothing was moved"):
        cycle.run()


def test_focused_on_a_stored_picture(picture: Path) -> None:
    story = play("sim.seed=3", request=FocusRequest(reference=picture))
    assert story.outcome is Outcome.FOCUSED
    assert "expose" not in story.phases
    assert_invariants(story)


def test_a_flat_scene_has_no_texture_and_nothing_moves() -> None:
    story = play("sim.scene=flat")
    assert story.outcome is Outcome.NO_TEXTURE
    assert not story.moved
    assert_invariants(story)


def test_a_cap_from_the_start_has_no_texture_and_nothing_moves() -> None:
    story = play("sim.cap=true")
    assert story.outcome is Outcome.NO_TEXTURE
    assert not story.moved
    assert_invariants(story)


def test_an_aperture_that_is_stuck_ends_before_anything_moves() -> None:
    story = play("sim.aperture_stuck=true")
    assert story.outcome is Outcome.NO_TEXTURE
    assert story.result is not None
    assert "aperture" in story.result.reason
    assert not story.moved
    assert_invariants(story)


def test_an_aperture_that_is_slow_leads_to_an_honest_end() -> None:
    story = play("sim.aperture_slow=true", "sim.seed=3")
    assert story.outcome is Outcome.NO_TEXTURE
    assert not story.moved
    assert_invariants(story)


@pytest.mark.parametrize("direction", ["up", "down"])
def test_focus_farther_away_than_the_lens_may_go_is_not_found(direction: str) -> None:
    start_um = -200.0 if direction == "up" else 200.0
    story = play(f"sim.start_um={start_um}", f"lens.first_direction={direction}", "focus.max_travel_um=100.0")
    assert story.outcome is Outcome.NO_CROSSING
    assert_invariants(story)


@pytest.mark.parametrize("direction", ["up", "down"])
def test_focus_behind_with_no_reversal_allowed_is_not_found(direction: str) -> None:
    start_um = 200.0 if direction == "up" else -200.0
    story = play(f"sim.start_um={start_um}", f"lens.first_direction={direction}", "focus.max_reversals=0")
    assert story.outcome is Outcome.NO_CROSSING
    assert story.reversal_travels_um
    assert_invariants(story)


def test_a_cap_put_on_before_a_stored_picture_is_used_gives_too_few_events(picture: Path) -> None:
    story = play("sim.cap=true", "sim.seed=3", request=FocusRequest(reference=picture))
    assert story.outcome is Outcome.TOO_FEW_EVENTS
    assert_invariants(story)


def test_darkness_right_after_exposing_gives_too_few_events() -> None:
    story = play("sim.seed=3", events=[Event("choose", 0.0, _darken)])
    assert story.outcome is Outcome.TOO_FEW_EVENTS
    assert_invariants(story)


@pytest.mark.parametrize("after_ms", [2.0, 15.0, 30.0, 45.0, 50.0])
def test_darkness_while_moving_is_never_taken_for_focus(after_ms: float) -> None:
    story = play("sim.seed=3", events=[Event("sweep", after_ms, _darken)])
    assert story.outcome is not Outcome.FOCUSED or after_ms > 40.0
    assert_invariants(story)


def test_a_standard_error_beyond_the_limit_is_low_confidence() -> None:
    story = play("sim.seed=3", "focus.max_sigma_dof=0.01")
    assert story.outcome is Outcome.LOW_CONFIDENCE
    assert_invariants(story)


def test_events_lost_around_the_crossing_are_not_guessed_over() -> None:
    calm = play("sim.seed=3")
    begun_ms = next(fields["at_ms"] for fields in calm.named("phase") if fields["name"] == "sweep")
    story = play("sim.seed=3", f"sim.drop_from_s={(begun_ms + 50.0) / 1e3}", "sim.drop_for_s=0.004")
    assert story.outcome is Outcome.EVENTS_LOST
    assert story.result is not None
    assert story.result.lost > 0
    assert_invariants(story)


def test_shedding_more_than_a_fifth_is_refused() -> None:
    story = play("sim.seed=3", "sim.drop_from_s=0.13", "sim.drop_for_s=0.03")
    assert story.outcome is Outcome.EVENTS_LOST
    assert_invariants(story)


class SilentMotor(SpyLens):
    """A controller that takes every order and does not step, as with a motor that is not energised."""

    def run(self, velocity_sps: float, until: HostNs) -> CommandStamp:
        now = self.story.parts.clock.now_ns()
        return CommandStamp("run", now, now)


def test_reports_that_stand_still_under_command_mean_a_lens_that_did_not_move() -> None:
    story = play("sim.seed=3", spy=SilentMotor)
    assert story.outcome is Outcome.LENS_DID_NOT_MOVE
    assert_invariants(story)


def test_a_mechanism_that_is_stuck_in_the_light_is_told_from_darkness() -> None:
    story = play("sim.seed=3", events=[Event("choose", 0.0, _stick)])
    assert story.outcome is Outcome.LENS_DID_NOT_MOVE
    assert_invariants(story)


def test_a_coupling_that_slips_on_the_return_is_seen() -> None:
    story = play("sim.seed=3", events=[Event("return", 0.0, _stick)])
    assert story.outcome is Outcome.LENS_DID_NOT_MOVE
    assert_invariants(story)


def test_dry_run_moves_nothing() -> None:
    story = play("sim.seed=3", request=FocusRequest(dry_run=True))
    assert story.outcome is Outcome.CANCELLED
    assert not story.moved
    assert_invariants(story)


def test_a_region_on_a_flat_part_has_no_texture() -> None:
    story = play("sim.seed=3", "sim.scene=rocket", request=FocusRequest(roi=Roi(4, 4, 24, 24)))
    assert story.outcome in {Outcome.NO_TEXTURE, Outcome.TOO_FEW_EVENTS, Outcome.LOW_CONFIDENCE}
    assert_invariants(story)


def _darken(story: Story) -> None:
    assert story.truth.aperture is not None
    story.truth.aperture.close()


def _stick(story: Story) -> None:
    story.truth.mechanism.stick(story.parts.clock.now_ns())


def test_fine_texture_far_out_of_focus_does_not_turn_the_lens_round() -> None:
    story = play("sim.seed=0", "sim.scene=brick", "sim.camera=davis346", "sim.speed_um_s=2000", small=False)
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert story.result.reversals == 0
    assert_invariants(story)
