"""One connection that several threads may share: whoever waits for an answer reads for all.

So `stop` from a second thread goes out while `focus` waits in the first, on the same connection, and there is no thread
that only reads. A request's number says whose answer it is; answers that nobody waits for any more are dropped.
"""

from __future__ import annotations

import itertools
import select
import socket
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Self

from elpd.client.wire import Lines, request_line, result_of, why_not
from elpd.errors import UnreachableError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

READ_BYTES = 1 << 16

LOOK_UP_S = 0.25
"""A signal that comes just before a wait begins is not seen by it; so no wait is longer."""


class NotSentError(UnreachableError):
    """The connection was gone before the request left: it may be sent again, over a new one."""


class Link:
    """A connection to *path*. Raises ``UnreachableError`` if nobody answers there within *timeout_s*."""

    def __init__(self, path: Path, timeout_s: float, on_event: Callable[[Any], None] | None = None) -> None:
        self._path = path
        self._timeout_s = timeout_s
        self.on_event = on_event
        self._socket = _connected(path, timeout_s)
        self._lines = Lines()
        self._numbers = itertools.count(1)
        self._sending = threading.Lock()
        self._turn = threading.Condition()  # guards what follows
        self._waited: set[int] = set()
        self._answers: dict[int, dict[str, Any]] = {}
        self._reading = False
        self._broken = ""

    def begin(self, method: str, params: dict[str, Any]) -> Pending:
        """Send a request. Raises ``NotSentError`` if the daemon has closed this connection."""
        number = next(self._numbers)
        line = request_line(number, method, params)
        with self._turn:
            self._waited.add(number)
        try:
            with self._sending:
                self._send(line)
        except OSError as error:
            with self._turn:
                self._waited.discard(number)
            raise NotSentError(f"{self._path}: the daemon is gone ({error.strerror or error})") from None
        return Pending(self, number, method)

    def post(self, method: str) -> None:
        """Send a request whose answer nobody waits for; takes no lock, so a signal handler may call it."""
        try:
            self._socket.send(request_line(next(self._numbers), method, {}), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError as error:
            raise NotSentError(f"{self._path}: the daemon is gone ({error.strerror or error})") from None

    def answer(self, number: int, method: str, timeout_s: float) -> dict[str, Any]:
        """Wait for one answer. Raises ``UnreachableError`` when the time is up or the connection ends."""
        deadline = time.monotonic() + timeout_s
        with self._turn:
            while number not in self._answers:
                left_s = deadline - time.monotonic()
                if self._broken:
                    raise UnreachableError(f"{self._path}: {self._broken} before it answered `{method}`")
                if left_s <= 0:
                    raise TimeUpError(f"{self._path}: no answer to `{method}` within {timeout_s:g} s")
                if self._reading:
                    self._turn.wait(left_s)
                else:
                    self._read_for_all(left_s)
            self._waited.discard(number)
            return self._answers.pop(number)

    def next_event(self, timeout_s: float) -> None:
        """Read once, for a connection that only listens; events go to ``on_event``."""
        with self._turn:
            if self._broken:
                raise UnreachableError(f"{self._path}: {self._broken}")
            self._read_for_all(timeout_s)

    def forget(self, number: int) -> None:
        """Wait no more for this answer."""
        with self._turn:
            self._waited.discard(number)
            self._answers.pop(number, None)

    @property
    def broken(self) -> bool:
        """Whether the connection has ended."""
        return bool(self._broken)

    def close(self) -> None:
        """End the connection; whoever waits for an answer is told. Idempotent."""
        self._broken = self._broken or "this client was closed"
        with suppress(OSError):  # it has ended already
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read_for_all(self, left_s: float) -> None:
        """Wait for bytes without holding the lock, then hand out what they say. Called with the lock held."""
        self._reading = True
        self._turn.release()
        messages: list[dict[str, Any]] = []
        broken = ""
        try:
            messages, broken = self._read(left_s)
        finally:
            self._turn.acquire()
            self._reading = False
            self._turn.notify_all()
        self._broken = self._broken or broken
        for message in messages:
            if "event" in message:
                if self.on_event is not None:
                    self.on_event(message)
            elif message.get("id") in self._waited:
                self._answers[message["id"]] = message
            elif message.get("id") is None and "error" in message:  # not to one request: the connection is refused
                self._broken = self._broken or str(message["error"].get("message"))

    def _read(self, left_s: float) -> tuple[list[dict[str, Any]], str]:
        try:
            if not ready(self._socket, select.POLLIN, min(left_s, LOOK_UP_S)):
                return [], ""
            data = self._socket.recv(READ_BYTES)
            return (self._lines.feed(data), "") if data else ([], "the daemon closed the connection")
        except UnreachableError as error:
            return [], str(error)
        except (OSError, ValueError) as error:
            return [], f"the connection ended ({error})"

    def _send(self, line: bytes) -> None:
        deadline = time.monotonic() + self._timeout_s
        while line:
            try:
                line = line[self._socket.send(line, socket.MSG_NOSIGNAL) :]
            except BlockingIOError:
                if not ready(self._socket, select.POLLOUT, deadline - time.monotonic()):
                    raise TimeoutError("it takes no bytes") from None


class TimeUpError(UnreachableError):
    """No answer came in time; what became of the request is not known."""


class Pending:
    """A request that was sent."""

    def __init__(self, link: Link, number: int, method: str) -> None:
        self._link = link
        self._number = number
        self._method = method

    def result(self, timeout_s: float) -> Any:
        """Wait for the answer and return its result; may be asked again after the time was up.

        Raises what the daemon answered, or ``UnreachableError``.
        """
        return result_of(self._link.answer(self._number, self._method, timeout_s))

    def cancel(self) -> None:
        """Ask the daemon to cancel what runs, without waiting; a signal handler may do that."""
        self._link.post("cancel")

    def forget(self) -> None:
        """Wait for it no more."""
        self._link.forget(self._number)


def _connected(path: Path, timeout_s: float) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.settimeout(timeout_s)
        connection.connect(str(path))
    except OSError as error:
        connection.close()
        raise UnreachableError(f"{path}: {why_not(error)}") from None
    connection.setblocking(False)
    return connection


def ready(connection: socket.socket, what: int, timeout_s: float) -> bool:
    """Wait until a socket can do *what* (``select.POLLIN``, ...), and say whether it can."""
    poll = select.poll()
    poll.register(connection, what)
    return bool(poll.poll(max(0.0, timeout_s) * 1e3))
