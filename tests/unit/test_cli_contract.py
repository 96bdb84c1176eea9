"""What other programs rely on: one JSON object with the documented fields, the exit codes, and errors without harm."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from command_line import SMALL_RIG, Answer, caller
from elpd_drivers.formats.raw import write_raw
from elpd_drivers.lenses.serial_port import SerialPort

from elpd.cli import COMMANDS
from elpd.cli.sim_board import find_board
from elpd.events.evt3_encode import Evt3Encoder
from elpd.records import Geometry, Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from elpd.ports import RunningBoard

ROOT = Path(__file__).parents[2]


def _words(text: str) -> set[str]:
    return set(text.split())


# The documented fields (tools/docs/json.md). More may be added, none renamed.
DECODE = _words(
    "format width height events on first_us last_us triggers frames imu rate_controller digest lost lost_reason "
    "warnings"
)
MAP = _words("width height fired_fraction open_us hot_pixels filled_pixels dynamic_range_db out")
DETECT = _words(
    "outcome direction direction_decided_us elp_crossing_us focus_us sigma_us decided_us method events windows reason"
)
FOCUS = _words(
    "outcome reason reversals focus_um sigma_um stop_um final_um stop_latency_us duration_ms phases events lost truth"
)
TRUTH = {"focus_um", "estimate_error_um", "stop_error_um", "final_error_um"}
GROUPS = {"calibrate": ("calibrate", "sensor")}
OUTCOMES = {outcome.value for outcome in Outcome}


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A thousand events of a 64x48 sensor in EVT3."""
    rng = np.random.default_rng(3)
    encoder = Evt3Encoder(64)
    t = np.sort(rng.integers(0, 50_000, 1000))
    words = encoder.encode(t, rng.integers(0, 64, 1000), rng.integers(0, 48, 1000), rng.integers(0, 2, 1000)).copy()
    path = tmp_path / "recording.raw"
    write_raw(path, Geometry(64, 48), [words], {})
    return path


@pytest.fixture
def board() -> Iterator[RunningBoard]:
    """A simulated Tic on a pty, as a lens that somebody else may hold."""
    running = find_board("tic").serve({"seed": 1, "um_per_step": 0.3125})
    yield running
    running.close()


# --- the fields --------------------------------------------------------------------------------------------------


def test_focus_answers_with_its_fields(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    answer = elpd("focus", *SMALL_RIG, "--json")
    fields = answer.json
    assert (answer.code, answer.err, fields["outcome"]) == (0, "", "FOCUSED")
    assert fields.keys() >= FOCUS
    assert fields["truth"].keys() >= TRUTH
    assert all(phase.keys() >= {"name", "ms"} for phase in fields["phases"])
    assert isinstance(fields["stop_latency_us"], int)
    assert {"lens.run", "lens.move_to"} <= set(_motions(tmp_path / "runs"))


def test_a_focus_that_is_not_found_has_the_same_fields_and_exits_with_1(elpd: Callable[..., Answer]) -> None:
    answer = elpd("focus", *SMALL_RIG, "--set", "sim.scene=flat", "--json")
    fields = answer.json
    assert answer.code == 1
    assert fields.keys() >= FOCUS
    assert fields["outcome"] in OUTCOMES - {"FOCUSED"}
    assert fields["focus_um"] is None
    assert fields["reason"]


def test_a_dry_run_does_everything_but_motion(elpd: Callable[..., Answer]) -> None:
    fields = elpd("focus", *SMALL_RIG, "--dry-run", "--json").json
    assert fields["truth"]["final_error_um"] == -200.0
    assert "nothing was moved" in fields["reason"]


def test_expose_keeps_a_map_that_focus_uses(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    exposed = elpd("expose", *SMALL_RIG, "--out", "map.png", "--json")
    assert exposed.code == 0
    assert exposed.json.keys() >= MAP
    assert exposed.json["out"] == "map.png"
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    focused = elpd("focus", *SMALL_RIG, "--reference", "last", "--json")
    assert (focused.code, focused.json["outcome"]) == (0, "FOCUSED")


def test_expose_in_the_dark_has_the_same_fields_exits_with_1_and_keeps_nothing(
    elpd: Callable[..., Answer], tmp_path: Path
) -> None:
    dark = elpd("expose", *SMALL_RIG, "--set", "sim.cap=true", "--out", "map.png", "--json")
    assert dark.code == 1
    assert dark.json.keys() >= MAP
    assert dark.json["out"] is None
    assert list(tmp_path.iterdir()) == []


def test_decode_and_detect_answer_with_their_fields(elpd: Callable[..., Answer], recording: Path) -> None:
    decoded = elpd("decode", str(recording), "--json")
    assert (decoded.code, decoded.err) == (0, "")
    assert decoded.json.keys() >= DECODE
    assert decoded.json["events"] == 1000
    assert decoded.json["digest"].keys() == {"t", "x", "y", "on"}
    detected = elpd("detect", str(recording), "--speed-um-s", "4000", "--json")
    assert detected.code == 1
    assert detected.json.keys() >= DETECT
    assert detected.json["outcome"] in OUTCOMES - {"FOCUSED"}
    assert detected.json["direction"] in {"approaching", "receding", "unknown"}


def test_a_run_of_focus_can_be_replayed_and_read_as_a_sweep(elpd: Callable[..., Answer]) -> None:
    run = elpd("focus", *SMALL_RIG, "--set", "sim.seed=2", "--json").json["run"]
    replayed = elpd("replay", run, "--json")
    assert (replayed.code, replayed.json["identical"]) == (0, True)
    assert replayed.json.keys() >= FOCUS
    detected = elpd("detect", run, "--json")
    assert detected.code in {0, 1}
    assert detected.json.keys() >= DETECT
    assert detected.json["events"] > 1000


def test_every_command_of_the_list_is_there_and_helps(elpd: Callable[..., Answer]) -> None:
    for name in COMMANDS:
        told = elpd(*GROUPS.get(name, (name,)), "--help")
        assert told.code == 0
        for option in ("--json", "--config", "--set"):
            assert option in told.out, (name, option)


# --- what is refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "code", "kind", "told"),
    [
        (["dance"], 2, "UsageError", "there is no command 'dance'; there are calibrate, cancel"),
        ([], 2, "UsageError", "No such option"),
        (["focus", "--foregruond"], 2, "UsageError", "No such option"),
        (["focus"], 4, "BusyError", "no daemon has made this socket"),
        (["focus", "--foreground", "--roi", "10,10,0,0"], 2, "UsageError", "empty"),
        (["focus", "--foreground", "--roi", "1200,10,200,200"], 2, "UsageError", "1280x720"),
        (["focus", "--foreground", "--roi", "1,2,3"], 2, "UsageError", "X,Y,W,H"),
        (["focus", "--foreground", "--reference", "last"], 2, "UsageError", "make one with `elpd expose`"),
        (["focus", "--foreground", "--reference", "text.txt"], 2, "FormatError", "not a picture"),
        (["focus", "--set", "focus.deadlin_ms=3"], 2, "ConfigError", "deadline_ms"),
        (["focus", "--set", "sim.sede=3"], 2, "ConfigError", "unknown key"),
        (["focus", "--set", "sim.seed"], 2, "ConfigError", "KEY=VALUE"),
        (["focus", "--set", "sim.scene=moon"], 2, "ConfigError", "known: random"),
        (["focus", "--config", "absent.toml"], 2, "ConfigError", "No such file"),
        (["focus", "--config", "text.txt"], 2, "ConfigError", "line 1"),
        (["focus", "--config", "typo.toml"], 2, "ConfigError", "typo.toml:2"),
        (
            ["focus", "--set", "lens.driver=abacus"],
            2,
            "ConfigError",
            "installed: avr, grbl, scf4, theia, tic, tmcl, zaber",
        ),
        (["focus", "--set", "lens.driver=tic"], 2, "ConfigError", "lens.port is empty"),
        (["focus", "--set", "lens.driver=tic", "--set", "lens.port=absent"], 3, "LensError", "there is no such port"),
        (["focus", "--set", "lens.driver=grbl", "--set", "lens.port=text.txt"], 3, "LensError", "lens port text.txt"),
        (["expose", "--out", "absent/map.png"], 2, "UsageError", "there is no folder"),
        (["decode", "absent.raw"], 2, "FormatError", "No such file"),
        (["decode", "text.txt"], 2, "FormatError", "in no format"),
        (["decode", "empty.raw"], 2, "FormatError", "empty"),
        (["detect", "absent"], 2, "UsageError", "no such file"),
        (["detect", "text.txt"], 2, "FormatError", "in no format"),
        (["detect", "recording.raw", "--roi", "60,0,20,20"], 2, "UsageError", "does not fit"),
        (["detect", "recording.raw", "--roi", "0,0,0,0"], 2, "UsageError", "does not fit"),
        (["detect", "recording.raw", "--dof-um", "0"], 2, "UsageError", "positive"),
        (["temporal-map", "text.txt"], 2, "FormatError", "in no format"),
        (["decode", "recording.raw", "--set", "focus.roy=1"], 2, "ConfigError", "unknown key"),
        (["replay", "text.txt"], 2, "FormatError", "run folder"),
        (["sim-board", "abacus"], 2, "UsageError", "known are avr, grbl, scf4, theia, tic, tmcl, zaber"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_bad_input_is_told_without_a_traceback(
    elpd: Callable[..., Answer],
    recording: Path,
    arguments: list[str],
    code: int,
    kind: str,
    told: str,
) -> None:
    (recording.parent / "text.txt").write_text("hello world\n")
    (recording.parent / "empty.raw").touch()
    (recording.parent / "typo.toml").write_text("[focus]\ndeadlin_ms = 3\n")
    answer = elpd(*arguments, "--json")
    assert answer.code == code
    assert answer.json["outcome"] is None
    assert answer.json["error"]["kind"] == kind
    assert told in answer.json["error"]["message"]
    assert answer.json["error"]["message"] in answer.err
    assert _motions(recording.parent / "runs") == []


@pytest.mark.parametrize("cut", [1, 2, 17, 400])
def test_a_truncated_recording_is_read_as_far_as_it_goes(
    elpd: Callable[..., Answer], recording: Path, cut: int
) -> None:
    recording.write_bytes(recording.read_bytes()[:-cut])
    decoded = elpd("decode", str(recording), "--json")
    assert decoded.code == 0
    assert 0 < decoded.json["events"] < 1000
    assert elpd("detect", str(recording), "--json").code == 1


def test_a_file_of_another_format_is_told_by_its_content(elpd: Callable[..., Answer], recording: Path) -> None:
    recording.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    answer = elpd("detect", str(recording), "--json")
    assert (answer.code, answer.json["error"]["kind"]) == (2, "FormatError")


def test_a_lens_that_another_program_holds_is_busy_and_does_not_move(
    elpd: Callable[..., Answer], board: RunningBoard
) -> None:
    held = SerialPort(board.port, 9600)
    try:
        answer = elpd("focus", "--set", "lens.driver=tic", "--set", f"lens.port={board.port}", "--json")
    finally:
        held.close()
    assert answer.code == 4
    assert answer.json["error"]["kind"] == "BusyError"
    assert "in use" in answer.json["error"]["message"]


def test_a_folder_that_cannot_be_written_is_told(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    answer = elpd("expose", *SMALL_RIG, "--set", "journal.directory=file/runs", "--json")
    assert answer.code == 2
    assert "file/runs" in answer.json["error"]["message"]


def _motions(runs: Path) -> list[str]:
    """Return the calls that move a lens, over all runs of a folder."""
    calls = [
        json.loads(line).get("call") for tape in runs.glob("*/tape.jsonl") for line in tape.read_text().splitlines()
    ]
    return [call for call in calls if call in {"lens.run", "lens.move_to", "lens.home"}]


# --- the package -------------------------------------------------------------------------------------------------


def test_the_real_program_prints_json_alone_and_returns_its_code(tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", "from elpd.cli import main; main()", "focus", "--json"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 4
    assert json.loads(ended.stdout)["error"]["kind"] == "BusyError"
    assert ended.stderr.startswith("elpd: ")
    assert "no daemon has made this socket" in ended.stderr


def test_the_wheel_takes_all_that_the_packages_need() -> None:
    tables = _pyproject()
    assert tables["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"] == ["elpd", "drivers/elpd_drivers"]
    for needed in ("elpd/py.typed", "drivers/elpd_drivers/py.typed", "drivers/elpd_drivers/sim/scenes/camera.jpg"):
        assert (ROOT / needed).is_file()
        ignored = subprocess.run(["git", "check-ignore", "-q", needed], cwd=ROOT, check=False).returncode
        assert ignored != 0, f"{needed} is ignored by git, and so left out of the wheel"


def test_every_entry_point_is_installed_and_loads() -> None:
    for group, points in _pyproject()["project"]["entry-points"].items():
        installed = {point.name: point for point in metadata.entry_points(group=group)}
        for name, value in points.items():
            assert installed[name].value == value
            installed[name].load()


def _pyproject() -> dict[str, Any]:
    import tomllib  # noqa: PLC0415

    return tomllib.loads((ROOT / "pyproject.toml").read_text())
