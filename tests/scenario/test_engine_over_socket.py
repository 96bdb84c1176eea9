"""The engine behind the socket, the rig in virtual time: clients of the real socket, a lens of the simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from engines import Daemon
from from_schema import params
from hypothesis import given, settings
from sockets import Talker

from elpd.client import Client
from elpd.config import ApiSection
from elpd.errors import BusyError, UsageError
from elpd.service.api import ApiServer

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from elpd.client import Pending

STOP_MS = 5.0
"""From the call to the motor's last step: what a rig may rely on (a Tic stops without a ramp)."""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("socket") / "elpd.sock"


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory, path: Path) -> Iterator[Daemon]:
    daemon = Daemon(tmp_path_factory.mktemp("daemon")).begin()
    with ApiServer(daemon.engine, ApiSection(socket=path)):
        yield daemon
        daemon.end()


@pytest.fixture
def rig(path: Path, daemon: Daemon) -> Iterator[Client]:
    with Client(path) as client:
        yield client


def begun(rig: Client, method: str, **asked: Any) -> Pending:
    """Ask, and return once the engine has the request."""
    pending = rig.begin(method, asked)
    rig.status()
    return pending


def done(daemon: Daemon, rig: Client, method: str, **asked: Any) -> Any:
    """Ask, let the rig's time pass until the engine is through with it, and return the answer."""
    pending = begun(rig, method, **asked)
    daemon.until(lambda: not daemon.engine.place.jobs())
    return pending.result(10.0)


def test_a_cycle_over_the_socket_focuses_and_is_told(daemon: Daemon, rig: Client) -> None:
    with rig.events(["phase", "sample", "result"], rate_hz=1000) as events:
        answer = done(daemon, rig, "focus")
        told = []
        while not told or told[-1]["event"] != "result":
            told.append(next(events))
    assert answer["outcome"] == "FOCUSED"
    assert abs(answer["truth"]["final_error_um"]) < 6.0
    assert told[-1]["run"] == answer["run"]
    assert [event["seq"] for event in told] == list(range(1, len(told) + 1))
    assert [event["phase"] for event in told if event["event"] == "phase"][-1] == "done"
    assert rig.run(answer["run"])["result"]["outcome"] == "FOCUSED"  # type: ignore[index]


def test_a_stop_in_mid_sweep_is_at_the_motor_within_five_milliseconds(daemon: Daemon, rig: Client, path: Path) -> None:
    done(daemon, rig, "move", fraction=0.3)
    stopped: list[tuple[int, float]] = []

    def stop() -> None:  # the rig's time stands still while the call is under way
        with Client(path) as other:
            assert other.stop()["was_moving"]
        stopped.append((daemon.truth.world.now_ns(), daemon.velocity))

    daemon.at_phase("sweep", 20.0, stop)
    answer = done(daemon, rig, "focus")
    assert answer["outcome"] == "CANCELLED"
    at_ns, _ = stopped[0]
    assert daemon.truth.mechanism.velocity_at(at_ns - 1_000_000) != 0.0
    assert daemon.truth.mechanism.velocity_at(at_ns + round(STOP_MS * 1e6)) == 0.0
    daemon.run(0.5)
    assert daemon.velocity == 0.0


@pytest.mark.parametrize("policy", ["finish", "cancel"])
def test_a_client_that_dies_in_its_cycle_leaves_it_as_it_asked(
    daemon: Daemon, path: Path, rig: Client, policy: str
) -> None:
    done(daemon, rig, "move", fraction=0.3)
    dying = Client(path)
    begun(dying, "focus", on_disconnect=policy)

    def die() -> None:
        dying.close()
        while rig.status()["counters"]["clients"] != 1:
            pass

    results = len(daemon.told("result"))
    daemon.at_phase("sweep", 10.0, die)
    daemon.until(lambda: len(daemon.told("result")) > results)
    assert daemon.told("result")[-1].outcome == {"finish": "FOCUSED", "cancel": "CANCELLED"}[policy]


def test_a_lease_keeps_others_off_and_goes_with_its_connection(daemon: Daemon, path: Path, rig: Client) -> None:
    with Client(path) as owner:
        assert owner.lease("acquire", 100.0)["holder"] is not None
        with pytest.raises(BusyError, match="lease"):
            rig.jog(1.0)
        assert rig.stop()["stopped"]
        assert done(daemon, owner, "jog", by_um=1.0)["outcome"] == "OK"
    while rig.status()["counters"]["clients"] != 1:
        pass
    assert rig.status()["lease"]["holder"] is None
    assert done(daemon, rig, "jog", by_um=1.0)["outcome"] == "OK"


def test_what_the_rig_cannot_do_is_told(daemon: Daemon, rig: Client) -> None:
    with pytest.raises(UsageError, match=r"travel|limits"):
        done(daemon, rig, "move", to_um=1e9)
    with pytest.raises(UsageError, match="no run"):
        done(daemon, rig, "run", name="never")


@pytest.mark.parametrize(
    "method", ["move", "jog", "roi", "preset", "mode", "temperature", "lease", "map", "runs", "run", "metrics"]
)
def test_whatever_the_schema_allows_has_one_answer(daemon: Daemon, path: Path, method: str) -> None:
    @settings(max_examples=15, deadline=None)
    @given(params(method))
    def answered(asked: dict[str, Any]) -> None:
        with Talker(path) as talker:
            talker.say({"id": 1, "method": method, "params": asked}, {"id": 2, "method": "status"})
            heard = [talker.hear() or {}]
            while heard[-1]["id"] != 2:
                heard.append(talker.hear() or {})
            daemon.until(lambda: not daemon.engine.place.jobs())
            if len(heard) == 1:
                heard.append(talker.hear() or {})
            assert sorted(line["id"] for line in heard) == [1, 2]
            first = next(line for line in heard if line["id"] == 1)
            assert first.get("error", {}).get("kind") != "Internal", first
            assert talker.ask({"id": 3, "method": "status"})["id"] == 3
            assert daemon.status.fault is None

    answered()
