"""`elpd calibrate backlash`: focus seen from both sides tells the play; lag and thresholds do not pass for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from command_line import Answer, caller
from elpd_drivers.sim.sensor import BiasLevels
from hypothesis import given
from hypothesis import strategies as st
from played import there_and_back_with_play

from elpd.calibrate.backlash import measure_backlash, solve
from elpd.calibrate.in_use import as_measured
from elpd.calibrate.level_pairs import level_pairs
from elpd.calibrate.play import BacklashCalibration, Reading, backlash_calibration
from elpd.calibrate.profile import MeasuredOn, save
from elpd.config import load
from elpd.focus.passes import Play
from elpd.focus.settings import CycleSettings
from elpd.vision.pairs import find_pairs

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def readings(seed: int, play_um: float, lag_us: float, noise_um: float = 0.1) -> list[Reading]:
    random = np.random.default_rng(seed)
    return [
        Reading(
            speed_um_s=sign * speed,
            focus_um=1000.0 + sign * play_um / 2 + sign * speed * 1e-6 * lag_us + random.normal(0.0, noise_um),
            sigma_um=0.05,
        )
        for speed in (500.0, 1000.0)
        for _ in range(3)
        for sign in (1, -1)
    ]


def test_play_and_lag_are_told_apart_at_two_speeds() -> None:
    scores = []
    for seed in range(40):
        play = solve(readings(seed, 4.0, 600.0), "")
        assert play.backlash_um.value is not None
        assert play.backlash_um.sigma is not None
        assert play.lag_us.value == pytest.approx(600.0, abs=400.0)
        scores.append((play.backlash_um.value - 4.0) / play.backlash_um.sigma)
    assert np.mean(np.abs(scores) < 2) >= 0.9
    assert np.mean(np.abs(scores)) > 0.2, "an error that is far too wide is no use"


def test_too_few_passes_are_said_to_be() -> None:
    assert solve([], "focus was not found").backlash_um.reason == "focus was not found"
    one_way = [one for one in readings(1, 4.0, 0.0) if one.speed_um_s > 0]
    assert "passes only" in (solve(one_way, "").backlash_um.reason or "")


@given(st.data())
def test_level_pairs_at_a_ratio_of_one_are_the_mirror_pairs(data: st.DataObject) -> None:
    size = data.draw(st.integers(0, 60))
    numbers = st.lists(st.integers(0, 2), min_size=size, max_size=size)
    x, y = (np.array(data.draw(numbers), np.uint16) for _ in range(2))
    on = np.array(data.draw(st.lists(st.integers(0, 1), min_size=size, max_size=size)), np.uint8)
    t_us = np.arange(size, dtype=np.int64) * 7
    position = np.cumsum(np.array(data.draw(st.lists(st.integers(0, 9), min_size=size, max_size=size)), np.float64))
    level, mirror = level_pairs(t_us, x, y, on, position, 1.0), find_pairs(t_us, x, y, on, position, (3, 3))
    order = np.argsort(level.after_us, kind="stable")
    for name in ("before", "after", "after_us", "x", "y", "on"):
        np.testing.assert_array_equal(getattr(level, name)[order], getattr(mirror, name), err_msg=name)


@pytest.mark.parametrize("ratio", [0.6, 1.0, 1.6])
def test_pairs_of_unequal_thresholds_are_level(ratio: float) -> None:
    """A pixel whose light rises evenly to focus at 10 and falls evenly after it, and one that dips."""
    c_off = 1.0
    c_on = ratio * c_off
    up = [4.0 + c_on * k for k in range(3)]
    turn = up[-1]
    down = 20.0 - turn + c_off
    position = np.array([*up, down])
    found = level_pairs(
        np.arange(4, dtype=np.int64),
        np.zeros(4, np.uint16),
        np.zeros(4, np.uint16),
        np.array([1, 1, 1, 0], np.uint8),
        position,
        ratio,
    )
    assert found.middle.tolist() == pytest.approx([10.0])


@pytest.mark.parametrize(
    ("seed", "scene", "c_on", "c_off", "play_um"),
    [(0, "camera", 0.25, 0.18, 2.0), (3, "astronaut", 0.2, 0.24, 0.0), (6, "chelsea", 0.19, 0.16, 8.0)],
)
def test_the_play_lies_within_its_error(seed: int, scene: str, c_on: float, c_off: float, play_um: float) -> None:
    evidence = there_and_back_with_play(play_um, seed, scene, focus=BiasLevels(c_on, c_off, 300))
    found = measure_backlash(evidence, 6.0).backlash_um
    assert found.value is not None, found.reason
    assert found.sigma is not None
    assert found.sigma < 0.7
    assert abs(found.value - play_um) < 3 * found.sigma


def test_what_was_measured_replaces_the_configured_play(tmp_path: Path) -> None:
    config = load(None, (f"state.directory={tmp_path}",))
    found = backlash_calibration(solve(readings(1, 4.0, 300.0), ""), MeasuredOn.lens(config, ruler=True))
    save(tmp_path, found)
    assert found.backlash_um.value is not None
    used = as_measured(config).lens.backlash_um
    assert used == found.approach_um == found.backlash_um.value + 3 * (found.backlash_um.sigma or 0.0)
    assert as_measured(as_measured(config)) == as_measured(config)
    play = Play.known(CycleSettings.from_config(as_measured(config)))
    assert (play.um, play.sigma_um) == (found.backlash_um.value, found.backlash_um.sigma)
    assert Play.known(CycleSettings.from_config(config)) == Play.up_to(6.0)
    for other in ("lens.um_per_step=0.5", "lens.steps_to_um=[[0, 0.0], [8000, 2000.0]]", "state.profiles=false"):
        assert as_measured(load(None, (f"state.directory={tmp_path}", other))).lens.backlash_um == 6.0


def test_no_play_needs_no_negative_approach() -> None:
    on = MeasuredOn(part="lens", device="x", serial=None, settings={})
    found: BacklashCalibration = backlash_calibration(solve(readings(2, -0.4, 0.0), ""), on)
    assert found.approach_um == pytest.approx(3 * (found.backlash_um.sigma or 0.0))


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


def test_the_rig_measures_its_own_play(elpd: Callable[..., Answer]) -> None:
    rig = ("sim.width=160", "sim.height=120", "sim.scene=camera", "sim.seed=4", "sim.start_um=0", "sim.backlash_um=5.0")
    options = [part for key in (*rig, "state.directory=state") for part in ("--set", key)]
    answer = elpd("calibrate", "backlash", "--here", "--reach-um", "90", *options, "--json")
    assert answer.code == 0, answer.err
    found = answer.json["backlash_um"]
    assert abs(found["value"] - 5.0) < 3 * found["sigma"]
    assert answer.json["saved"] == "state/backlash.json"
    assert answer.json["approach_um"] == pytest.approx(found["value"] + 3 * found["sigma"])
    flat = elpd("calibrate", "backlash", "--here", "--reach-um", "90", *options, "--set", "sim.scene=flat", "--json")
    assert flat.code == 1
    assert flat.json["backlash_um"]["value"] is None
    assert flat.json["saved"] is None
