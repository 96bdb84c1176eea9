"""The command line as a client of the daemon: what goes out, what is told, and the exit codes."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

import pytest
from command_line import Answer, caller
from sockets import press_ctrl_c, serving

from elpd.service.messages import (
    Fault,
    Holder,
    LeaseAnswer,
    MapAnswer,
    PhaseEvent,
    RunAnswer,
    RunsAnswer,
    RunSummary,
    SampleEvent,
    TemperatureAnswer,
    Warned,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from fake_engine import FakeEngine


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ELPD_SOCKET", str(tmp_path / "elpd.sock"))
    return tmp_path / "elpd.sock"


@pytest.fixture
def engine(path: Path) -> Iterator[FakeEngine]:
    with serving(path) as engine:
        yield engine


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


def once_it_runs(engine: FakeEngine, *then: Callable[[], object]) -> threading.Thread:
    """Do something as soon as the engine has a motion."""

    def wait() -> None:
        engine.heard(lambda: bool(engine.accepted))
        for act in then:
            act()

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


def test_focus_goes_to_the_daemon(elpd: Callable[..., Answer], engine: FakeEngine) -> None:
    watcher = once_it_runs(engine, engine.finish)
    answer = elpd("focus", "--roi", "1,2,3,4", "--reference", "map.png", "--json")
    watcher.join()
    assert (answer.code, answer.json["outcome"], answer.json["final_um"]) == (0, "FOCUSED", 812.6)
    assert "truth" not in answer.json
    asked = engine.requests[0].params.model_dump(exclude_unset=True)
    assert asked["roi"] == {"x": 1, "y": 2, "width": 3, "height": 4}
    assert asked["reference"].startswith("/")  # the daemon has another working directory
    assert asked["reference"].endswith("/map.png")


def test_focus_shows_what_the_daemon_tells(elpd: Callable[..., Answer], engine: FakeEngine) -> None:
    watcher = once_it_runs(
        engine,
        lambda: engine.tell(PhaseEvent(phase="probe")),
        lambda: engine.tell(SampleEvent(t_us=5, position_um=None, elp=7, score=None, events=3)),
        lambda: engine.tell(PhaseEvent(phase="sweep", progress=0.5)),
        lambda: engine.finish("NO_CROSSING"),
    )
    answer = elpd("focus")
    watcher.join()
    assert answer.code == 1
    assert [line.split()[0] for line in answer.err.splitlines()] == ["probe", "sweep", "NO_CROSSING:"]
    assert "progress=0.5  (1 windows)" in answer.err
    assert "NO_CROSSING: so it was told" in answer.out


def test_ctrl_c_ends_the_cycle_and_tells_how(elpd: Callable[..., Answer], engine: FakeEngine) -> None:
    watcher = once_it_runs(engine, press_ctrl_c)
    answer = elpd("focus", "--json")
    watcher.join()
    assert (answer.code, answer.json["outcome"]) == (1, "CANCELLED")


@pytest.mark.parametrize(
    ("arguments", "params"),
    [
        (["home"], {}),
        (["move", "12.5"], {"to_um": 12.5}),
        (["jog", "-20"], {"by_um": -20.0}),
    ],
)
def test_errands_go_to_the_daemon(
    elpd: Callable[..., Answer], engine: FakeEngine, arguments: list[str], params: dict[str, float]
) -> None:
    watcher = once_it_runs(engine, engine.finish)
    answer = elpd(*arguments, "--json")
    watcher.join()
    assert (answer.code, answer.json["outcome"], answer.json["position_um"]) == (0, "OK", 10.0)
    assert answer.json.keys() >= {
        "outcome", "position_um", "position_steps", "from_um", "referenced", "duration_ms", "limits_um",
    }  # fmt: skip
    assert engine.requests[0].params.model_dump(exclude_unset=True) == params


def test_stop_says_nothing_before_it_has_stopped(elpd: Callable[..., Answer], engine: FakeEngine) -> None:
    assert elpd("stop").code == 0
    assert next(call for call in engine.calls if call not in {"counted", "beat"}) == "stop"


def test_what_the_daemon_does_not_have_is_told(elpd: Callable[..., Answer], engine: FakeEngine) -> None:
    for arguments in (["move", "3", "--speed", "10"], ["home", "--limit", "3"]):
        answer = elpd(*arguments, "--json")
        assert (answer.code, answer.json["error"]["kind"]) == (2, "UsageError")
    assert engine.requests == []


def test_a_daemon_and_a_rig_of_ones_own_are_not_for_one_command(elpd: Callable[..., Answer], path: Path) -> None:
    answer = elpd("focus", "--socket", str(path), "--foreground", "--json")
    assert (answer.code, answer.json["error"]["kind"]) == (2, "UsageError")
    answer = elpd("focus", "--foreground", "--preset", "near", "--json")
    assert (answer.code, answer.json["error"]["kind"]) == (2, "UsageError")


def test_busy_is_4_and_so_is_nobody(elpd: Callable[..., Answer], path: Path) -> None:
    assert elpd("status", "--json").json["error"]["kind"] == "UnreachableError"
    assert elpd("status").code == elpd("focus").code == elpd("cancel").code == 4
    with serving(path) as engine:
        engine.begin("focus")
        answer = elpd("focus", "--json")
    assert (answer.code, answer.json["error"]["kind"]) == (4, "BusyError")


def test_status_is_for_people_and_for_programs(elpd: Callable[..., Answer], engine: FakeEngine) -> None:
    answer = elpd("status")
    assert answer.code == 0
    assert answer.out.startswith("elpd      READY   one-shot   fake   up 1 s\n")
    assert "camera    fake, not connected" in answer.out
    assert elpd("status", "--json").json["lens"]["driver"] == "fake"


def test_status_tells_trouble(elpd: Callable[..., Answer], engine: FakeEngine) -> None:
    engine.changes = {
        "state": "FAULT",
        "fault": Fault(kind="LensError", message="lens: no reply", at_s=0.0),
        "warnings": [Warned(code="dark", text="it is dark")],
        "lease": LeaseAnswer(holder=Holder(pid=12, uid=0, name="python"), until_s=30.0),
        "ticks": {"focus": 9.0, "api": 0.1},
        "uptime_s": 200_000.0,
    }
    answer = elpd("status")
    assert answer.code == 3
    for told in (
        "LensError: lens: no reply; `elpd clear`",
        "it is dark",
        "python (process 12",
        "focus loop",
        "2 d 7 h",
    ):
        assert told in answer.out
    assert "api loop" not in answer.out


def test_small_commands(elpd: Callable[..., Answer], engine: FakeEngine) -> None:
    assert "nothing runs" in elpd("cancel").out
    assert "no fault was latched; the rig is READY" in elpd("clear").out
    assert elpd("clear", "--json").json == {"cleared": None, "state": "READY"}
    assert elpd("preset", "save").code == 2
    assert elpd("roi", "--delete").code == 2
    assert elpd("roi", "--name", "left").code == 2


RUN = {"outcome": "FOCUSED", "reason": "by pairs", "focus_um": 812.5, "sigma_um": 0.4, "duration_ms": 103.2}


def test_runs_are_listed_and_told(elpd: Callable[..., Answer], engine: FakeEngine) -> None:
    one = RunSummary(name="20260101T000000Z-001", at="2026-01-01T00:00:00Z", kept=False, **RUN)
    two = RunSummary.model_validate(dict.fromkeys(RUN) | {"name": "mine", "at": None, "kept": True})
    engine.answers["runs"] = RunsAnswer(runs=[one, two])
    assert [line.split() for line in elpd("runs", "--limit", "2").out.splitlines()] == [
        ["20260101T000000Z-001", "FOCUSED", "812.50", "um", "sigma", "0.40", "103", "ms"],
        ["mine", "ERROR", "kept"],
    ]
    assert engine.requests[-1].params.model_dump() == {"limit": 2}
    assert [run["name"] for run in elpd("runs", "--json").json["runs"]] == ["20260101T000000Z-001", "mine"]
    result = RUN | {"warnings": ["hot pixels"]}
    engine.answers["run"] = RunAnswer(name="mine", result=result, samples=[(1.0, 2, 3.0, 4)], config={}, files=["a"])
    told = dict(line.split(maxsplit=1) for line in elpd("runs", "mine").out.splitlines())
    assert (told["outcome"], told["focus"], told["warning"]) == ("FOCUSED: by pairs", "812.5 um", "hot pixels")
    assert elpd("runs", "mine", "--json").json["samples"] == [[1.0, 2, 3.0, 4]]


def test_without_a_daemon_runs_are_read_from_their_folder(
    elpd: Callable[..., Answer], path: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "runs" / "20260101T000000Z-001"
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"result": RUN, "config": {}, "format": 1, "elpd": "0", "request": {}}))
    answer = elpd("runs", "--set", f"journal.directory={tmp_path / 'runs'}", "--json")
    assert (answer.code, answer.json["runs"][0]["focus_um"]) == (0, 812.5)
    assert "no daemon answers; from" in answer.err
    one = elpd("runs", "20260101T000000Z-001", "--set", f"journal.directory={tmp_path / 'runs'}", "--json")
    assert one.json["result"] == RUN
    assert elpd("runs", "nothing", "--set", f"journal.directory={tmp_path / 'runs'}").code == 2
    assert elpd("runs", "--set", f"journal.directory={tmp_path / 'none'}").out == "no runs yet; every cycle makes one\n"
    assert elpd("runs", "--socket", str(path), "--json").json["error"]["kind"] == "UnreachableError"


def test_the_picture_is_written_as_its_name_says(
    elpd: Callable[..., Answer], engine: FakeEngine, tmp_path: Path
) -> None:
    engine.answers["map"] = MapAnswer(
        kind="map", format="png16", width=4, height=2, sensor={"width": 4, "height": 2}, image="UE5H", age_s=1.25,
        position_um=812.5,
    )  # fmt: skip
    answer = elpd("map", "map.png", "--deep", "--kind", "map", "--json")
    assert (tmp_path / "map.png").read_bytes() == b"PNG"
    assert (answer.json["out"], answer.json["bytes"], answer.json["age_s"]) == ("map.png", 3, 1.25)
    assert "image" not in answer.json
    assert engine.requests[-1].params.model_dump() == {"kind": "map", "format": "png16", "max_width": None}
    assert elpd("map").out == "map, 4x2, 1.2 s old, lens at 812.50 um\n"
    assert elpd("map", "map.tiff").code == elpd("map", "map.jpg", "--deep").code == 2


def test_metrics_and_temperatures(elpd: Callable[..., Answer], engine: FakeEngine) -> None:
    assert elpd("metrics").out == "elpd_up 1\n"
    assert elpd("metrics", "--json").json == {"text": "elpd_up 1\n"}
    engine.answers["temperature"] = TemperatureAnswer(celsius=-5.0, offset_um=1.5)
    assert "moved by +1.50 um" in elpd("temperature", "-5").out
    assert engine.requests[-1].params.model_dump() == {"celsius": -5.0}
    engine.answers["temperature"] = TemperatureAnswer(celsius=20.0, offset_um=None)
    assert "nothing follows" in elpd("temperature", "20").out
    assert elpd("temperature", "20", "--json").json == {"celsius": 20.0, "offset_um": None}
    assert elpd("temperature", "warm").code == elpd("temperature", "1000").code == 2


def test_nobody_answers_any_of_them(elpd: Callable[..., Answer], path: Path) -> None:
    for command in (["map"], ["metrics"], ["temperature", "20"]):
        answer = elpd(*command, "--json")
        assert (answer.code, answer.json["error"]["kind"]) == (4, "UnreachableError")


def test_the_daemon_of_a_configuration_is_found(elpd: Callable[..., Answer], engine: FakeEngine, path: Path) -> None:
    path.with_name("rig.toml").write_text(f'[api]\nsocket = "{path}"\n')
    for option in (["--config", "rig.toml"], ["--set", f"api.socket={path}"], ["--socket", str(path)]):
        assert elpd("status", *option).code == 0


def test_a_command_to_the_daemon_is_light() -> None:
    modules = "elpd.cli.focus, elpd.cli.move, elpd.cli.status"
    code = f"import sys, {modules}; print({{'numba', 'pydantic', 'cv2'}} & set(sys.modules))"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout == "set()\n"
