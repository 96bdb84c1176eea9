"""The socket's server over real sockets, with an engine that moves nothing."""

from __future__ import annotations

import grp
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from fake_engine import FakeEngine
from sockets import Talker, serving

from elpd.config import ApiSection
from elpd.errors import ConfigError, LensError
from elpd.service import connection, telling
from elpd.service.api import MOST_CLIENTS, MOST_STOPPERS, ApiServer
from elpd.service.desk import MOST_IN_FLIGHT
from elpd.service.messages import FaultEvent, PhaseEvent, PositionEvent, SampleEvent, StateEvent
from elpd.service.peers import Operators, Peer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "elpd.sock"


@pytest.fixture
def engine(path: Path) -> Iterator[FakeEngine]:
    with serving(path) as engine:
        yield engine


@pytest.fixture
def talker(path: Path, engine: FakeEngine) -> Iterator[Talker]:
    with Talker(path) as talker:
        yield talker


def request(number: object, method: str, **params: Any) -> dict[str, Any]:
    return {"id": number, "method": method, "params": params}


def sample(t_us: int = 0) -> SampleEvent:
    return SampleEvent(t_us=t_us, position_um=1.0, elp=5, score=2.0, events=9)


# --- answers -----------------------------------------------------------------------------------------------------


def test_every_request_is_answered_under_its_number(talker: Talker) -> None:
    talker.say(
        request(1, "metrics"), request("two", "fokus"), request(None, "status"), b"no json", b"", request(5, "hello")
    )
    heard = [talker.hear() for _ in range(5)]
    assert [answer["id"] for answer in heard if answer] == [1, "two", None, None, 5]
    assert [answer["error"]["kind"] for answer in heard if answer and "error" in answer] == ["UsageError", "UsageError"]


def test_what_breaks_in_the_engine_is_answered_and_the_server_goes_on(talker: Talker, engine: FakeEngine) -> None:
    def broken() -> None:
        raise ZeroDivisionError

    engine.status = broken  # type: ignore[method-assign, assignment]
    assert talker.refused(request(1, "status"))["kind"] == "Internal"
    engine.stop = lambda: (_ for _ in ()).throw(LensError("lens: it is gone"))  # type: ignore[method-assign]
    assert talker.refused(request(1, "stop")) == {"kind": "LensError", "message": "lens: it is gone"}
    assert talker.call("metrics")["result"]["text"]


def test_stop_is_done_before_all_that_came_with_it(talker: Talker, engine: FakeEngine) -> None:
    talker.say(*[request(number, "metrics") for number in range(900)], request("stop", "stop"))
    heard = [(talker.hear() or {})["id"] for _ in range(901)]
    assert heard.index("stop") < 900
    assert [number for number in heard if number != "stop"] == list(range(900))


@pytest.mark.parametrize("urgent", ["stop", "cancel"])
def test_what_a_stop_has_overtaken_does_not_move_the_lens_after_it(
    talker: Talker, engine: FakeEngine, urgent: str
) -> None:
    talker.say(request(1, "status"), request(2, "focus"), request(3, "jog", by_um=1.0), request(4, urgent))
    heard = {line["id"]: line for line in (talker.hear() or {} for _ in range(4))}
    assert heard[1]["result"]
    assert heard[2]["error"]["kind"] == heard[3]["error"]["kind"] == "Busy"
    assert engine.accepted == []
    talker.say(request(5, "focus"))  # after it, one may
    engine.heard(lambda: len(engine.accepted) == 1)


def test_one_stop_does_not_wait_for_the_flood_of_another(path: Path, talker: Talker, engine: FakeEngine) -> None:
    talker.say(*[request(number, "metrics") for number in range(1000)])
    with Talker(path) as other:
        assert other.call("stop")["result"]["stopped"]
    for number in range(1000):
        heard = talker.hear()
        assert heard is not None
        assert heard["id"] == number


def test_so_many_wait_and_no_more(talker: Talker, engine: FakeEngine) -> None:
    engine.patient = True  # metrics are answered when the test says so
    for number in range(MOST_IN_FLIGHT):
        talker.say(request(number, "metrics"))
    assert talker.refused(request("more", "metrics"))["kind"] == "Busy"
    engine.finish_all()
    assert [(talker.hear() or {}).get("id") for _ in range(MOST_IN_FLIGHT)] == list(range(MOST_IN_FLIGHT))
    engine.patient = False
    assert talker.call("metrics")["result"]


def test_one_that_ends_its_sending_still_gets_its_answers(path: Path, engine: FakeEngine) -> None:
    with Talker(path) as talker:
        talker.say(request(1, "focus"))
        talker.socket.shutdown(socket.SHUT_WR)
        engine.heard(lambda: bool(engine.accepted))
        engine.finish()
        assert (talker.hear() or {})["result"]["outcome"] == "FOCUSED"
        assert talker.hear() is None  # and then it is let go
    engine.heard(lambda: len(engine.departed) == 1)


def test_one_that_dies_is_gone_at_once_and_its_cycle_goes_on(path: Path, engine: FakeEngine) -> None:
    with Talker(path) as talker:
        talker.say(request(1, "focus"))
        engine.heard(lambda: bool(engine.accepted))
    engine.heard(lambda: len(engine.departed) == 1)
    assert engine.departed[0] == engine.accepted[0].request.caller
    assert engine.accepted[0].answer is None  # what becomes of it is the engine's to say
    engine.finish()
    with Talker(path) as after:
        assert after.call("status")["result"]["state"] == "READY"


def test_at_the_end_everything_has_its_answer(path: Path) -> None:
    engine = FakeEngine()
    with ApiServer(engine, ApiSection(socket=path)) as server, Talker(path) as talker:
        talker.say(request(1, "focus"), request(2, "status"))
        engine.heard(lambda: bool(engine.accepted))
        assert (talker.hear() or {})["id"] == 2
        stopper = threading.Thread(target=server.stop)
        stopper.start()
        assert talker.hear() == {"id": 1, "error": {"kind": "Unavailable", "message": "the daemon ends"}}
        assert talker.hear() is None
        stopper.join()
    assert not path.exists()


def test_the_loop_shows_that_it_lives(engine: FakeEngine) -> None:
    engine.heard(lambda: engine.beats >= 2)


# --- limits ------------------------------------------------------------------------------------------------------


def test_a_line_of_ten_megabytes_is_told_and_skipped(talker: Talker) -> None:
    talker.say(b'{"id": 1, "x": "' + b"y" * 10_000_000 + b'"}')
    assert (talker.hear() or {})["error"]["kind"] == "TooLarge"
    assert talker.call("status")["result"]["state"] == "READY"


def test_a_line_that_never_ends_ends_the_connection(path: Path, talker: Talker, engine: FakeEngine) -> None:
    with pytest.raises((BrokenPipeError, ConnectionResetError)):
        talker.socket.sendall(b"y" * (64 << 20))
    engine.heard(lambda: engine.counts.dropped_clients == 1)


def test_a_flood_ends_the_connection_and_is_counted(path: Path, talker: Talker, engine: FakeEngine) -> None:
    with pytest.raises((BrokenPipeError, ConnectionResetError)):
        talker.socket.sendall(b"{}\n" * 1_000_000)
    engine.heard(lambda: engine.counts.dropped_clients == 1)
    with Talker(path) as other:
        assert other.call("stop")["result"]["stopped"]


def test_a_full_house_still_lets_a_stop_in(path: Path, engine: FakeEngine) -> None:
    guests = [Talker(path) for _ in range(MOST_CLIENTS)]
    for guest in guests:
        assert guest.call("status")["result"]["state"] == "READY"
    late = []
    for _ in range(MOST_STOPPERS + 1):
        late.append(Talker(path))
        assert late[-1].call("stop")["result"]["stopped"]
    assert late[0].hear() is None  # the oldest made room
    assert late[-1].refused(request(1, "status"))["kind"] == "Busy"
    assert engine.counts.clients == MOST_CLIENTS + MOST_STOPPERS
    for guest in guests + late:
        guest.close()


def test_a_client_that_does_not_read_loses_samples_and_is_told(path: Path, talker: Talker, engine: FakeEngine) -> None:
    assert talker.call("subscribe", rate_hz=1000)["result"]["subscribed"]
    with Talker(path) as reader:
        assert reader.call("subscribe", rate_hz=1000)["result"]
        for batch in range(20):
            for number in range(1000):
                engine.tell(sample(1000 * (1000 * batch + number)))
            for _ in range(1000):  # what one does not read keeps nothing from another
                assert (reader.hear() or {})["event"] == "sample"
    engine.tell(FaultEvent(kind="LensError", message="it is gone"))
    heard = []
    while not heard or heard[-1]["event"] != "fault":
        heard.append(talker.hear() or {})
    numbers = [line["seq"] for line in heard]
    assert numbers == sorted(set(numbers))
    dropped = sum(line["count"] for line in heard if line["event"] == "dropped")
    assert dropped == engine.counts.dropped_events > 0
    assert dropped + sum(line["event"] == "sample" for line in heard) == 20_000


def test_a_client_that_leaves_its_answers_unread_is_dropped(
    path: Path, talker: Talker, engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert talker.call("subscribe", events=["fault"])["result"]
    for _ in range(400):
        engine.tell(FaultEvent(kind="LensError", message="m" * 10_000))
    engine.heard(lambda: engine.counts.dropped_clients == 1)
    with Talker(path) as other:
        assert other.call("status")["result"]["counters"]["clients"] == 1


def test_a_client_that_stands_still_is_dropped(
    talker: Talker, engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "STALL_S", 0.0)
    assert talker.call("subscribe", events=["fault"])["result"]
    for _ in range(60):  # more than the kernel takes, less than what may wait
        engine.tell(FaultEvent(kind="LensError", message="m" * 10_000))
    engine.heard(lambda: engine.counts.dropped_clients == 1)


def test_a_flood_of_events_leaves_out_samples_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(telling, "MOST_EVENTS_WAITING", 10)
    turns: list[Callable[[], None]] = []
    told = telling.Telling(list, turns.append, turns.append, lambda: None)
    for number in range(30):  # nobody takes them meanwhile
        told.event(sample(number))
        told.event(PositionEvent(position_um=1.0, moving=True))
    told.event(PhaseEvent(phase="sweep"))
    assert (told.dropped, len(turns)) == (50, 1)
    turns.pop()()
    told.event(sample(31))
    assert (told.dropped, len(turns)) == (50, 1), "room again, and woken again"


# --- events ------------------------------------------------------------------------------------------------------


def test_a_client_hears_what_it_asked_for_in_order(talker: Talker, engine: FakeEngine) -> None:
    talker.call("subscribe", events=["phase", "sample", "position"], rate_hz=100)
    engine.tell(PhaseEvent(phase="sweep"))
    for number in range(15):
        engine.tell(sample(1000 * number))
    engine.tell(StateEvent(state="READY", mode="manual"))
    engine.tell(PhaseEvent(phase="stop", progress=1.0))
    engine.tell(PositionEvent(position_um=None, moving=None))
    heard = [talker.hear() or {} for _ in range(6)]
    assert [line["seq"] for line in heard] == [1, 2, 3, 4, 5, 6]
    assert [line.get("t_us") for line in heard] == [None, 0, 10_000, 14_000, None, None]
    assert heard[4] == {"seq": 5, "event": "phase", "phase": "stop", "progress": 1.0}
    talker.call("subscribe", events=[])
    engine.tell(PhaseEvent(phase="sweep"))
    assert talker.call("metrics")["result"]  # and no event before it


# --- who ---------------------------------------------------------------------------------------------------------

AS_SOMEBODY_ELSE = """
import json, os, socket, sys
os.setgroups([int(gid) for gid in sys.argv[3].split()])
os.setgid(65534); os.setuid(int(sys.argv[2]))
talker = socket.socket(socket.AF_UNIX); talker.connect(sys.argv[1]); lines = talker.makefile("rb")
for method in sys.argv[4:]:
    talker.sendall(json.dumps({"method": method}).encode() + b"\\n")
    answer = json.loads(lines.readline())
    print(method, answer["error"]["kind"] if "error" in answer else answer["result"].get("role", "ok"))
"""


@pytest.fixture
def open_path() -> Iterator[Path]:
    """A socket's path that every user can reach."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder) / "elpd.sock"


def asked_by(path: Path, uid: int, groups: str, *methods: str) -> dict[str, str]:
    """Ask as another user, whom the socket's mode lets in."""
    path.chmod(0o666)
    arguments = [sys.executable, "-c", AS_SOMEBODY_ELSE, path, str(uid), groups, *methods]
    told = subprocess.run(arguments, capture_output=True, text=True, check=True)
    return dict(line.split() for line in told.stdout.splitlines())


@pytest.mark.skipif(os.geteuid() != 0, reason="becoming another user takes root")
def test_somebody_else_looks_and_does_not_touch(open_path: Path) -> None:
    methods = ("hello", "status", "roi", "metrics", "stop", "cancel", "focus", "clear")
    with serving(open_path) as engine:
        looked = asked_by(open_path, 12345, "", *methods)
        assert asked_by(open_path, os.geteuid(), "", "hello") == {"hello": "operate"}
    assert looked == {
        "hello": "observe", "status": "ok", "roi": "ok", "metrics": "ok",
        "stop": "Forbidden", "cancel": "Forbidden", "focus": "Forbidden", "clear": "Forbidden",
    }  # fmt: skip
    assert not {"stop", "cancel", "focus"} & set(engine.calls)


@pytest.mark.skipif(os.geteuid() != 0, reason="becoming another user takes root")
def test_a_member_of_the_operators_operates(open_path: Path) -> None:
    engine, group = FakeEngine(), grp.getgrall()[-1]
    with ApiServer(engine, ApiSection(socket=open_path, operators=group.gr_name)):
        assert asked_by(open_path, 12345, str(group.gr_gid), "stop") == {"stop": "ok"}
        assert asked_by(open_path, 12345, "", "stop") == {"stop": "Forbidden"}
    assert engine.calls.count("stop") == 1


def test_roles_go_by_user_and_group() -> None:
    operators = Operators(uid=1000, gid=50)
    for uid, groups, operates in ((0, [0], True), (1000, [9], True), (7, [9, 50], True), (7, [9], False)):
        assert operators.include(Peer(1, uid, frozenset(groups), "")) is operates
    assert not Operators(uid=1000).include(Peer(1, 7, frozenset([7]), ""))
    with pytest.raises(ConfigError, match="no group 'no-such-group'"):
        Operators.of_group("no-such-group")


def test_the_caller_is_told_to_the_engine(talker: Talker, engine: FakeEngine) -> None:
    talker.call("metrics")
    caller = engine.requests[0].caller
    assert (caller.pid, caller.uid) == (os.getpid(), os.geteuid())
    assert caller.name
    assert json.dumps(caller.connection)
