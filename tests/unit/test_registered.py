"""Registered regression where it is known to work and where it fails, and how the ablation weighs it."""

from dataclasses import replace

import numpy as np
import pytest
from ablation import left_out, left_out_bias, rms
from naive_baselines import little_stack, texture

from elpd.baselines import PEERS

FOCUS_US = 100_000.0
SWAY_PX_PER_US = 4e-5


def swaying(t_us: int) -> float:
    return SWAY_PX_PER_US * t_us


def test_it_finds_focus_in_a_scene_that_goes_across_while_frames_come() -> None:
    answer = PEERS["registered"].run(little_stack(texture(1), move=swaying))
    assert abs(answer.focus_us - FOCUS_US) < 12_000
    assert answer.decided_us > answer.focus_us


def test_without_a_frame_or_without_events_it_has_no_answer() -> None:
    stack = little_stack(texture(1))
    assert not PEERS["registered"].run(replace(stack, frames=())).found
    none = {name: getattr(stack, name)[:0] for name in ("t_us", "x", "y", "on")}
    assert not PEERS["registered"].run(replace(stack, **none)).found


def test_what_knows_nothing_new_gets_no_weight_and_what_does_gets_half() -> None:
    rng = np.random.default_rng(5)
    ours, other = rng.standard_normal((2, 400))
    weights, errors = left_out(ours, ours + other)
    assert np.median(weights) == pytest.approx(0.0, abs=0.1)
    assert rms(errors) == pytest.approx(rms(left_out_bias(ours)), rel=0.02)
    weights, errors = left_out(ours, other + 30.0)  # a bias that does not change is taken off
    assert np.median(weights) == pytest.approx(0.5, abs=0.05)
    assert rms(errors) == pytest.approx(rms(ours) / np.sqrt(2.0), rel=0.05)
