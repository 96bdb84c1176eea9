"""Each misfortune that the events betray: what comes of it, what is told, and never a false FOCUSED.

Two seeds each, one from each side; ``tools/guards.py`` counts many.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from scenarios import Event, assert_invariants, play

from elpd.focus.settings import FocusRequest
from elpd.records import Outcome, Roi

if TYPE_CHECKING:
    from scenarios import Story

BASE = (
    "sim.camera=davis346", "sim.width=200", "sim.height=160", "sim.scene=random", "focus.roi_fraction=0.6",
)  # fmt: skip
MIDDLE = FocusRequest(roi=Roi(40, 30, 120, 100))
SEEDS = [2, 3]


def meet(
    seed: int, *keys: str, request: FocusRequest | None = None, events: tuple[Event, ...] = (), planes: bool = False
) -> Story:
    start_um = 200.0 if seed % 2 else -200.0
    story = play(*BASE, f"sim.seed={seed}", f"sim.start_um={start_um}", *keys, request=request, events=events)
    if planes and story.outcome is Outcome.FOCUSED:
        offset_um = story.config.sim.model_extra["second_plane_um"] if start_um > 0 else 0.0
        story.errors["final_error_um"] -= offset_um
    assert_invariants(story)
    return story


def told(story: Story, word: str) -> str:
    assert story.result is not None
    found = [warning for warning in story.result.warnings if word in warning]
    assert len(found) == 1, story.result.warnings
    return found[0]


@pytest.mark.parametrize("seed", SEEDS)
def test_without_a_misfortune_nothing_is_told(seed: int) -> None:
    story = meet(seed)
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert story.result.warnings == ()
    assert story.result.depths_um == ()


@pytest.mark.parametrize(("seed", "depth", "hz"), [(3, 0.1, 100), (2, 0.3, 120)])
def test_mains_light_is_swept_under_in_whole_periods(seed: int, depth: float, hz: int) -> None:
    story = meet(seed, f"sim.flicker_hz={hz}", f"sim.flicker_depth={depth}")
    assert story.outcome is Outcome.FOCUSED
    assert f"flickers at {hz} Hz" in told(story, "flickers")


@pytest.mark.parametrize("seed", SEEDS)
def test_a_pulsed_lamp_that_pixels_cannot_follow_is_refused_before_anything_moves(seed: int) -> None:
    story = meet(seed, "sim.flicker_hz=200", "sim.flicker_depth=0.5", "sim.flicker_shape=pwm")
    assert story.outcome is Outcome.LOW_CONFIDENCE
    assert story.result is not None
    assert "200 Hz" in story.result.reason
    assert "run" not in {command.name for command in story.commands}


def test_under_a_lamp_a_coupling_that_slips_on_the_return_is_seen() -> None:
    def stick(story: Story) -> None:
        story.truth.mechanism.stick(story.parts.clock.now_ns())

    story = meet(2, "sim.flicker_hz=100", "sim.flicker_depth=0.3", events=(Event("return", 0.0, stick),))
    assert story.outcome is Outcome.LENS_DID_NOT_MOVE


@pytest.mark.parametrize("seed", SEEDS)
def test_a_coupling_that_slips_on_the_return_is_seen_although_the_scene_makes_events_of_its_own(seed: int) -> None:
    def stick(story: Story) -> None:
        story.truth.mechanism.stick(story.parts.clock.now_ns())

    shaken = ("sim.motion=shake",)
    assert meet(seed, *shaken).outcome is not Outcome.LENS_DID_NOT_MOVE
    story = meet(seed, *shaken, events=(Event("return", 0.0, stick),))
    assert story.outcome is Outcome.LENS_DID_NOT_MOVE
    assert story.result is not None
    assert "sharper" in story.result.reason


@pytest.mark.parametrize(
    ("seed", "condition"),
    [(67, "sim.motion=shake"), (72, "sim.motion=violent"), (73, "sim.motion=violent"), (62, "sim.noise_hz=100")],
)
def test_nor_do_events_hide_it_that_nobody_has_taken_for_motion(seed: int, condition: str) -> None:
    """A hand that rests while it is listened to, and turns round in focus, is not seen; noise makes events as well."""

    def stick(story: Story) -> None:
        story.truth.mechanism.stick(story.parts.clock.now_ns())

    assert meet(seed, condition).outcome is Outcome.FOCUSED
    assert meet(seed, condition, events=(Event("return", 0.0, stick),)).outcome is Outcome.LENS_DID_NOT_MOVE


def test_a_pass_that_tells_depths_takes_nothing_back_that_flat_ones_agreed_on() -> None:
    """In dim light few pairs turn, and the fourth pass takes noise for a second plane."""
    story = meet(8100, "sim.brightness=0.2")
    assert story.outcome is Outcome.FOCUSED
    assert abs(story.errors["final_error_um"]) < 3.0


def test_a_flat_scene_under_a_lamp_has_no_texture() -> None:
    story = meet(2, "sim.flicker_hz=100", "sim.flicker_depth=0.3", "sim.scene=flat")
    assert story.outcome is Outcome.NO_TEXTURE


@pytest.mark.parametrize("seed", SEEDS)
def test_hot_pixels_are_left_out_and_counted(seed: int) -> None:
    story = meet(seed, "sim.hot_pixels=200")
    assert story.outcome is Outcome.FOCUSED
    assert int(told(story, "hot pixels").split()[0]) > 50


@pytest.mark.parametrize(("seed", "apart_um"), [(2, 60.0), (3, 60.0)])
def test_of_several_depths_the_first_met_is_taken_and_all_are_told(seed: int, apart_um: float) -> None:
    slowly = ("lens.speed_um_s=1500", "sim.speed_um_s=1500")  # of several planes, pairs do not tell the lag
    story = meet(seed, f"sim.second_plane_um={apart_um}", *slowly, request=MIDDLE, planes=True)
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert story.result.focus_um is not None
    first, second = story.result.depths_um
    assert story.result.focus_um == pytest.approx(first, abs=1.0)
    assert abs(second - first) == pytest.approx(apart_um, abs=6.0)
    assert "several depths" in told(story, "depths")


@pytest.mark.parametrize("seed", [8301, 8302, 8308])
def test_of_two_depths_in_a_hand_that_moves_it_is_the_first_met_too(seed: int) -> None:
    """Sharpness alone shows their middle."""
    story = meet(seed, "sim.second_plane_um=15", "sim.motion=moderate", request=MIDDLE, planes=True)
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert len(story.result.depths_um) == 2
    assert abs(story.errors["final_error_um"]) < 5.0
    assert "several depths" in told(story, "depths")


@pytest.mark.parametrize("seed", SEEDS)
def test_planes_that_are_hard_to_tell_apart_are_the_first_met_or_refused(seed: int) -> None:
    story = meet(seed, "sim.second_plane_um=15", request=MIDDLE, planes=True)
    assert story.outcome in {Outcome.FOCUSED, Outcome.LOW_CONFIDENCE}


@pytest.mark.parametrize("seed", SEEDS)
def test_a_noisy_sensor_says_so(seed: int) -> None:
    story = meet(seed, "sim.noise_hz=100")
    assert "times a second" in told(story, "at rest each pixel")
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert story.result.details["method"] == "two_crossings"


@pytest.mark.parametrize("seed", SEEDS)
def test_a_dark_scene_with_slow_receptors_is_not_guessed_at(seed: int) -> None:
    story = meet(seed, "sim.brightness=0.02")
    assert story.outcome in {Outcome.TOO_FEW_EVENTS, Outcome.LOW_CONFIDENCE, Outcome.NO_CROSSING}
    meet(seed, "sim.brightness=0.05")  # the invariants hold: FOCUSED within a depth of focus, or not at all


@pytest.mark.parametrize("seed", SEEDS)
def test_overexposed_frames_are_told(seed: int) -> None:
    story = meet(seed, "sim.overexposed=0.4")
    assert "saturated" in told(story, "frames")


@pytest.mark.parametrize("seed", SEEDS)
def test_a_read_out_that_is_full_and_does_not_say_so_is_seen(seed: int) -> None:
    story = meet(seed, "sim.rate_limit_mev_s=0.15", "sim.rate_limit_told=false", "sim.scene=gravel")
    assert "saturated" in told(story, "event rate")


@pytest.mark.parametrize("seed", SEEDS)
def test_a_sensor_that_counts_what_it_drops_is_believed(seed: int) -> None:
    story = meet(seed, "sim.rate_limit_mev_s=0.1")
    assert story.outcome is Outcome.EVENTS_LOST
    assert "events were lost" in told(story, "lost")


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "motion",
    [
        ("sim.scene=bars", "sim.pan_px_s=200", "sim.pan_deg=90"),
        ("sim.scene=bars", "sim.pan_px_s=100"),
        ("sim.breathing_per_mm=0.1",),
        ("sim.object_px_s=300",),
    ],
    ids=["pan along bars", "pan across bars", "breathing", "an object goes by"],
)
def test_motion_that_looks_like_focusing_is_never_taken_for_it(seed: int, motion: tuple[str, ...]) -> None:
    meet(seed, *motion)  # the invariants hold: FOCUSED within a depth of focus, or not at all


@pytest.mark.parametrize("seed", [5001, 5002])
def test_where_events_are_noise_and_frames_show_the_lens_move_it_is_too_dark_and_not_stuck(seed: int) -> None:
    keys = ("sim.camera=davis346", "sim.brightness=0.0005", "sim.noise_hz=0.005")
    story = meet(seed, *keys)
    assert story.outcome is Outcome.TOO_FEW_EVENTS
    assert story.result is not None
    assert "too dark" in story.result.reason

    def stick(story: Story) -> None:
        story.truth.mechanism.stick(story.parts.clock.now_ns())

    assert meet(seed, *keys, events=(Event("choose", 0.0, stick),)).outcome is not Outcome.TOO_FEW_EVENTS
