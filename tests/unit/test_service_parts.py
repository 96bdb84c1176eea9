"""The small rooms of the daemon: leases, heartbeats, one answer each, temperatures, what systemd hears, the budget."""

from __future__ import annotations

import json
import os
import socket
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.errors import BusyError, UsageError
from elpd.records import Cancel
from elpd.service import archive, temperature
from elpd.service.backroom import Backroom
from elpd.service.codec import plain
from elpd.service.engine_port import Answer, Caller, Request
from elpd.service.heartbeats import Heartbeats
from elpd.service.job import Job, Place
from elpd.service.kept import Thermometer
from elpd.service.latency import Stages
from elpd.service.lease import Lease
from elpd.service.messages import CancelAnswer, LeaseParams, Params, RunsParams
from elpd.service.notify import Notifier

ME, SOMEBODY = Caller(1, 10, 0, "me"), Caller(2, 20, 0, "somebody")


@dataclass
class Clock:
    now_s: float = 100.0

    def __call__(self) -> float:
        return self.now_s


def job(*, automatic: bool = False) -> Job:
    return Job(Request("move", Params(), ME), automatic=automatic)


# --- one answer ---


def test_a_request_has_one_answer_and_everybody_hears_it() -> None:
    one, heard = job(), []
    one.add_done_callback(heard.append)
    answer = Answer(CancelAnswer(cancelled=True))
    one.finish(answer)
    one.add_done_callback(heard.append)
    assert heard == [answer, answer]
    with pytest.raises(RuntimeError, match="second answer"):
        one.finish(answer)
    assert not one.cancel(), "it has ended"


def test_the_stronger_cancellation_wins() -> None:
    one = job()
    one.cancel(Cancel.HOLD)
    one.cancel(Cancel.RETURN)
    assert one.cancelled is Cancel.HOLD


def test_one_place_for_all_and_the_daemons_own_wishes_give_way() -> None:
    place = Place()
    own = job(automatic=True)
    assert place.begin(own)
    asked = job()
    place.put(asked)
    assert own.cancelled
    with pytest.raises(BusyError, match="'move' of me"):
        place.put(job())
    place.done()
    assert not place.begin(job(automatic=True)), "somebody waits"
    assert place.take() is asked
    with pytest.raises(BusyError):
        place.put(job())
    assert place.cancel_all(why="because") == [asked]
    assert asked.why_cancelled == "because"
    place.done()
    assert place.take() is None
    assert not place.busy


def test_whoever_waits_is_woken_by_a_request_or_a_ring() -> None:
    place = Place()
    for wake in (lambda: place.put(job()), place.ring):
        woken = threading.Thread(target=place.wait, args=(60.0,))
        woken.start()
        wake()
        woken.join(30.0)
        assert not woken.is_alive()
        place.take()
        place.done()


# --- leases ---


def test_a_lease_ends_by_itself() -> None:
    clock = Clock()
    lease = Lease(clock)
    assert lease.ask(LeaseParams(action="acquire", seconds=5.0), ME).until_s == 5.0
    with pytest.raises(BusyError, match="another 5 s"):
        lease.refuse_others(SOMEBODY)
    with pytest.raises(BusyError):
        lease.ask(LeaseParams(action="release"), SOMEBODY)
    clock.now_s += 4.0
    lease.ask(LeaseParams(action="renew", seconds=5.0), ME)
    clock.now_s += 5.0
    assert not lease.held
    assert lease.answer().holder is None
    lease.refuse_others(SOMEBODY)
    with pytest.raises(BusyError, match="acquire it again"):
        lease.ask(LeaseParams(action="renew"), ME)


def test_a_lease_ends_with_its_connection() -> None:
    lease = Lease(Clock())
    lease.ask(LeaseParams(action="acquire"), ME)
    lease.gone(SOMEBODY)
    assert lease.held
    lease.gone(ME)
    assert not lease.held


# --- signs of life ---


def test_a_loop_that_is_silent_is_named_with_how_long() -> None:
    clock = Clock()
    beats = Heartbeats(clock)
    beats.expect("focus", 1.0)
    beats.expect("api", 2.0)
    clock.now_s += 1.5
    assert beats.late() == {"focus": 1.5}
    beats.beat("focus")
    assert beats.late() == {}
    assert beats.ages() == {"focus": 0.0, "api": 1.5}
    beats.forget("api")
    clock.now_s += 0.9
    assert beats.late() == {}


def test_something_slow_may_be_announced_and_ends() -> None:
    clock = Clock()
    beats = Heartbeats(clock)
    beats.expect("focus", 1.0)
    beats.allow("focus", 30.0)
    clock.now_s += 29.0
    assert beats.late() == {}
    clock.now_s += 2.0
    assert beats.late() == {"focus": 31.0}
    beats.allow("focus", None)
    clock.now_s += 1.1
    assert list(beats.late()) == ["focus"]


# --- temperature ---

TABLE = ((10.0, 0.0), (20.0, -6.0), (30.0, -16.0))


@given(st.floats(-50, 100))
def test_a_table_is_held_beyond_its_ends(celsius: float) -> None:
    assert -16.0 <= temperature.table_um(TABLE, celsius) <= 0.0


def test_between_rows_lines_are_straight_and_differences_count() -> None:
    assert temperature.table_um(TABLE, 15.0) == -3.0
    assert temperature.offset_um(TABLE, Thermometer(focus_um=500.0, celsius=20.0), 25.0) == -5.0


@given(wanted=st.floats(-1e4, 1e4), here=st.floats(0, 2500))
def test_a_compensation_is_bounded_and_inside_the_limits(wanted: float, here: float) -> None:
    target = temperature.target_um(wanted, here, (0.0, 2500.0), step_um=3.0, max_step_um=50.0)
    if target is None:
        assert abs(min(max(wanted, 0.0), 2500.0) - here) < 3.0
    else:
        assert 0.0 <= target <= 2500.0
        assert 3.0 - 1e-9 <= abs(target - here) <= 50.0 + 1e-9


# --- what systemd hears ---


@pytest.mark.parametrize("abstract", [False, True])
def test_systemd_hears_datagrams_of_keys_and_values(tmp_path: Path, *, abstract: bool) -> None:
    name = f"elpd-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        supervisor.bind(f"\0{name}" if abstract else name)
        supervisor.settimeout(10.0)
        notifier = Notifier(
            {
                "NOTIFY_SOCKET": f"@{name}" if abstract else name,
                "WATCHDOG_USEC": "2000000",
                "WATCHDOG_PID": str(os.getpid()),
            }
        )
        notifier.ready("READY, one-shot")
        notifier.alive()
        notifier.reloading()
        notifier.stopping()
        heard = [supervisor.recv(4096).decode() for _ in range(4)]
    assert heard[0] == "READY=1\nSTATUS=READY, one-shot"
    assert heard[1] == "WATCHDOG=1"
    assert heard[2].startswith("RELOADING=1\nMONOTONIC_USEC=")
    assert heard[3] == "STOPPING=1"
    assert notifier.watchdog_s == 2.0


def test_without_a_supervisor_nothing_is_sent() -> None:
    notifier = Notifier({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"})
    notifier.ready("x")
    assert notifier.watchdog_s == 0.0
    Notifier({"NOTIFY_SOCKET": "/nowhere/at/all"}).alive()


# --- the rest ---


def test_durations_are_told_as_quantiles_of_the_newest() -> None:
    stages = Stages()
    for value in range(1, 101):
        stages.add("stop", float(value))
    told = stages.summary()["stop"]
    assert (told.p50_us, told.p99_us, told.max_us) == (51.0, 100.0, 100.0)


def test_the_backroom_answers_whatever_happens() -> None:
    room = Backroom(threaded=True)

    def fail() -> Any:
        raise UsageError("no")

    def break_() -> Any:
        raise ZeroDivisionError

    told: list[Answer] = []
    for work in (lambda: CancelAnswer(cancelled=False), fail, break_):
        one = job()
        one.add_done_callback(told.append)
        room.answer(one, work)
    room.close()
    assert [None if one.error is None else one.error.kind for one in told] == [None, "UsageError", "InternalError"]


def test_numbers_become_what_json_has() -> None:
    import numpy as np  # noqa: PLC0415

    values = {"a": np.float32(1.5), "b": (float("nan"), np.int64(3)), "c": np.array([1.0, np.inf]), "d": Path("x")}
    assert json.dumps(plain(values), allow_nan=False) == '{"a": 1.5, "b": [null, 3], "c": [1.0, null], "d": "x"}'


def test_old_runs_pay_for_new_ones(tmp_path: Path) -> None:
    for second in range(5):
        folder = tmp_path / f"20260101T00000{second}Z-001"
        folder.mkdir()
        (folder / "run.json").write_text('{"format": 1, "elpd": "0", "config": {}, "request": {}}')
        (folder / "events.raw").write_bytes(bytes(1000))
    (tmp_path / "20260101T000000Z-001").rename(tmp_path / "precious")
    archive.keep_budget(tmp_path, 2500)
    assert sorted(one.name for one in tmp_path.iterdir()) == [
        "20260101T000003Z-001",
        "20260101T000004Z-001",
        "precious",
    ]
    archive.keep_budget(tmp_path, 1)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["20260101T000004Z-001", "precious"]
    archive.keep_budget(tmp_path / "absent", 1)
    assert archive.runs(tmp_path / "absent", RunsParams().limit).runs == []
    with pytest.raises(UsageError, match="there is no run"):
        archive.run(tmp_path, "..")
