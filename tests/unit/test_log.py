"""Log lines where they are read: both clocks in each, nothing lost silently, nothing repeated for ever."""

from __future__ import annotations

import json
import os
import resource
import socket
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import structlog
from hypothesis import given
from hypothesis import strategies as st

from elpd import log
from elpd.log.files import KEPT, JsonLines
from elpd.log.journald import Journal, encode, fields
from elpd.log.limits import BURST, Limits

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

S = 10**9


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    yield
    log.configure()  # closes what the test opened
    structlog.reset_defaults()


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def test_a_file_gets_every_value_as_json(tmp_path: Path) -> None:
    log.configure(file=tmp_path / "log" / "elpd.jsonl")
    structlog.get_logger().info(
        "focus cycle", sigma_um=float("nan"), events=np.int64(7), run=tmp_path, phases=[{"name": "probe", "ms": 3.5}]
    )
    (line,) = lines(tmp_path / "log" / "elpd.jsonl")
    assert line["event"] == "focus cycle"
    assert line["level"] == "info"
    assert line["sigma_um"] is None
    assert line["events"] == 7
    assert line["run"] == str(tmp_path)
    assert line["phases"] == [{"name": "probe", "ms": 3.5}]


def test_a_wall_clock_that_is_put_back_does_not_reorder_the_log(tmp_path: Path) -> None:
    wall = iter([1_900_000_000 * S + 123_456_789, 1_899_996_400 * S])
    monotonic = iter([5 * S, 6 * S])
    log.configure(file=tmp_path / "l", wall_ns=lambda: next(wall), monotonic_ns=lambda: next(monotonic))
    structlog.get_logger().warning("first")
    structlog.get_logger().warning("second")
    first, second = lines(tmp_path / "l")
    assert (first["timestamp"], second["timestamp"]) == ("2030-03-17T17:46:40.123456Z", "2030-03-17T16:46:40.000000Z")
    assert (first["monotonic_ns"], second["monotonic_ns"]) == (5 * S, 6 * S)


def test_a_person_gets_warnings_and_everything_when_asked_to(capsys: pytest.CaptureFixture[str]) -> None:
    log.configure()
    structlog.get_logger().info("focus cycle")
    structlog.get_logger().warning("journal truncated", reason="full")
    told = capsys.readouterr().err
    assert "journal truncated" in told
    assert "reason" in told
    assert "monotonic" not in told
    assert "focus cycle" not in told
    log.configure(verbose=True)
    structlog.get_logger().debug("window")
    assert "window" in capsys.readouterr().err


def test_a_file_that_cannot_be_opened_is_said_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        log.configure(file=tmp_path / "file" / "elpd.jsonl")


def test_files_do_not_grow_for_ever(tmp_path: Path) -> None:
    sink = JsonLines(tmp_path / "l", limit_bytes=1000)
    for number in range(200):
        sink({"event": "x", "number": number, "padding": "." * 100})
    sink.close()
    kept = sorted(tmp_path.iterdir())
    assert len(kept) == KEPT + 1
    assert all(path.stat().st_size <= 1000 for path in kept)
    assert lines(tmp_path / "l")[-1]["number"] == 199


def test_a_full_disk_costs_lines_that_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "l"
    sink = JsonLines(path)
    sink({"event": "before"})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size, limits[1]))  # Python ignores SIGXFSZ: write fails
    try:
        sink({"event": "lost"})
        sink({"event": "lost too"})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    sink({"event": "after"})
    sink({"event": "and on"})
    sink.close()
    assert capsys.readouterr().err.count("lines are lost") == 1
    whole = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if '"after"' in line]
    assert whole == [{"event": "after", "lost_lines": 2}]
    assert lines(path)[-1] == {"event": "and on"}


# --- repeated lines ----------------------------------------------------------------------------------------------


def passes(limits: Limits, name: str, at_ns: int, level: str = "warning") -> dict[str, Any] | None:
    try:
        return dict(limits(None, "", {"event": name, "level": level, "monotonic_ns": at_ns}))
    except structlog.DropEvent:
        return None


def test_a_line_that_comes_ten_times_a_second_is_written_once_a_second() -> None:
    limits = Limits()
    written = [at for at in range(1200) if passes(limits, "lens lost", at * S // 10)]
    assert written[:BURST] == list(range(BURST))
    assert len(written) == pytest.approx(BURST + 119, abs=2)


def test_what_was_held_back_is_told_by_the_next_line_of_any_name() -> None:
    limits = Limits(burst=1)
    assert passes(limits, "a", 0)
    assert passes(limits, "a", 1) is None
    assert passes(limits, "a", 2) is None
    other = passes(limits, "b", 3)
    assert other is not None
    assert other["held_back"] == {"a": 2}
    later = passes(limits, "a", 2 * S)
    assert later is not None
    assert "held_back" not in later


def test_cycles_and_debug_lines_are_never_held_back() -> None:
    limits = Limits(burst=1)
    assert all(passes(limits, "focus cycle", at, "info") for at in range(100))
    assert all(passes(limits, "window", at, "debug") for at in range(100))


# --- the journal -------------------------------------------------------------------------------------------------


def decode(entry: bytes) -> dict[str, str]:
    """Read an entry as the protocol's document describes it."""
    found: dict[str, str] = {}
    while entry:
        line, _, rest = entry.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if not equals:
            size = int.from_bytes(rest[:8], "little")
            value, rest = rest[8 : 8 + size], rest[8 + size + 1 :]
        found[name.decode()] = value.decode("utf-8", "surrogateescape")
        entry = rest
    return found


@given(st.dictionaries(st.from_regex(r"\A[A-Z][A-Z0-9_]{0,20}\Z"), st.text(), max_size=6))
def test_whatever_the_values_hold_the_journal_reads_them_back(entry: dict[str, str]) -> None:
    assert decode(encode(entry)) == entry


def journal_event(**values: Any) -> dict[str, Any]:
    return {"event": "focus cycle", "level": "info", "monotonic_ns": 5, "timestamp": "-", **values}


def test_every_value_is_a_field() -> None:
    told = fields(journal_event(outcome="FOCUSED", sigma_um=0.5, reference=None, **{"odd key!": [1, 2]}))
    assert told == {
        "MESSAGE": "focus cycle outcome=FOCUSED sigma_um=0.5 reference=null odd key!=[1,2]",
        "PRIORITY": "6",
        "SYSLOG_IDENTIFIER": "elpd",
        "ELPD_EVENT": "focus cycle",
        "ELPD_MONOTONIC_NS": "5",
        "ELPD_OUTCOME": "FOCUSED",
        "ELPD_SIGMA_UM": "0.5",
        "ELPD_REFERENCE": "null",
        "ELPD_ODD_KEY_": "[1,2]",
    }


@pytest.fixture
def journald(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(str(tmp_path / "journal"))
        end.setblocking(False)
        yield end


def test_a_traceback_reaches_the_journal_whole(journald: socket.socket) -> None:
    journal = Journal(journald.getsockname())
    try:
        raise ValueError("why")
    except ValueError:
        journal(journal_event(exc_info=True) | {"level": "error"})
    told = decode(journald.recv(1 << 16))
    journal.close()
    assert told["PRIORITY"] == "3"
    assert "Traceback" in told["MESSAGE"]
    assert told["MESSAGE"].endswith("ValueError: why")


def test_what_no_datagram_holds_goes_as_a_sealed_memory_file(journald: socket.socket) -> None:
    journal = Journal(journald.getsockname())
    journal(journal_event(phases="x" * 1_000_000))
    data, (memory,), _, _ = socket.recv_fds(journald, 16, 1)
    journal.close()
    assert data == b""
    with os.fdopen(memory, "rb") as file:
        with pytest.raises(PermissionError):
            os.truncate(memory, 0)
        file.seek(0)
        assert len(decode(file.read())["ELPD_PHASES"]) == 1_000_000


def waiting(end: socket.socket) -> Iterator[bytes]:
    try:
        while True:
            yield end.recv(1 << 16)
    except BlockingIOError:
        return


def test_a_journal_that_does_not_read_costs_lines_and_no_time(journald: socket.socket) -> None:
    journal = Journal(journald.getsockname())
    for number in range(5000):
        journal(journal_event(number=number))
    received = sum(1 for _ in waiting(journald))
    assert 0 < received < 5000
    journal(journal_event())
    assert decode(journald.recv(1 << 16))["ELPD_LOST_LINES"] == str(5000 - received)
    journal.close()


def test_without_a_journal_the_line_is_named_on_stderr(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    journal = Journal(str(tmp_path / "nobody"))
    journal(journal_event())
    journal.close()
    assert "focus cycle" in capsys.readouterr().err


def test_the_journal_is_used_only_where_stderr_is_it() -> None:
    here = os.fstat(2)
    journal = Journal.if_stderr_is_it({"JOURNAL_STREAM": f"{here.st_dev}:{here.st_ino}"})
    assert journal is not None
    journal.close()
    assert Journal.if_stderr_is_it({"JOURNAL_STREAM": f"{here.st_dev}:{here.st_ino + 1}"}) is None
    assert Journal.if_stderr_is_it({}) is None
