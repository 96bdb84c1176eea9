"""The socket with a fake engine behind it, and a client of a few lines in front, for tests."""

from __future__ import annotations

import json
import signal
import socket
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Self

from fake_engine import FakeEngine

from elpd.config import ApiSection
from elpd.service.api import ApiServer

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LIMIT_S = 30.0


@contextmanager
def serving(path: Path, engine: FakeEngine | None = None) -> Iterator[FakeEngine]:
    engine = engine or FakeEngine()
    with ApiServer(engine, ApiSection(socket=path)):
        yield engine


def press_ctrl_c() -> None:
    """Interrupt the main thread, as a terminal does."""
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


class Talker:
    """Bytes out, lines in."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(LIMIT_S)
        self.socket.connect(str(path))
        self._lines = self.socket.makefile("rb")

    def say(self, *lines: dict[str, Any] | bytes) -> None:
        """Send all lines at once."""
        self.socket.sendall(
            b"".join((line if isinstance(line, bytes) else json.dumps(line).encode()) + b"\n" for line in lines)
        )

    def hear(self) -> dict[str, Any] | None:
        """Return the next line, ``None`` at the end."""
        try:
            line = self._lines.readline()
        except ConnectionResetError:
            return None
        return json.loads(line) if line else None

    def ask(self, line: dict[str, Any] | bytes) -> dict[str, Any]:
        self.say(line)
        heard = self.hear()
        assert heard is not None, "the connection has ended"
        return heard

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        return self.ask({"id": 1, "method": method, "params": params})

    def refused(self, line: dict[str, Any] | bytes) -> dict[str, Any]:
        """Return the error that a line is answered with."""
        error: dict[str, Any] = self.ask(line)["error"]
        return error

    def close(self) -> None:
        self._lines.close()
        self.socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
