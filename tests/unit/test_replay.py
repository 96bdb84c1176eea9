from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from scripted_rig import scripted_rig, small_cycle, small_world

from elpd.config import Config
from elpd.errors import FormatError, LensError
from elpd.record.journal import RunWriter
from elpd.record.replay import RecordedRun, load_run, replay_run
from elpd.records import StopMode

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from elpd.ports import RigParts, RunSink


def again(parts: RigParts, run: RecordedRun, sink: RunSink, cancelled: Callable[[], bool]) -> dict[str, Any]:
    del run
    return small_cycle(parts, sink, cancelled=cancelled)


@pytest.fixture
def run(tmp_path: Path) -> RecordedRun:
    config = Config.model_validate({"journal": {"directory": tmp_path}})
    with RunWriter.begin(config, {}, scripted_rig(small_world(5))) as writer:
        writer.finish(small_cycle(writer.parts, writer, cancelled=writer.watch(lambda: False)), truth={"focus_um": 1.0})
    assert writer.path is not None
    return load_run(writer.path)


def test_the_same_code_reaches_the_same_decision(run: RecordedRun) -> None:
    report = replay_run(run, again)
    assert report.identical
    assert report.first_difference is None
    assert report.result == run.result
    assert report.calls == 64


def test_a_cancelled_run_is_cancelled_again(tmp_path: Path) -> None:
    config = Config.model_validate({"journal": {"directory": tmp_path}})
    polls = iter([False] * 7 + [True])
    answers = small_world(5)
    with RunWriter.begin(config, {}, scripted_rig(answers[: 2 + 3 * 7] + answers[-2:])) as writer:
        writer.finish(small_cycle(writer.parts, writer, cancelled=writer.watch(lambda: next(polls))))
    assert replay_run(load_run(writer.path), again).identical


def test_a_different_decision_is_named(run: RecordedRun) -> None:
    def changed(parts: RigParts, run: RecordedRun, sink: RunSink, cancelled: Callable[[], bool]) -> dict[str, Any]:
        class Skewed:
            def note(self, event: str, /, **fields: Any) -> None:
                sink.note(event, **{**fields, "total": fields["total"] + 1} if "total" in fields else fields)

        return again(parts, run, Skewed(), cancelled)

    report = replay_run(run, changed)
    assert not report.identical
    assert report.first_difference is not None
    assert report.first_difference.startswith('decision 2: recorded {"event":"window","position_um":0.0,')


def test_a_different_question_is_named(run: RecordedRun) -> None:
    def changed(parts: RigParts, run: RecordedRun, sink: RunSink, cancelled: Callable[[], bool]) -> dict[str, Any]:
        parts.lens.stop(StopMode.RAMPED)
        return again(parts, run, sink, cancelled)

    report = replay_run(run, changed)
    assert report.first_difference == "at call 1: recorded camera.start[], asked lens.stop[1]"
    assert report.result is None


def test_a_different_result_is_named(run: RecordedRun) -> None:
    report = replay_run(run, lambda *arguments: {**again(*arguments), "focus_um": 4.0})
    assert report.first_difference is not None
    assert report.first_difference.startswith("result: focus_um: recorded ")
    assert report.first_difference.endswith("replayed 4.0")


def test_a_cycle_that_ends_early_is_named(run: RecordedRun) -> None:
    report = replay_run(run, lambda *_: dict(run.result or {}))
    assert report.first_difference is not None
    assert report.first_difference.startswith("decision 1: recorded")


def test_calls_that_nobody_repeats_are_counted(tmp_path: Path) -> None:
    config = Config.model_validate({"journal": {"directory": tmp_path}})
    with RunWriter.begin(config, {}, scripted_rig([1, 2, None])) as writer:
        writer.parts.clock.now_ns()
        writer.parts.clock.now_ns()
        writer.parts.camera.close()  # type: ignore[attr-defined]
        writer.finish({})

    def shorter(parts: RigParts, *_: Any) -> dict[str, Any]:
        parts.clock.now_ns()
        return {}

    report = replay_run(load_run(writer.path), shorter)
    assert report.first_difference == "the replay ended after 1 calls; 1 more were recorded"


def test_a_run_that_broke_breaks_again_in_the_same_way(tmp_path: Path) -> None:
    config = Config.model_validate({"journal": {"directory": tmp_path}})
    answers = [*small_world(1)[:10], LensError("lens: no reply for 52 ms (limit 50); check the cable")]
    with pytest.raises(LensError), RunWriter.begin(config, {}, scripted_rig(answers)) as writer:
        small_cycle(writer.parts, writer, cancelled=writer.watch(lambda: False))
    report = replay_run(load_run(writer.path), again)
    assert report.identical
    assert report.error == {"kind": "LensError", "message": "lens: no reply for 52 ms (limit 50); check the cable"}


def test_an_incomplete_recording_is_never_identical(run: RecordedRun) -> None:
    tape = run.path / "tape.jsonl"
    lines = tape.read_bytes().splitlines(keepends=True)
    tape.write_bytes(b"".join(lines[:-1]))
    report = replay_run(run, again)
    assert report.first_difference == (
        "the recording is incomplete: the tape ends without its closing line: the recording was cut off"
    )


def test_what_is_no_run_is_refused_with_what_was_found(run: RecordedRun, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="it holds 1 of them; the newest is"):
        load_run(tmp_path)
    with pytest.raises(FormatError, match="it does not exist"):
        load_run(tmp_path / "nowhere")
    with pytest.raises(FormatError, match="it is a file"):
        load_run(run.path / "tape.jsonl")
    (run.path / "run.json").rename(run.path / "run.txt")
    with pytest.raises(FormatError, match=r"it has no run\.json; found decisions\.jsonl, events\.raw, run\.txt"):
        load_run(run.path)
    (run.path / "run.json").write_text("{}")
    with pytest.raises(FormatError, match="is not a run of elpd"):
        load_run(run.path)
    (run.path / "run.json").write_text((run.path / "run.txt").read_text().replace('"format": 1', '"format": 9'))
    with pytest.raises(FormatError, match="run format 9, this elpd reads 1"):
        load_run(run.path)
