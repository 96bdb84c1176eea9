from __future__ import annotations

import os
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from fake_engine import FakeEngine
from sockets import Talker, serving

from elpd.cli.daemon import naming_the_holder
from elpd.config import ApiSection
from elpd.errors import BusyError, ConfigError
from elpd.service import listening
from elpd.service.api import ApiServer
from elpd.service.listening import default_path, handed_over, holder_pid, listen_at


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / "elpd.sock"


def listener_at(path: Path) -> socket.socket:
    path.parent.mkdir(parents=True, exist_ok=True)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()
    return listener


def test_the_socket_is_for_the_group_and_goes_with_the_daemon(path: Path) -> None:
    with serving(path):
        assert stat.S_IMODE(path.stat().st_mode) == 0o660
        assert holder_pid(path) == os.getpid()
    assert not path.exists()
    assert holder_pid(path) is None


def test_a_socket_that_a_dead_daemon_left_is_replaced(path: Path) -> None:
    listener_at(path).close()
    assert path.exists()
    with serving(path), Talker(path) as talker:
        assert talker.call("hello")["result"]["protocol"] == 1


def test_a_live_socket_is_not_stolen(path: Path) -> None:
    with serving(path), pytest.raises(BusyError, match=f"process {os.getpid()}"), serving(path):
        pass
    with listener_at(path), pytest.raises(BusyError, match="listens there already"):
        listen_at(path)
    assert path.exists()


def test_a_socket_that_somebody_replaced_is_left_alone(path: Path) -> None:
    with serving(path):
        path.unlink()
        path.touch()
    assert path.exists()


def test_what_cannot_be_a_socket_is_told(path: Path) -> None:
    path.parent.mkdir()
    path.write_text("notes")
    with pytest.raises(ConfigError, match="is not a socket"):
        listen_at(path)
    assert path.read_text() == "notes"
    with pytest.raises(ConfigError, match="cannot be made"):
        listen_at(path / "below" / "a.sock")
    with pytest.raises(ConfigError, match="107 bytes"):
        listen_at(path.with_name("x" * 107))


def test_without_a_path_it_is_the_systems_or_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(listening, "SYSTEM_SOCKET", tmp_path / "elpd" / "elpd.sock")
    assert default_path() == tmp_path / "elpd" / "elpd.sock"
    monkeypatch.setattr(listening, "SYSTEM_SOCKET", Path("/proc/none/elpd/elpd.sock"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert default_path() == tmp_path / "elpd" / "elpd.sock"
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    with pytest.raises(ConfigError, match="name a socket"):
        default_path()


# --- sockets that a supervisor opened ----------------------------------------------------------------------------


def test_a_socket_that_was_handed_over_is_served_and_stays(path: Path) -> None:
    engine = FakeEngine()
    handed = listener_at(path)
    with ApiServer(engine, ApiSection(), [handed]) as server, Talker(path) as talker:
        assert talker.call("hello")["result"]["protocol"] == 1
        assert server.path is None
        assert holder_pid(path) == os.getpid()
    assert path.exists()  # the supervisor's, for the next daemon


TAKEN_OVER = """
import os, socket, sys
from elpd.service.listening import handed_over
os.environ["LISTEN_PID"] = str(os.getpid() + int(sys.argv[1]))
try:
    found = handed_over(os.environ, os.getpid())
    print([listener.getsockname() for listener in found], os.get_inheritable(3), "LISTEN_FDS" in os.environ)
except Exception as error:
    print(type(error).__name__, error)
"""


def taken_over(descriptor: int, pid_off_by: int = 0) -> str:
    """Let a child find *descriptor* as its third, the way a supervisor does it."""
    os.dup2(descriptor, 100)
    command = f"exec 3<&100 100<&-; LISTEN_FDS=1 exec {sys.executable} -c '{TAKEN_OVER}' {pid_off_by}"
    try:
        ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True, pass_fds=[100])
    finally:
        os.close(100)
    return ended.stdout.strip()


def test_descriptors_are_taken_over(path: Path) -> None:
    with listener_at(path) as listener:
        assert taken_over(listener.fileno()) == f"['{path}'] False False"
        assert taken_over(listener.fileno(), pid_off_by=1) == "[] True False"


def test_descriptors_that_are_no_listening_sockets_are_refused(tmp_path: Path) -> None:
    with (tmp_path / "file").open("w") as file:
        assert taken_over(file.fileno()).startswith("ConfigError LISTEN_FDS: descriptor 3 is no socket")
    with socket.socket(socket.AF_UNIX) as deaf:
        assert taken_over(deaf.fileno()).startswith("ConfigError LISTEN_FDS: descriptor 3 is no listening")
    with socket.create_server(("127.0.0.1", 0)) as tcp:
        assert taken_over(tcp.fileno()).startswith("ConfigError LISTEN_FDS: descriptor 3 is no listening Unix")


def test_without_the_variables_nothing_is_taken() -> None:
    assert handed_over({}, os.getpid()) == []
    assert handed_over({"LISTEN_PID": "1", "LISTEN_FDS": "x"}, 1) == []


# --- who holds the rig -------------------------------------------------------------------------------------------


def test_a_rig_that_the_daemon_holds_is_told_with_its_process(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ELPD_SOCKET", str(path))
    with pytest.raises(BusyError, match=r"^in use$"), naming_the_holder():
        raise BusyError("in use")
    told = f"in use; a daemon runs \\(process {os.getpid()}\\)"
    with serving(path), pytest.raises(BusyError, match=told), naming_the_holder():
        raise BusyError("in use")
