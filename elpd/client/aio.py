"""The client that awaits. As the one that waits, with asyncio's manners: a cancelled `focus` cancels its cycle."""

from __future__ import annotations

import asyncio
import itertools
import select
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal, Self

from elpd.client.link import ready
from elpd.client.methods import AsyncMethods
from elpd.client.stream import FIRST_PAUSE_S, LONGEST_PAUSE_S, RECONNECTED
from elpd.client.wire import (
    LONGEST_ANSWER,
    READS,
    Lines,
    given,
    patience_s,
    request_line,
    result_of,
    socket_path,
    why_not,
)
from elpd.errors import UnreachableError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Sequence
    from pathlib import Path

    from elpd.client.shapes import Event, FocusAnswer, RoiBox

CANCEL_S = 2.0
"""A cycle that is cancelled stops its lens and answers well within this."""

READ_BYTES = 1 << 16
MOST_EVENTS = 10_000
"""Events that wait for whoever iterates; past it reading stops, and the daemon drops and counts."""


class AsyncClient(AsyncMethods):
    """A daemon to talk to, from one event loop.

    Parameters
    ----------
    path
        The daemon's socket; found (``socket_path``) if not given.
    timeout_s
        How long an answer may take that the daemon gives at once.

    """

    def __init__(self, path: str | Path | None = None, *, timeout_s: float = 5.0) -> None:
        self.path = socket_path(path)
        self.timeout_s = timeout_s
        self._link: _Link | None = None
        self._linking = asyncio.Lock()

    async def close(self) -> None:
        """End the connection; the next call makes a new one."""
        link, self._link = self._link, None
        if link is not None:
            await link.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def call(self, method: str, params: dict[str, Any] | None = None, timeout_s: float | None = None) -> Any:
        """Ask for *method* and return its result.

        One that only reads is asked once more if the connection ends before its answer has come.
        """
        timeout_s = patience_s(method, params, self.timeout_s) if timeout_s is None else timeout_s
        for last in (False, True):
            link = await self._linked()
            try:
                return await link.answer(method, params or {}, timeout_s)
            except _LostError as error:
                if last or (error.sent and method not in READS):
                    raise
        raise AssertionError

    async def focus(
        self,
        roi: RoiBox | None = None,
        reference: str | None = None,
        preset: str | None = None,
        on_disconnect: Literal["finish", "cancel"] = "finish",
        *,
        dry_run: bool = False,
        timeout_s: float = 60.0,
    ) -> FocusAnswer:
        """Run one cycle and return how it ended.

        After *timeout_s* it is cancelled, and its lens stopped, before this returns (outcome ``CANCELLED``). A task
        that is cancelled while it awaits this asks the daemon to cancel the cycle.
        """
        params = given(roi=roi, reference=reference, preset=preset, dry_run=dry_run, on_disconnect=on_disconnect)
        cycle = asyncio.ensure_future(self.call("focus", params, timeout_s + CANCEL_S))
        try:
            done, _ = await asyncio.wait({cycle}, timeout=timeout_s)
            if not done:
                await self.cancel()
            answer: FocusAnswer = await cycle
        except asyncio.CancelledError:
            cycle.cancel()
            if self._link is not None:
                self._link.post("cancel")
            raise
        return answer

    async def events(
        self, kinds: Sequence[str] | None = None, rate_hz: float | None = None, *, reconnect_s: float = 0.0
    ) -> AsyncGenerator[Event, None]:
        """Yield what the daemon tells, over a connection of its own; as `Client.events`."""
        params: dict[str, Any] = {} if kinds is None else {"events": list(kinds)}
        if rate_hz is not None:
            params["rate_hz"] = rate_hz
        again = False
        while True:
            link = await self._listening(params, reconnect_s if again else 0.0)
            try:
                if again:
                    yield RECONNECTED
                again = True
                while (event := await link.events.get()) is not None:
                    yield event
            finally:
                await link.close()
            if not reconnect_s:
                raise UnreachableError(f"{self.path}: {link.broken}")

    async def _listening(self, params: dict[str, Any], for_s: float) -> _Link:
        loop = asyncio.get_running_loop()
        deadline, pause_s = loop.time() + for_s, FIRST_PAUSE_S
        while True:
            try:
                link = await _Link.to(self.path, self.timeout_s)
                try:
                    await link.answer("subscribe", params, self.timeout_s)
                except BaseException:
                    await link.close()
                    raise
            except UnreachableError:
                if loop.time() + pause_s > deadline:
                    raise
                await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            else:
                return link

    async def _linked(self) -> _Link:
        async with self._linking:
            if self._link is not None and self._link.broken:
                await self.close()
            if self._link is None:
                self._link = await _Link.to(self.path, self.timeout_s)
            return self._link


class _LostError(UnreachableError):
    """The connection ended before the answer; *sent* says whether the daemon may have had the request."""

    def __init__(self, message: str, *, sent: bool) -> None:
        super().__init__(message)
        self.sent = sent


class _Link:
    """One connection, and a task that reads it."""

    def __init__(self, path: Path, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._path = path
        self._reader = reader
        self._writer = writer
        self._numbers = itertools.count(1)
        self._waited: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self.events: asyncio.Queue[Any] = asyncio.Queue(MOST_EVENTS)
        self.broken = ""
        self._task = asyncio.ensure_future(self._read())

    @classmethod
    async def to(cls, path: Path, timeout_s: float) -> _Link:
        """Connect. Raises ``UnreachableError``."""
        try:
            async with asyncio.timeout(timeout_s):
                reader, writer = await asyncio.open_unix_connection(str(path), limit=LONGEST_ANSWER)
        except OSError as error:
            raise UnreachableError(f"{path}: {why_not(error)}") from None
        return cls(path, reader, writer)

    async def answer(self, method: str, params: dict[str, Any], timeout_s: float) -> Any:
        """Send a request and await its result."""
        if ready(self._writer.get_extra_info("socket"), select.POLLHUP, 0.0):  # before the reader has come to it
            self._end("the daemon is gone")
        if self.broken:
            raise _LostError(f"{self._path}: {self.broken}", sent=False)
        number = next(self._numbers)
        answer = self._waited[number] = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(timeout_s):
                self._writer.write(request_line(number, method, params))
                return result_of(await answer)
        except TimeoutError:
            raise UnreachableError(f"{self._path}: no answer to `{method}` within {timeout_s:g} s") from None
        finally:
            self._waited.pop(number, None)

    def post(self, method: str) -> None:
        """Send a request whose answer nobody awaits."""
        if not self.broken:
            self._writer.write(request_line(next(self._numbers), method, {}))

    async def close(self) -> None:
        """End the connection; whoever awaits an answer is told."""
        self._end("this client was closed")
        self._task.cancel()
        with suppress(asyncio.CancelledError):
            await self._task
        self._writer.close()
        with suppress(OSError):
            await self._writer.wait_closed()

    async def _read(self) -> None:
        lines = Lines()
        try:
            while data := await self._reader.read(READ_BYTES):
                for message in lines.feed(data):
                    await self._hand_out(message)
            self._end("the daemon closed the connection")
        except (OSError, UnreachableError) as error:
            self._end(str(error))

    async def _hand_out(self, message: dict[str, Any]) -> None:
        number = message.get("id")
        if "event" in message:
            await self.events.put(message)
        elif isinstance(number, int) and number in self._waited:
            waiting = self._waited[number]
            if not waiting.done():
                waiting.set_result(message)
        elif number is None and "error" in message:  # not to one request: the connection is refused
            self._end(str(message["error"].get("message")))

    def _end(self, why: str) -> None:
        if self.broken:
            return
        self.broken = why
        for waiting in self._waited.values():
            if not waiting.done():
                waiting.set_exception(_LostError(f"{self._path}: {why} before it answered", sent=True))
        if self.events.full():
            self.events.get_nowait()
        self.events.put_nowait(None)
