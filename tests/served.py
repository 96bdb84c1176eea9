"""The daemon as a process of its own, with a supervisor that listens, for tests."""

from __future__ import annotations

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

ELPD = (sys.executable, "-c", "from elpd.cli import main; main()")
PATIENCE_S = 120.0
"""A machine that runs a test on every core compiles kernels slowly."""


@dataclass
class Served:
    """A daemon and a connection to it."""

    process: subprocess.Popen[str]
    folder: Path
    heard: queue.Queue[str]
    hello: dict[str, Any]
    connections: list[Connection] = field(default_factory=list)

    def connect(self) -> Connection:
        """Open another connection; the fixture closes it."""
        self.connections.append(Connection(self.hello["socket"]))
        return self.connections[-1]

    def heard_until(self, word: str) -> str:
        """Return the next datagram for the supervisor that begins with a word."""
        while not (told := self.heard.get(timeout=PATIENCE_S)).startswith(word):
            pass
        return told

    def end(self) -> int:
        """Ask it to end, and see how it does."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_S)


class Connection:
    """One JSON object a line, each way."""

    def __init__(self, path: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(PATIENCE_S)
        self._socket.connect(path)
        self._lines = self._socket.makefile("rwb")

    def send(self, method: str, **params: Any) -> None:
        self._lines.write(json.dumps({"id": 1, "method": method, "params": params}).encode() + b"\n")
        self._lines.flush()

    def receive(self) -> dict[str, Any]:
        answer: dict[str, Any] = json.loads(self._lines.readline())
        return answer

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self.send(method, **params)
        return self.receive()

    def until(self, event: str, **fields: Any) -> dict[str, Any]:
        while True:
            told = self.receive()
            if told.get("event") == event and all(told.get(key) == value for key, value in fields.items()):
                return told

    def close(self) -> None:
        self._lines.close()
        self._socket.close()


@contextmanager
def serving_in(folder: Path) -> Iterator[Callable[..., Served]]:
    """Return what runs ``elpd serve`` in *folder* with overrides of its configuration, *before* it other words of the
    command line, and variables of its environment."""
    begun: list[Served] = []
    supervisors: list[socket.socket] = []

    def begin(*overrides: str, before: Sequence[str] = (), **environment: str) -> Served:
        supervisor = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        supervisor.bind(str(folder / f"notify-{len(begun)}"))
        supervisors.append(supervisor)
        (folder / "elpd.toml").write_text(
            f'[api]\nsocket = "{folder}/elpd.sock"\n[journal]\ndirectory = "{folder}/runs"\n'
            f'[state]\ndirectory = "{folder}/state"\n[sim]\nwidth = 320\nheight = 240\nscene = "camera"\nseed = 3\n'
        )
        settings = [word for override in overrides for word in ("--set", override)]
        process = subprocess.Popen(
            [
                *before,
                *ELPD,
                "--log",
                str(folder / "log.jsonl"),
                "serve",
                "--json",
                "--config",
                str(folder / "elpd.toml"),
                *settings,
            ],
            env={**os.environ, "NOTIFY_SOCKET": supervisor.getsockname(), "WATCHDOG_USEC": "2000000"} | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, process.communicate()[1]
        heard: queue.Queue[str] = queue.Queue()
        threading.Thread(target=_read_all, args=(supervisor, heard), daemon=True).start()
        served = Served(process, folder, heard, json.loads(line))
        begun.append(served)
        return served

    yield begin
    for served in begun:
        for connection in served.connections:
            connection.close()
        if served.process.poll() is None:
            served.process.kill()
        served.process.communicate()
    for supervisor in supervisors:
        supervisor.sendto(b"", supervisor.getsockname())


def _read_all(supervisor: socket.socket, heard: queue.Queue[str]) -> None:
    """Read as systemd does: at once, so that nothing is lost."""
    with supervisor:
        while told := supervisor.recv(4096):
            heard.put(told.decode())
