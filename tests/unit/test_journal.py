from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
import pytest
import structlog
from scripted_rig import scripted_rig, small_cycle, small_world

from elpd.config import Config
from elpd.record.codec import note_line, to_json
from elpd.record.journal import RESERVE_BYTES, RunWriter, forget_old_runs, is_run
from elpd.record.replay import load_run
from elpd.record.tape import tape_rig
from elpd.records import Outcome, Roi

NOON = datetime(2026, 11, 22, 12, 0, 0, tzinfo=UTC)


def config_for(directory: Path, **journal: Any) -> Config:
    return Config.model_validate({"journal": {"directory": directory, **journal}, "sim": {"seed": 3}})


def record(directory: Path, seed: int = 1, request: Any = None, **options: Any) -> RunWriter:
    writer = RunWriter(config_for(directory), request or {"roi": Roi(1, 2, 3, 4)}, **options)
    parts = tape_rig(scripted_rig(small_world(seed)), writer.tape)
    writer.finish(small_cycle(parts, writer), truth={"focus_um": 12.5})
    return writer


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class FailingFile:
    """A file on a disk that fills up after some bytes, as buffered files do: at any write, and again at close."""

    def __init__(self, file: IO[bytes], room: list[int]) -> None:
        self.file, self.room = file, room

    def write(self, data: bytes) -> int:
        self.room[0] -= len(data)
        if self.room[0] < 0:
            raise OSError(28, "No space left on device")
        return self.file.write(data)

    def flush(self) -> None:
        self.file.flush()

    def fileno(self) -> int:
        return self.file.fileno()

    def close(self) -> None:
        self.file.close()
        if self.room[0] < 0:
            raise OSError(28, "No space left on device")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def disk_with_room(size: int) -> Any:
    room = [size]

    def opener(path: Path, mode: str, /) -> Any:
        return FailingFile(path.open(mode), room)

    return opener


def test_a_run_says_who_what_and_how_it_ended(tmp_path: Path) -> None:
    run = load_run(record(tmp_path, started_utc=NOON).path)
    assert run.path.name == "20261122T120000Z-001"
    assert run.request == {"roi": {"x": 1, "y": 2, "width": 3, "height": 4}}
    assert run.config["sim"]["seed"] == 3
    assert "journal" not in run.config
    assert run.result is not None
    assert run.result["outcome"] == "FOCUSED"
    assert run.truth == {"focus_um": 12.5}
    assert run.error is None
    assert run.truncated is None
    notes = [json.loads(line) for line in (run.path / "decisions.jsonl").read_text().splitlines()]
    assert [note["event"] for note in notes] == ["phase", *["window"] * 20, "phase"]
    assert notes[1]["score"] == "nan"
    Config.model_validate(run.config)


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    one, two, other = (record(tmp_path, seed, started_utc=NOON).path for seed in (1, 1, 2))
    assert [folder.name[-3:] for folder in (one, two, other)] == ["001", "002", "003"]
    assert contents(one) == contents(two)
    assert contents(one).keys() == {"run.json", "tape.jsonl", "events.raw", "decisions.jsonl"}
    assert contents(one) != contents(other)


def test_an_error_ends_the_run_with_its_kind(tmp_path: Path) -> None:
    with pytest.raises(IndexError), RunWriter.begin(config_for(tmp_path), {}, scripted_rig(small_world(1)[:9])) as run:
        small_cycle(run.parts, run)
    recorded = load_run(run.path)
    assert recorded.error == {"kind": "IndexError", "message": "pop from an empty deque"}
    assert recorded.result is None


def test_without_a_journal_the_rig_is_left_alone(tmp_path: Path) -> None:
    parts = scripted_rig(small_world(1))
    with RunWriter.begin(config_for(tmp_path / "runs", enabled=False), {}, parts) as run:
        assert run.parts is parts
        run.finish(small_cycle(run.parts, run))
    assert run.path is None
    assert not (tmp_path / "runs").exists()


def test_only_the_newest_runs_are_kept_and_strangers_never_touched(tmp_path: Path) -> None:
    runs = [record(tmp_path, 1, started_utc=NOON.replace(second=second)).path for second in range(5)]
    (tmp_path / "20200101T000000Z-001").mkdir()  # our kind of name, no run.json
    (tmp_path / "20200101T000000Z-002").mkdir()
    (tmp_path / "20200101T000000Z-002" / "run.json").write_text('{"of": "somebody else"}')
    (tmp_path / "20200101T000000Z-003").symlink_to(runs[4])
    runs[0].rename(tmp_path / "the good one")
    assert forget_old_runs(tmp_path, keep=2) == runs[1:3]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "20200101T000000Z-001",
        "20200101T000000Z-002",
        "20200101T000000Z-003",
        runs[3].name,
        runs[4].name,
        "the good one",
    ]
    assert is_run(tmp_path / "the good one")


def test_a_new_run_lets_the_oldest_go(tmp_path: Path) -> None:
    config = config_for(tmp_path, keep=2)
    for second in range(4):
        RunWriter(config, {}, started_utc=NOON.replace(second=second)).finish(None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["20261122T120002Z-001", "20261122T120003Z-001"]


@pytest.mark.parametrize("room", [0, 500, 2_000, 4_000, 8_000, 11_000])
def test_a_disk_that_fills_up_stops_the_journal_and_not_the_cycle(tmp_path: Path, room: int) -> None:
    with structlog.testing.capture_logs() as logs:
        writer = RunWriter(config_for(tmp_path), {}, opener=disk_with_room(room))
        result = small_cycle(tape_rig(scripted_rig(small_world(1)), writer.tape), writer)
        writer.finish(result)
        writer.finish(result)
    assert result["outcome"] == "FOCUSED"
    assert writer.truncated is not None
    assert "No space left on device" in writer.truncated
    assert [entry["event"] for entry in logs] == ["journal truncated; focus goes on"]


def test_the_mark_is_written_where_a_few_bytes_still_fit(tmp_path: Path) -> None:
    def opener(path: Path, mode: str, /) -> Any:
        return path.open(mode) if path.name.startswith("run.json") else Path("/dev/full").open(mode)

    with structlog.testing.capture_logs():
        writer = RunWriter(config_for(tmp_path), {}, opener=opener)
        writer.finish(small_cycle(tape_rig(scripted_rig(small_world(1)), writer.tape), writer))
    run = load_run(writer.path)
    assert run.truncated is not None
    assert "No space left" in run.truncated
    assert run.result is not None


def test_the_reserve_of_the_disk_is_left_to_others(tmp_path: Path) -> None:
    with structlog.testing.capture_logs() as logs:
        writer = record(tmp_path, free_bytes=lambda path: RESERVE_BYTES)
    assert writer.truncated is not None
    assert "67 MB free, 67 MB needed with the reserve of 67 MB" in writer.truncated
    assert len(logs) == 1
    assert contents(writer.path).keys() == {"run.json", "tape.jsonl"}


def test_a_folder_that_cannot_be_made_is_one_warning(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with structlog.testing.capture_logs() as logs:
        writer = record(tmp_path / "file" / "runs")
    assert writer.path is None
    assert len(logs) == 1
    assert "journal.directory" in logs[0]["reason"]


def test_a_tape_out_of_memory_leaves_the_notes(tmp_path: Path) -> None:
    with structlog.testing.capture_logs() as logs:
        writer = RunWriter(config_for(tmp_path, memory_mb=0.004), {})
        writer.finish(small_cycle(tape_rig(scripted_rig(small_world(1)), writer.tape), writer))
    run = load_run(writer.path)
    assert run.truncated is not None
    assert "journal.memory_mb" in run.truncated
    assert len((run.path / "decisions.jsonl").read_text().splitlines()) == 22
    assert len(logs) == 1


def test_a_file_that_the_request_names_is_copied(tmp_path: Path) -> None:
    reference = tmp_path / "picture.png"
    reference.write_bytes(b"not really")
    run = load_run(record(tmp_path / "runs", request={"reference": reference, "roi": None}).path)
    reference.unlink()
    assert run.attachment("reference") == run.path / "reference.png"
    assert run.attachment("roi") is None
    assert (run.path / "reference.png").read_bytes() == b"not really"


def test_values_have_one_form() -> None:
    assert note_line("phase", {}) == '{"event":"phase"}'
    assert note_line("x", {"b": np.int64(2), "a": (np.float64(0.1), True, None)}) == (
        '{"event":"x","a":[0.1,true,null],"b":2}'
    )
    assert to_json({"o": Outcome.FOCUSED, "f": [float("inf"), float("-inf"), np.float32("nan")]}) == (
        '{"o":"FOCUSED","f":["inf","-inf","nan"]}'
    )
    assert to_json(np.arange(3)) == "[0,1,2]"
    with pytest.raises(TypeError, match="has no place in a journal"):
        to_json(object())
