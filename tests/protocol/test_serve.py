"""The daemon as a process: what it says when it is ready, how it takes signals, how it ends. Nothing here is timed."""

from __future__ import annotations

import json
import signal
import subprocess
from typing import TYPE_CHECKING

import pytest
from served import ELPD, PATIENCE_S, Connection, Served, serving_in

from elpd.cli.sim_board import find_board

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Served]]:
    with serving_in(tmp_path) as begin:
        yield begin


def test_a_daemon_serves_tells_its_supervisor_and_ends_in_order(serve: Callable[..., Served]) -> None:
    daemon = serve()
    assert daemon.hello["pid"] == daemon.process.pid
    assert daemon.hello["state"] == "READY"
    assert daemon.heard_until("READY=1").endswith("STATUS=READY, one-shot")
    daemon.heard_until("WATCHDOG=1")
    connection = daemon.connect()
    result = connection.call("focus")["result"]
    assert result["outcome"] == "FOCUSED"
    assert (daemon.folder / "runs" / result["run"] / "run.json").exists()
    ticks = connection.call("status")["result"]["ticks"]
    assert set(ticks) == {"focus", "api"}
    connection.close()
    assert daemon.end() == 0
    daemon.heard_until("STOPPING=1")
    assert json.loads((daemon.folder / "state" / "service.json").read_text())["content"]["open"] is False


def test_sigterm_in_a_cycle_ends_it_where_the_lens_stops(serve: Callable[..., Served]) -> None:
    daemon = serve("sim.pace=0.05")
    watcher, asker = daemon.connect(), daemon.connect()
    watcher.call("subscribe", events=["phase"])
    asker.send("focus")
    watcher.until("phase", phase="sweep")
    assert daemon.end() == 0
    result = asker.receive()["result"]
    assert result["outcome"] == "CANCELLED"
    assert "going down" in result["reason"]


def test_a_stop_comes_through_while_a_cycle_runs(serve: Callable[..., Served]) -> None:
    daemon = serve("sim.pace=0.05")
    watcher, asker = daemon.connect(), daemon.connect()
    watcher.call("subscribe", events=["phase"])
    asker.send("focus")
    watcher.until("phase", phase="sweep")
    stop = daemon.connect().call("stop")["result"]
    assert stop["stopped"] is True
    assert asker.receive()["result"]["outcome"] == "CANCELLED"
    assert daemon.connect().call("status")["result"]["state"] == "READY"


def test_a_killed_daemon_comes_back_unreferenced(serve: Callable[..., Served]) -> None:
    first = serve()
    first.process.kill()
    first.process.wait(PATIENCE_S)
    again = serve()
    connection = again.connect()
    assert connection.call("status")["result"]["lens"]["referenced"] is False
    assert connection.call("move", fraction=0.5)["error"]["kind"] == "Unreferenced"
    assert "result" in connection.call("home")


def test_sighup_takes_a_good_configuration_and_refuses_a_bad_one(serve: Callable[..., Served]) -> None:
    daemon = serve()
    daemon.heard_until("READY=1")
    path = daemon.folder / "elpd.toml"
    good = path.read_text()
    path.write_text(good + "[focus]\ndeadlin_ms = 3\n")
    daemon.process.send_signal(signal.SIGHUP)
    daemon.heard_until("RELOADING=1")
    daemon.heard_until("READY=1")
    connection = daemon.connect()
    assert "elpd.toml:13" in warned(connection)["config-refused"]
    path.write_text(good + "[focus]\ndeadline_ms = 1\n")
    daemon.process.send_signal(signal.SIGHUP)
    daemon.heard_until("RELOADING=1")
    daemon.heard_until("READY=1")
    assert "config-refused" not in warned(connection)
    assert connection.call("focus")["result"]["outcome"] == "DEADLINE"


def test_a_second_daemon_on_the_socket_is_refused(serve: Callable[..., Served]) -> None:
    daemon = serve()
    second = subprocess.run(
        [*ELPD, "serve", "--json", "--config", str(daemon.folder / "elpd.toml")],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert second.returncode == 4
    assert json.loads(second.stdout)["error"]["kind"] == "BusyError"
    assert daemon.connect().call("status")["result"]["state"] == "READY"


def test_a_wrong_configuration_is_no_reason_to_try_again(tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text("[service]\npol_ms = 3\n")
    ended = subprocess.run(
        [*ELPD, "serve", "--config", str(tmp_path / "bad.toml")], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2
    assert "bad.toml:2: service.pol_ms: unknown key" in ended.stderr


def test_parking_stops_a_lens_that_nobody_drives_any_more() -> None:
    board = find_board("tic").serve({"seed": 1, "um_per_step": 0.3125, "referenced": True})
    try:
        rig = ("--set", "lens.driver=tic", "--set", f"lens.port={board.port}", "--set", "lens.reply_ms=2000.0")
        parked = _elpd("park", "--emergency", "--json", *rig)
        assert parked.returncode == 0, parked.stderr
        assert json.loads(parked.stdout)["stopped"] is True
        assert _elpd("park", *rig).returncode == 2, "it must be meant"
    finally:
        board.close()
    assert _elpd("park", "--emergency", *rig).returncode == 3, "the port is gone"
    told = _elpd("park", "--emergency", "--json")
    assert json.loads(told.stdout) == {
        "stopped": False,
        "reason": "a simulated lens ends with its daemon: there is nothing to stop",
    }


def warned(connection: Connection) -> dict[str, str]:
    """Return the warnings of a daemon by their codes; a busy machine has one of its own."""
    return {one["code"]: one["text"] for one in connection.call("status")["result"]["warnings"]}


def _elpd(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*ELPD, *arguments], capture_output=True, text=True, check=False, timeout=PATIENCE_S)
