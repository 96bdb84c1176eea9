"""`elpd calibrate sensor` on simulated rigs: what it finds, what it says when it cannot, what focusing makes of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from command_line import Answer, caller
from elpd_drivers.formats.raw import write_raw

from elpd.events.evt3_encode import Evt3Encoder
from elpd.records import Geometry

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

RIG = ("--set", "sim.width=160", "--set", "sim.height=120", "--set", "sim.scene=camera", "--set", "sim.seed=4")
SENSOR = ("--set", "sim.contrast_on=0.125", "--set", "sim.contrast_off=0.1", "--set", "sim.hot_pixels=3")
STATE = ("--set", "state.directory=state", "--set", "journal.directory=runs")


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


def believed(found: dict[str, Any], truth: float) -> bool:
    """Whether the truth lies within four standard errors."""
    assert found["reason"] is None, found
    return bool(abs(found["value"] - truth) < 4 * found["sigma"])


def test_a_camera_with_frames_is_measured_and_then_focused_with(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    camera = ("--set", "sim.camera=davis346", "--set", "sim.scene=astronaut", "--set", "sim.speed_um_s=8000")
    rig = (*RIG, *SENSOR, *STATE, *camera, "--set", "sim.start_um=0")
    options = (
        "--here",
        "--reach-um",
        "70",
        "--rest-s",
        "0.3",
        "--black",
        "4",
        "--plot",
        "seen.png",
        "--keep",
        "kept.npz",
        "--json",
    )
    answer = elpd("calibrate", "sensor", *rig, *options)
    assert answer.code == 0, answer.err
    found = answer.json
    for name, truth in (
        ("threshold_ratio", 1.25),
        ("threshold_on", 0.125),
        ("threshold_off", 0.1),
        ("refractory_us", 500.0),
    ):
        assert believed(found[name], truth), (name, found[name])
    assert found["threshold_on"]["sigma"] < 0.04
    assert found["lag_us"]["value"] > found["lag_us"]["sigma"]
    assert len(found["hot_pixels"]) == 3
    assert found["saved"] == "state/sensor.json"
    assert (found["on"]["width"], found["on"]["serial"]) == (160, "simulated-4")
    picture = cv2.imread(str(tmp_path / "seen.png"))
    assert picture.shape[0] > 600
    assert picture.std() > 20

    again = elpd("calibrate", "sensor", "kept.npz", "--json")
    assert again.code == 0
    same = {key: value for key, value in again.json.items() if key not in {"measured_utc", "saved", "plot", "evidence"}}
    assert same == {key: found[key] for key in same}

    focusing = (*RIG, *SENSOR, *STATE, *camera, "--set", "sim.start_um=-150", "--json")
    calibrated = elpd("focus", *focusing)
    assert calibrated.json["details"]["masked_pixels"] == 3
    plain = elpd("focus", *focusing, "--set", "state.profiles=false")
    assert "masked_pixels" not in plain.json["details"]
    assert calibrated.json["sigma_um"] != plain.json["sigma_um"]
    replayed = elpd("replay", calibrated.json["run"], "--json")
    assert (replayed.code, replayed.json["identical"]) == (0, True), replayed.json["first_difference"]


def test_an_event_camera_focuses_first_and_says_what_takes_frames(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    rig = (
        *RIG,
        *SENSOR,
        *STATE,
        "--set",
        "sim.camera=evk4",
        "--set",
        "sim.start_um=-60",
        "--set",
        "sim.speed_um_s=8000",
    )
    answer = elpd("calibrate", "sensor", *rig, "--reach-um", "50", "--rest-s", "0.2", "--dry-run")
    assert answer.code == 0, answer.err
    assert "threshold, ON            not measurable, because that takes frames" in answer.out
    assert "threshold, ON / OFF      1.2" in answer.out
    assert "3 above" in answer.out
    assert "there and back at 1000 um/s" in answer.err
    assert not (tmp_path / "state").exists()


@pytest.mark.parametrize("key", ["sim.cap=true", "sim.scene=flat"])
def test_in_the_dark_or_before_a_wall_only_rest_is_measured(
    elpd: Callable[..., Answer], tmp_path: Path, key: str
) -> None:
    answer = elpd("calibrate", "sensor", *RIG, *STATE, "--set", key, "--rest-s", "0.3", "--json")
    assert answer.code == 1
    found = answer.json
    assert found["noise_on_hz"]["value"] > 0
    assert "focus was not found first" in found["threshold_ratio"]["reason"]
    assert found["saved"] is None
    assert not (tmp_path / "state").exists()


def test_a_lens_without_room_is_refused(elpd: Callable[..., Answer]) -> None:
    answer = elpd("calibrate", "sensor", *RIG, "--here", "--reach-um", "20", "--json")
    assert answer.code == 2
    assert "needed on both sides of focus" in answer.json["error"]["message"]


def test_a_recording_tells_noise_where_somebody_says_when_it_rested(
    elpd: Callable[..., Answer], tmp_path: Path
) -> None:
    random = np.random.default_rng(6)
    t = np.sort(random.integers(1_000_000, 2_000_000, 5000))
    x, y = random.integers(0, 64, 5000).astype(np.uint16), random.integers(0, 48, 5000).astype(np.uint16)
    on = (random.random(5000) < 0.7).astype(np.uint8)
    path = tmp_path / "rest.raw"
    write_raw(path, Geometry(64, 48), [Evt3Encoder(64).encode(t, x, y, on)], {})
    blind = elpd("calibrate", "sensor", "rest.raw", "--json").json
    assert blind["noise_on_hz"]["reason"] == "nothing says when the lens stood still; give --rest-us A,B"
    told = elpd("calibrate", "sensor", "rest.raw", "--rest-us", "1010000,1990000", "--json").json
    assert believed(told["noise_on_hz"], 0.7 * 5000 / (64 * 48))
    assert believed(told["noise_on_off_ratio"], 7 / 3)
    assert "there and back at two speeds" in told["threshold_ratio"]["reason"]
    outside = elpd("calibrate", "sensor", "rest.raw", "--rest-us", "0,1990000", "--json")
    assert outside.code == 2
    assert "does not lie inside" in outside.json["error"]["message"]


def test_evidence_that_is_cut_off_is_an_error(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    np.savez(tmp_path / "bad.npz", head=np.array('{"format": 1}'))
    answer = elpd("calibrate", "sensor", "bad.npz", "--json")
    assert answer.code == 2
    assert "not what `elpd calibrate sensor --keep` wrote" in answer.json["error"]["message"]


def test_the_group_lists_its_kinds_and_knows_no_other(elpd: Callable[..., Answer]) -> None:
    assert "sensor" in elpd("calibrate", "--help").out
    unknown = elpd("calibrate", "dish", "--json")
    assert unknown.code == 2
    assert "no command 'dish'; there are" in unknown.json["error"]["message"]
