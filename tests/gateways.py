"""A gateway before a fake daemon, in one event loop, and a client that behaves as the page does."""

from __future__ import annotations

import asyncio
import json
import tempfile
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from socket import create_server
from typing import TYPE_CHECKING, Any, Self

import aiohttp
from fake_daemon import FakeDaemon

from elpd.web.gateway import build_app, serve
from elpd.web.security import Gate, own_hosts

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine

    from aiohttp import web

TOKEN = "t0ken-of-this-test-" + 30 * "x"


def run(test: Coroutine[Any, Any, None]) -> None:
    """Run one asynchronous story, with an end."""

    async def bounded() -> None:
        async with asyncio.timeout(20.0):
            await test

    asyncio.run(bounded())


@dataclass
class Gateway:
    daemon: FakeDaemon
    session: aiohttp.ClientSession
    port: int
    app: web.Application
    host: str = field(init=False)

    def __post_init__(self) -> None:
        self.host = f"127.0.0.1:{self.port}"

    def url(self, path: str) -> str:
        return f"http://127.0.0.1:{self.port}{path}"

    def get(self, path: str, **headers: str) -> Any:
        return self.session.get(self.url(path), headers={"Authorization": f"Bearer {TOKEN}", **headers})

    def post(self, method: str, params: Any = None, **options: Any) -> Any:
        headers = {"Authorization": f"Bearer {TOKEN}", "X-Elpd": "1"}
        return self.session.post(self.url(f"/api/{method}"), json=params or {}, headers=headers, **options)

    def events(self, last_seen: str | None = None) -> Events:
        return Events(self, last_seen)


class Events:
    """A stream of server-sent events, read one at a time."""

    def __init__(self, gateway: Gateway, last_seen: str | None) -> None:
        headers = {"Last-Event-ID": last_seen} if last_seen else {}
        self._asking = gateway.get("/api/events", **headers)
        self.last_seen = last_seen

    async def __aenter__(self) -> Self:
        self.response = await self._asking.__aenter__()
        assert self.response.status == 200
        return self

    async def __aexit__(self, *error: object) -> None:
        await self._asking.__aexit__(*error)

    async def next(self, *kinds: str) -> tuple[str, dict[str, Any]]:
        """Return the next event, or the next of these kinds."""
        while True:
            fields = {}
            while line := (await self.response.content.readuntil(b"\n")).decode().rstrip("\n"):
                name, _, value = line.partition(": ")
                fields[name] = value
            if "event" not in fields:
                continue
            self.last_seen = fields.get("id", self.last_seen)
            if not kinds or fields["event"] in kinds:
                return fields["event"], json.loads(fields["data"])


@asynccontextmanager
async def gateway(*, hosts: tuple[str, ...] = (), with_daemon: bool = True) -> AsyncIterator[Gateway]:
    """Serve on a free port; the folder is short, because a socket's path must be."""
    with tempfile.TemporaryDirectory(prefix="elpd-web-") as folder:
        daemon = FakeDaemon(Path(folder) / "elpd.sock")
        if with_daemon:
            await daemon.start()
        listening = create_server(("127.0.0.1", 0))
        port = listening.getsockname()[1]
        gate = Gate(own_hosts("127.0.0.1", port, hosts), TOKEN)
        app = build_app(daemon.path, gate)
        serving = asyncio.create_task(serve(app, listening))
        try:
            async with aiohttp.ClientSession() as session:
                yield Gateway(daemon, session, port, app)
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            if daemon.path.exists():
                await daemon.stop()
