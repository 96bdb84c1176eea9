"""Whole cycles on the simulated rig, recorded and replayed: the same decision or the build is red."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import structlog
from click.testing import CliRunner

from elpd import rig
from elpd.cli import detect as detect_command
from elpd.cli import replay as replay_command
from elpd.config import Config
from elpd.focus.cycle import FocusCycle
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.record.journal import RunWriter
from elpd.record.replay import load_run, replay_run
from elpd.record.run_sweep import read_run_sweep
from elpd.record.session import focus_once
from elpd.record.tape import open_file
from elpd.records import Outcome
from elpd.vision.ruler import Ruler

if TYPE_CHECKING:
    from elpd.records import FocusResult


def config_for(directory: Path, **sim: Any) -> Config:
    return Config.model_validate({"journal": {"directory": directory}, "sim": {"seed": 4, **sim}})


def recorded(directory: Path, **sim: Any) -> Path:
    session = focus_once(config_for(directory, **sim), FocusRequest())
    assert session.run is not None
    return session.run


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module", params=["evk4", "davis346"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("runs"), camera=request.param)


def test_the_replay_reaches_the_same_decision(run: Path) -> None:
    answer = CliRunner().invoke(replay_command.command, [str(run), "--json"], standalone_mode=False)
    assert answer.exception is None, answer.exception
    fields = json.loads(answer.stdout)
    assert fields["first_difference"] is None
    assert fields["identical"] is True
    assert answer.return_value == 0
    kept = load_run(run)
    assert kept.result is not None
    assert kept.truncated is None
    assert {key: fields[key] for key in kept.result} == kept.result
    assert fields["truth"] == kept.truth
    assert kept.truth is not None


def detected(run: Path, *options: str) -> dict[str, Any]:
    answer = CliRunner().invoke(detect_command.command, [str(run), "--json", *options], standalone_mode=False)
    assert answer.exception is None, answer.exception
    fields: dict[str, Any] = json.loads(answer.stdout)
    assert answer.return_value == (0 if fields["outcome"] == "FOCUSED" else 1)
    return fields


def test_the_detector_finds_in_a_run_what_the_cycle_found(run: Path) -> None:
    fields, kept, sweep = detected(run), load_run(run).result, read_run_sweep(run)
    assert kept is not None
    assert fields["outcome"] == kept["outcome"] == "FOCUSED"
    assert fields["method"] == kept["details"]["method"]
    assert fields["direction"] == ("receding" if kept["reversals"] else "approaching")
    assert fields["direction_decided_us"] < fields["focus_us"] < fields["decided_us"]
    path = Ruler.of_path(sweep.path_t_us, sweep.path_um)
    assert abs(path.position(fields["focus_us"]) - kept["focus_um"]) < kept["sigma_um"]
    assert fields["sigma_us"] * path.speed_at(fields["focus_us"]) == pytest.approx(kept["sigma_um"], rel=0.05)


def test_what_a_run_claims_is_not_believed_unseen(run: Path, tmp_path: Path) -> None:
    """A result that its own record does not reach again is searched for, not repeated."""
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    head = json.loads((copy / "run.json").read_text())
    head["result"]["focus_um"] += 1000.0
    (copy / "run.json").write_text(json.dumps(head))
    assert "run again" in detected(run)["reason"]
    assert "run again" not in detected(copy)["reason"]


def test_a_run_asked_another_question_is_searched(run: Path) -> None:
    assert "run again" not in detected(run, "--dof-um", "6")["reason"]


def test_a_run_that_turned_round_says_so(tmp_path: Path) -> None:
    run = recorded(tmp_path, camera="davis346", start_um=-80.0)
    kept, fields = load_run(run).result, detected(run)
    assert kept is not None
    assert kept["reversals"] == 1
    assert fields["outcome"] == kept["outcome"] == "FOCUSED"
    assert fields["direction"] == "receding"
    assert fields["direction_decided_us"] < fields["focus_us"] < fields["decided_us"]


def test_the_same_seed_writes_the_same_bytes(run: Path, tmp_path: Path) -> None:
    camera = load_run(run).config["sim"]["camera"]
    assert contents(recorded(tmp_path, camera=camera)) == contents(run)


def test_other_settings_reach_another_decision_and_the_replay_says_where(run: Path, tmp_path: Path) -> None:
    changed = tmp_path / run.name
    changed.mkdir()
    for name, content in contents(run).items():
        (changed / name).parent.mkdir(exist_ok=True)
        (changed / name).write_bytes(content)
    head = json.loads((changed / "run.json").read_text())
    head["config"]["focus"]["roi_fraction"] = 0.25
    (changed / "run.json").write_text(json.dumps(head))
    answer = CliRunner().invoke(replay_command.command, [str(changed)], standalone_mode=False)
    assert answer.return_value == 1
    assert "not identical; first difference: decision " in answer.stdout
    assert '"roi":[' in answer.stdout


def test_a_cancelled_run_replays(tmp_path: Path) -> None:
    polls = iter(range(10**6))
    session = focus_once(config_for(tmp_path), FocusRequest(), cancelled=lambda: next(polls) >= 40)
    assert session.result.outcome is Outcome.CANCELLED
    assert session.run is not None
    report = replay_run(load_run(session.run), replay_command.run_cycle)
    assert report.first_difference is None


@pytest.fixture(scope="module")
def undisturbed() -> dict[str, FocusResult]:
    """How the cycles end with no journal at all."""
    return {
        camera: focus_once(
            Config.model_validate({"journal": {"enabled": False}, "sim": {"seed": 4, "camera": camera}}), FocusRequest()
        ).result
        for camera in ("evk4", "davis346")
    }


@pytest.mark.parametrize(
    ("full", "camera"),
    [("tape.jsonl", "evk4"), ("events.raw", "evk4"), ("decisions.jsonl", "davis346"), ("run.json.tmp", "davis346")],
)
def test_a_full_disk_changes_nothing_about_the_cycle(
    undisturbed: dict[str, FocusResult], tmp_path: Path, full: str, camera: str
) -> None:
    def opener(path: Path, mode: str, /) -> Any:
        return open_file(Path("/dev/full") if path.name == full else path, mode)

    config, request = config_for(tmp_path, camera=camera), FocusRequest()
    parts = rig.build(config)
    with structlog.testing.capture_logs() as logs:
        with RunWriter.begin(config, request, parts, opener=opener) as run:
            result = FocusCycle(run.parts, CycleSettings.from_config(config), request, run).run()
        rig.release(parts)
    assert result == undisturbed[camera]
    assert run.truncated is not None
    assert "No space left on device" in run.truncated
    assert [entry["event"] for entry in logs] == ["journal truncated; focus goes on"]
