"""The socket's server: one thread, one loop, in front of an engine that never waits for it.

Bytes come in on many connections; each turn of the loop first lets every reader look at what has come (and do `stop`
and `cancel`), then works off a few waiting lines, of different clients in turn, then tells a few events. All three are
bounded, so a turn is short whatever the clients do, and a STOP waits for one turn at most. Nothing of the engine waits
either: its events and answers go into a queue that wakes this loop, and past a bound samples are dropped and counted.
"""

from __future__ import annotations

import asyncio
import sys
import threading
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Self

import structlog

from elpd.errors import UnavailableError
from elpd.service.connection import Connection
from elpd.service.desk import Desk, error_line
from elpd.service.engine_port import Caller, ClientCounts, error_body
from elpd.service.listening import Listening, default_path, listen_at
from elpd.service.peers import Operators, peer_of
from elpd.service.telling import Telling

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from elpd.config import ApiSection
    from elpd.service.engine_port import Engine
    from elpd.service.lines import Call

MOST_CLIENTS = 32

MOST_STOPPERS = 8
"""Further connections, for `stop` and `cancel` alone: a full house must not keep a STOP out. The oldest makes room."""

LINES_A_TURN = 8

BEAT_S = 0.25
"""The loop's housekeeping and its sign of life."""

GRACE_S = 1.0
"""At the end, requests have so long to end as CANCELLED, and clients so long to take their answers."""

START_S = 10.0


class ApiServer:
    """The daemon's socket.

    Parameters
    ----------
    engine
        What owns the rig.
    section
        The configuration's ``api`` table.
    sockets
        Listening sockets that a supervisor has handed over (``listening.handed_over``); without any, the server makes
        its own.

    """

    def __init__(self, engine: Engine, section: ApiSection, sockets: Sequence[socket.socket] = ()) -> None:
        self._engine = engine
        self._section = section
        self._listening = Listening(list(sockets))
        self._operators = Operators.of_group(section.operators)
        self._connections: dict[int, Connection] = {}
        self._news = asyncio.Event()
        self._telling = Telling(self._connections.values, self._soon, self._from_any_thread, self._news.set)
        self._desk = Desk(engine, self._telling.answer)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ending = asyncio.Event()
        self._running = threading.Event()
        self._thread = threading.Thread(target=self._run, name="elpd-api", daemon=True)
        self._numbers = 0
        self.stops = 0
        self._working: deque[Connection] = deque()
        self._dropped_clients = 0
        self._dropped_events = 0
        self._log = structlog.get_logger()

    @property
    def path(self) -> Path | None:
        """The socket's path, where this server made it."""
        return self._listening.path

    def start(self) -> None:
        """Listen. Raises ``BusyError`` or ``ConfigError`` if that cannot be."""
        if self._listening.sockets:
            self._listening.claim()
        else:
            self._listening = listen_at(self._section.socket or default_path())
        self._loop = asyncio.new_event_loop()
        self._thread.start()
        if not self._running.wait(START_S):
            raise UnavailableError(f"the socket's thread did not begin within {START_S:g} s")

    def stop(self) -> None:
        """Answer what is in flight, close every connection, listen no more. Returns within three graces."""
        if self._loop is None:
            self._listening.close()
            return
        with suppress(RuntimeError):  # it has ended already
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join(3 * GRACE_S)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    # --- the thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        assert self._loop is not None
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve(self._loop))
        finally:
            self._listening.close()
            self._loop.close()

    async def _serve(self, loop: asyncio.AbstractEventLoop) -> None:
        loop.set_exception_handler(self._broke)
        quit_listening = self._engine.listen(self._telling.event)
        options: dict[str, Any] = {"cleanup_socket": False} if sys.version_info >= (3, 13) else {}
        servers = [
            await loop.create_unix_server(lambda: Connection(self), sock=listener, **options)
            for listener in self._listening.sockets
        ]
        self._keep_house(loop)
        self._running.set()
        await self._ending.wait()
        for server in servers:
            server.close()
        await self._until(lambda: not any(connection.in_flight for connection in self._connections.values()))
        quit_listening()
        for connection in list(self._connections.values()):
            for number in connection.in_flight:
                connection.send(error_line(number, error_body(UnavailableError("the daemon ends"))))
            connection.close()
        await self._until(lambda: not self._connections)
        for connection in list(self._connections.values()):
            connection.drop("the daemon ends")
        await asyncio.sleep(0)

    async def _until(self, reached: Any) -> None:
        """Wait for something, a grace long."""
        with suppress(TimeoutError):
            async with asyncio.timeout(GRACE_S):
                while not reached():
                    await self._news.wait()
                    self._news.clear()

    def _keep_house(self, loop: asyncio.AbstractEventLoop) -> None:
        now_s = loop.time()
        for connection in list(self._connections.values()):
            connection.check(now_s)
        self._engine.beat("api")
        loop.call_later(BEAT_S, self._keep_house, loop)

    def _soon(self, work: Callable[[], None]) -> None:
        assert self._loop is not None
        self._loop.call_soon(work)

    def _from_any_thread(self, work: Callable[[], None]) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # it has ended: there is nobody left to tell
                self._loop.call_soon_threadsafe(work)

    def _broke(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        del loop
        self._log.error("socket broke", what=context.get("message"), error=repr(context.get("exception")))

    # --- what connections tell (``connection.Owner``) ---------------------------------------------------------------

    def joined(self, connection: Connection) -> None:
        """Take in a client, or one that may only stop."""
        peer = peer_of(connection.socket)
        self._numbers += 1
        connection.caller = Caller(self._numbers, peer.pid, peer.uid, peer.name)
        connection.operates = self._operators.include(peer)
        stoppers = [other for other in self._connections.values() if other.stop_only]
        connection.stop_only = len(self._connections) - len(stoppers) >= MOST_CLIENTS
        if connection.stop_only and len(stoppers) >= MOST_STOPPERS:
            stoppers[0].drop("another one may want to stop the lens")
        self._connections[self._numbers] = connection
        self._count()
        self._log.debug("client joined", pid=peer.pid, uid=peer.uid, name=peer.name, operates=connection.operates)

    def urgent(self, connection: Connection, call: Call) -> None:
        """Do it now. What moves the lens and came before it, from whomever, will not be begun after it."""
        self.stops += connection.operates
        self._desk.do(connection, call)

    def waits(self, connection: Connection) -> None:
        """Take the client's lines in turn with the others'."""
        self._working.append(connection)
        if len(self._working) == 1:
            self._soon(self._work)

    def left(self, connection: Connection) -> None:
        """Let the engine know: leases end, and requests that asked to end with their client."""
        caller = connection.caller
        if caller is None or self._connections.pop(caller.connection, None) is None:
            return
        if connection.why_dropped:
            self._dropped_clients += 1
            self._log.warning("client dropped", pid=caller.pid, uid=caller.uid, why=connection.why_dropped)
        self._count()
        self._news.set()
        self._engine.gone(caller)

    def dropped(self, connection: Connection, events: int) -> None:
        """Count what a client that does not read was not told."""
        del connection
        self._dropped_events += events
        self._count()

    def _count(self) -> None:
        dropped = self._dropped_events + self._telling.dropped
        self._engine.note_clients(ClientCounts(len(self._connections), self._dropped_clients, dropped))

    def _work(self) -> None:
        """Take a few lines, one of each client in turn."""
        for _ in range(min(LINES_A_TURN, len(self._working))):
            connection = self._working.popleft()
            if connection.lines:
                line, stops = connection.lines.popleft()
                self._desk.take(connection, line, overtaken=stops < self.stops)
            if connection.lines:
                self._working.append(connection)
        if self._working:
            self._soon(self._work)
