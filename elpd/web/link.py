"""A connection to the daemon: one JSON object a line, many requests in flight, events to whoever listens.

A connection that is lost stays lost; ``Link`` opens the next one when somebody asks again. Nothing is ever sent twice:
a command whose answer was lost may have been carried out.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

LINE_LIMIT_BYTES = 64 << 20
"""Longest answer: a 16-bit picture of the largest sensor in base64 stays well below."""

Event = dict[str, Any]


class DaemonError(Exception):
    """The daemon's answer is an error; ``kind`` is its word for it."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class Connection:
    """One connection; ``closed`` is set when it is lost."""

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, hear: Callable[[Event], None] | None
    ) -> None:
        self.closed = asyncio.Event()
        self._writer = writer
        self._hear = hear
        self._ids = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        self._reading = asyncio.create_task(self._read(reader))

    @classmethod
    async def open(cls, socket: Path, hear: Callable[[Event], None] | None = None) -> Connection:
        """Connect. Raises ``DaemonError`` (``Unavailable``)."""
        try:
            reader, writer = await asyncio.open_unix_connection(socket, limit=LINE_LIMIT_BYTES)
        except OSError as error:
            raise _unavailable(
                f"no daemon answers at {socket} ({error.strerror or error}); is `elpd serve` running?"
            ) from None
        return cls(reader, writer, hear)

    async def call(self, method: str, params: dict[str, Any] | None = None) -> Any:
        """Ask, and wait for the answer. Raises ``DaemonError``."""
        if self.closed.is_set():
            raise _unavailable("the connection to the daemon is lost")
        number = next(self._ids)
        answer = self._waiting[number] = asyncio.get_running_loop().create_future()
        line = json.dumps({"id": number, "method": method, "params": params or {}}, allow_nan=False)
        try:
            self._writer.write(line.encode() + b"\n")
            await self._writer.drain()
            return await answer
        except OSError as error:
            raise _unavailable(f"the connection to the daemon broke ({error.strerror or error})") from None
        finally:
            del self._waiting[number]

    async def close(self) -> None:
        """Hang up."""
        self._writer.close()
        self._reading.cancel()
        with contextlib.suppress(asyncio.CancelledError, OSError):
            await self._reading
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()

    async def _read(self, reader: asyncio.StreamReader) -> None:
        try:
            while line := await reader.readline():
                self._take(json.loads(line))
        except (OSError, ValueError):  # gone, or speaking something else: both are the end of this connection
            pass
        finally:
            self.closed.set()
            self._writer.close()
            for answer in self._waiting.values():
                if not answer.done():
                    answer.set_exception(_unavailable("the daemon hung up before it answered; look at its status"))

    def _take(self, message: dict[str, Any]) -> None:
        if "event" in message:
            if self._hear is not None:
                self._hear(message)
            return
        answer = self._waiting.get(message.get("id", 0))
        if answer is None or answer.done():
            return
        if error := message.get("error"):
            answer.set_exception(DaemonError(error["kind"], error["message"]))
        else:
            answer.set_result(message.get("result"))


class Link:
    """A connection that is opened when it is needed, and again when it was lost."""

    def __init__(self, socket: Path) -> None:
        self._socket = socket
        self._connection: Connection | None = None
        self._opening = asyncio.Lock()

    async def call(self, method: str, params: dict[str, Any] | None = None) -> Any:
        """Ask the daemon. Raises ``DaemonError``."""
        async with self._opening:
            if self._connection is None or self._connection.closed.is_set():
                self._connection = await Connection.open(self._socket)
            connection = self._connection
        return await connection.call(method, params)

    async def close(self) -> None:
        """Hang up, if there is a connection."""
        if self._connection is not None:
            await self._connection.close()


def _unavailable(message: str) -> DaemonError:
    return DaemonError("Unavailable", message)
