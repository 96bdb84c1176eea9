"""The listening side: how many may be connected, and how long anybody may say nothing.

Whoever can reach the loopback can open connections, without any token. So they are counted, one that has not asked for
anything within seconds is closed, and so is one that has been idle for a minute; what runs (a stream of events, a
cycle's answer) is not idle. Browsers open a new connection where an old one has gone.
"""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from aiohttp import web

if TYPE_CHECKING:
    import socket
    from collections.abc import AsyncIterator

MOST_CONNECTIONS = 256
"""Twenty-four tabs of six, and programs; well below the 1024 files that a process may have open."""
HEAD_WITHIN_S = 10.0
IDLE_S = 60.0
SHUTDOWN_S = 1.0
BACKLOG = 64


@asynccontextmanager
async def listening_on(app: web.Application, listening: socket.socket) -> AsyncIterator[None]:
    """Serve *app* on an open socket until the end of the block."""
    runner = web.AppRunner(app, access_log=None, handle_signals=False, shutdown_timeout=SHUTDOWN_S)
    await runner.setup()
    assert runner.server is not None
    loop = asyncio.get_running_loop()
    options: dict[str, Any] = {"access_log": None, "keepalive_timeout": IDLE_S, "auto_decompress": False}  # no bombs
    made = partial(Caller, runner.server, loop=loop, **options)
    server = await loop.create_server(made, sock=listening, backlog=BACKLOG)
    try:
        yield
    finally:
        server.close()
        await runner.cleanup()


class Caller(web.RequestHandler):
    """One connection."""

    __slots__ = ("_late",)

    _late: asyncio.TimerHandle

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin, unless there are too many."""
        super().connection_made(transport)
        self._late = self._loop.call_later(HEAD_WITHIN_S, self.force_close)
        if self._manager is not None and len(self._manager.connections) > MOST_CONNECTIONS:
            self.force_close()

    def connection_lost(self, exc: BaseException | None) -> None:
        """End."""
        self._late.cancel()
        super().connection_lost(exc)

    def has_asked(self) -> None:
        """Hear that a request's head is there: from now on only idleness counts."""
        self._late.cancel()


def has_asked(request: web.Request) -> None:
    """Tell a request's connection that it has said something."""
    caller: Any = request.protocol
    if isinstance(caller, Caller):
        caller.has_asked()
