"""A real Chromium before a real gateway. Whatever a test does, the page must log no error and break no policy."""

from __future__ import annotations

import asyncio
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from socket import create_server
from typing import TYPE_CHECKING, Any

import pytest
from browsers import launched
from fake_daemon import FakeDaemon, InThread
from gateways import TOKEN

from elpd.web.gateway import build_app, serve
from elpd.web.security import Gate, own_hosts

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser, BrowserContext, Page

PATIENCE_MS = 30_000
"""What comes at once on a machine of its own may take long on one that is busy; none of these tests is about time."""


@dataclass
class Rig:
    """The daemon behind the page, driven from the test's own thread."""

    daemon: FakeDaemon
    thread: InThread
    port: int

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def __getattr__(self, name: str) -> Any:
        """Call one of the daemon's methods in its own thread."""
        method = getattr(self.daemon, name)
        if asyncio.iscoroutinefunction(method):
            return lambda *args, **named: self.thread.run(method(*args, **named))
        return lambda *args, **named: self.thread.call(method, *args, **named)

    def put(self, **values: Any) -> None:
        for name, value in values.items():
            self.thread.call(setattr, self.daemon, name, value)

    def tells(self, status: dict[str, Any]) -> None:
        """Let every status from here on be this one."""
        self.thread.call(self.daemon.answers.__setitem__, "status", lambda _: status)

    def until_asked(self, method: str, params: dict[str, Any]) -> None:
        """Wait until this was asked for last, however often before."""
        self.thread.run(
            self.daemon.until(lambda: [given for name, given in self.daemon.asked if name == method][-1:] == [params])
        )

    def count(self, method: str) -> int:
        return [name for name, _ in self.daemon.asked].count(method)


@dataclass
class Opener:
    """Opens pages and remembers what they complained about."""

    browser: Browser
    rig: Rig
    complaints: list[str] = field(default_factory=list)
    expected: tuple[str, ...] = ()
    _contexts: list[BrowserContext] = field(default_factory=list)

    def __call__(self, *, token: str | None = TOKEN, wait: bool = True, **options: Any) -> Page:
        context = self.browser.new_context(**{"viewport": {"width": 1440, "height": 1000}} | options)
        self._contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.on("console", lambda message: self._hear(message.type, message.text))
        page.on("pageerror", lambda error: self._hear("error", str(error)))
        page.goto(self.rig.address + (f"#token={token}" if token else ""))
        if wait:
            page.wait_for_selector("#link[data-link=on]")
            page.wait_for_selector("#state[data-state=READY]")
            page.wait_for_selector("#image[src]")
            self.rig.heard()
        return page

    def _hear(self, kind: str, text: str) -> None:
        if kind in {"error", "warning"} and not any(part in text for part in self.expected):
            self.complaints.append(text)

    def close(self) -> None:
        for context in self._contexts:
            context.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Launch one for a module, not for all: while Playwright's loop runs, no other test could run its own."""
    with launched("--host-resolver-rules=MAP rebound.test 127.0.0.1") as browser:
        yield browser


@pytest.fixture
def rig() -> Iterator[Rig]:
    thread = InThread()
    with tempfile.TemporaryDirectory(prefix="elpd-web-") as folder:
        daemon = FakeDaemon(Path(folder) / "elpd.sock")
        thread.run(daemon.start())
        listening = create_server(("127.0.0.1", 0))
        port = listening.getsockname()[1]
        gate = Gate(own_hosts("127.0.0.1", port, ()), TOKEN)

        async def begin() -> asyncio.Task[None]:
            return asyncio.create_task(serve(build_app(daemon.path, gate), listening))

        async def end(task: asyncio.Task[None]) -> None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            if daemon.path.exists():
                await daemon.stop()

        serving = thread.run(begin())
        try:
            yield Rig(daemon, thread, port)
        finally:
            thread.run(end(serving))
            thread.close()


@pytest.fixture
def opened(browser: Browser, rig: Rig) -> Iterator[Opener]:
    sync_api = pytest.importorskip("playwright.sync_api")
    opener = Opener(browser, rig)
    sync_api.expect.set_options(timeout=PATIENCE_MS)
    yield opener
    sync_api.expect.set_options(timeout=5_000)
    opener.close()
    assert opener.complaints == []
