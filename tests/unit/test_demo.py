"""The demo: a terminal's show and a program's answer from one cycle, and nothing that the controller could peek at."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from command_line import SMALL_RIG, Answer, caller
from elpd_drivers.sim.rig import build_rig

from elpd.cli.demo import MAGNIFIED_PX, magnified
from elpd.ports import Paced, Scenery

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

VIRTUAL = (*SMALL_RIG, "--set", "sim.pace=0")
ESCAPE = "\x1b"


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


def test_without_a_terminal_the_demo_tells_its_story_in_plain_lines(
    elpd: Callable[..., Answer], tmp_path: Path
) -> None:
    told = elpd("demo", *VIRTUAL)
    assert told.code == 0
    assert ESCAPE not in told.out + told.err
    lines = told.out.splitlines()
    assert max(map(len, lines)) <= 80
    for part in (
        "expose",
        "sweep",
        "FOCUSED at",
        "ELP, relative",
        "before, -200.0 um from focus",
        "In focus. The lens",
    ):
        assert any(part in line for line in lines), part
    assert "virtual time" in told.out
    (run,) = (tmp_path / "runs").iterdir()
    assert f"`elpd replay runs/{run.name}` decides the same again." in lines
    both = cv2.imread(str(run / "before-after.png"), cv2.IMREAD_UNCHANGED)
    assert both.shape == (240, 640)
    assert _sharpness(both[:, 320:]) > 4 * _sharpness(both[:, :320])


def test_a_program_gets_one_object_and_the_recorded_run_replays(elpd: Callable[..., Answer]) -> None:
    shown = elpd("demo", *VIRTUAL, "--json")
    assert (shown.code, shown.err) == (0, "")
    fields = shown.json
    assert fields["outcome"] == "FOCUSED"
    assert fields["start_error_um"] == -200.0
    assert abs(fields["truth"]["final_error_um"]) < 6.0
    assert fields["behind_ms"] == 0.0
    assert fields["wall_ms"] > 0.0
    again = elpd("replay", fields["run"], "--json")
    assert again.code == 0
    assert again.json["identical"]
    assert again.json["focus_um"] == fields["focus_um"]


def test_the_demo_and_focus_decide_the_same(elpd: Callable[..., Answer]) -> None:
    one = elpd("demo", *VIRTUAL, "--set", "sim.seed=5", "--set", "journal.enabled=false", "--json").json
    other = elpd("focus", *VIRTUAL, "--set", "sim.seed=5", "--set", "journal.enabled=false", "--json").json
    assert one["run"] is None
    assert {key: one[key] for key in other} == other


def test_out_of_focus_the_demo_says_why_and_exits_with_1(elpd: Callable[..., Answer]) -> None:
    told = elpd("demo", *VIRTUAL, "--set", "sim.scene=flat")
    assert told.code == 1
    assert "Not in focus: NO_TEXTURE" in told.out


def test_a_file_decides_what_the_demo_shows(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        "[sim]\nseed = 4\nstart_um = 150.0\nwidth = 320\nheight = 240\nscene = 'coffee'\n"
    )
    assert elpd("demo", "--config", "mine.toml", "--json").json["start_error_um"] == 150.0


@pytest.mark.parametrize("override", ["rig=hardware", "lens.driver=tic"])
def test_what_is_not_simulated_is_refused(elpd: Callable[..., Answer], override: str) -> None:
    refused = elpd("demo", *VIRTUAL, "--set", override, "--json")
    assert refused.code == 2
    assert refused.json["outcome"] is None


def test_the_rig_shows_its_scene_without_time_passing_or_the_aperture_opening() -> None:
    rig = build_rig({"width": 128, "height": 96, "scene": "camera", "start_um": -60.0})
    assert isinstance(rig.truth, Scenery)
    assert isinstance(rig.clock, Paced)
    before, begun = rig.truth.picture(), rig.clock.now_ns()
    assert before.shape == (96, 128)
    assert np.ptp(before) > 0.5
    assert np.array_equal(before, rig.truth.picture())
    assert rig.clock.now_ns() == begun
    focused = build_rig({"width": 128, "height": 96, "scene": "camera", "start_um": 0.0})
    assert isinstance(focused.truth, Scenery)
    assert _sharpness(focused.truth.picture()) > 3 * _sharpness(before)


def test_under_a_cap_the_scene_is_dark() -> None:
    rig = build_rig({"width": 64, "height": 48, "cap": True})
    assert isinstance(rig.truth, Scenery)
    assert np.ptp(rig.truth.picture()) == 0.0


def test_the_magnifier_finds_the_finest_structure_inside_the_region() -> None:
    picture = np.zeros((200, 300), np.float32)
    picture[150:160, 240:250:2] = 1.0
    picture[20:30, 20:30:2] = 5.0
    rows, columns = magnified(picture, (100, 50, 200, 150), MAGNIFIED_PX)
    assert (rows.stop - rows.start, columns.stop - columns.start) == (MAGNIFIED_PX, MAGNIFIED_PX)
    assert picture[rows, columns].sum() == picture[150:160, 240:250].sum()
    assert magnified(picture, (280, 190, 20, 10), MAGNIFIED_PX) == (slice(190, 200), slice(280, 300))


def _sharpness(picture: np.ndarray) -> float:
    return float(np.mean(cv2.Laplacian(picture.astype(np.float32), cv2.CV_32F) ** 2))
