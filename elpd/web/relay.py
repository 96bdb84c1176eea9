"""One subscription, shared by every tab.

The daemon sends its events once; here they get a number of ours, go into a ring of bounded size, and into the queue of
each tab. A tab that comes back with the number it saw last gets what it missed, if the ring still has it; else it is
told to forget what it knows, and gets the present cycle from its beginning. A tab that does not read loses its oldest
samples, is told how many, and costs nobody else anything.

``status`` is asked for as long as anybody watches, and only its newest answer matters: it is no part of the ring.
"""

from __future__ import annotations

import asyncio
import json
import os
import secrets
from collections import deque
from contextlib import aclosing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import structlog

from elpd.client.aio import AsyncClient
from elpd.errors import ElpdError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Coroutine, Mapping
    from pathlib import Path

RING_EVENTS = 4096
"""A cycle of ten seconds at the rate below, and some."""
TAB_EVENTS = 1024
SAMPLE_RATE_HZ = 200
"""A cycle may take a fifth of a second; a curve needs some tens of points."""
STATUS_EVERY_S = 0.5
RETRY_FIRST_S, RETRY_LAST_S = 0.25, 5.0

log = structlog.get_logger(__name__)


@dataclass(slots=True, eq=False)
class Tab:
    """What waits for one tab: messages in the form in which they are sent, the samples among them expendable."""

    _waiting: deque[tuple[bool, bytes]] = field(default_factory=deque)
    _news: asyncio.Event = field(default_factory=asyncio.Event)
    _dropped: int = 0

    def put(self, message: bytes, *, expendable: bool = False) -> None:
        """Append one message; where there is no room, the oldest expendable one goes, else the oldest."""
        if len(self._waiting) >= TAB_EVENTS:
            oldest = next((place for place, (sample, _) in enumerate(self._waiting) if sample), 0)
            del self._waiting[oldest]
            self._dropped += 1
        self._waiting.append((expendable, message))
        self._news.set()

    async def batch(self) -> bytes:
        """Wait until there is something, and take everything."""
        await self._news.wait()
        self._news.clear()
        parts = [message for _, message in self._waiting]
        self._waiting.clear()
        if self._dropped:
            parts.insert(0, message_bytes("dropped", {"count": self._dropped}))
            self._dropped = 0
        return b"".join(parts)


class Relay:
    """The telemetry side of the gateway."""

    def __init__(self, daemon: Path) -> None:
        self._daemon = daemon
        self._epoch = secrets.token_hex(4)
        self._ring: deque[tuple[int, bool, bytes]] = deque(maxlen=RING_EVENTS)
        self._last = 0
        self._cycle_from = 1
        self._in_cycle = False
        self._tabs: set[Tab] = set()
        self._wanted = asyncio.Event()
        self._link: dict[str, Any] = {"connected": False, "reason": "not asked yet"}
        self._status: bytes | None = None

    @property
    def tabs(self) -> int:
        """How many watch."""
        return len(self._tabs)

    def join(self, last_seen: str | None) -> Tab:
        """Open a tab's queue, filled with what it missed."""
        tab = Tab()
        tab.put(message_bytes("link", self._link))
        missed = self._missed(last_seen)
        if missed is None:
            tab.put(message_bytes("reset", {}))
            missed = [entry for entry in self._ring if entry[0] >= self._cycle_from]
        for _, expendable, message in missed:
            tab.put(message, expendable=expendable)
        if self._status is not None:
            tab.put(self._status)
        self._tabs.add(tab)
        self._wanted.set()
        return tab

    def leave(self, tab: Tab) -> None:
        """Forget a tab."""
        self._tabs.discard(tab)
        if not self._tabs:
            self._wanted.clear()

    async def run(self) -> None:
        """Keep the subscription, for ever: connect, listen, ask for the status; wait a little longer each time."""
        retry_s = RETRY_FIRST_S
        while True:
            async with AsyncClient(self._daemon) as client:
                try:
                    hello = await client.hello()
                    retry_s = RETRY_FIRST_S
                    self._in_cycle = False
                    told = {"role": hello["role"], "version": hello["version"], "pid": os.getpid()}
                    self._tell_link({"connected": True, **told})
                    await _until_one_fails(self._listen(client), self._watch(client))
                except ElpdError as error:
                    self._tell_link({"connected": False, "reason": str(error), "retry_s": retry_s})
            await asyncio.sleep(retry_s)
            retry_s = min(2 * retry_s, RETRY_LAST_S)

    async def _listen(self, client: AsyncClient) -> None:
        """Hear events until the daemon goes, which raises."""
        told = cast("AsyncGenerator[Mapping[str, Any], None]", client.events(rate_hz=SAMPLE_RATE_HZ))
        async with aclosing(told) as events:
            async for event in events:
                self._hear(event)

    async def _watch(self, client: AsyncClient) -> None:
        """Ask for the status for as long as somebody looks; a daemon that does not answer raises."""
        while True:
            self._status = message_bytes("status", await client.call("status"))
            for tab in self._tabs:
                tab.put(self._status)
            await asyncio.sleep(STATUS_EVERY_S)
            await self._wanted.wait()

    def _hear(self, event: Mapping[str, Any]) -> None:
        kind = str(event["event"])
        if kind == "phase" and not self._in_cycle and event.get("phase") not in {"idle", "done"}:
            self._in_cycle, self._cycle_from = True, self._last + 1
        elif kind == "result":
            self._in_cycle = False
        self._last += 1
        fields = {key: value for key, value in event.items() if key != "event"}
        message = message_bytes(kind, fields, f"{self._epoch}.{self._last}")
        expendable = kind in {"sample", "position"}
        self._ring.append((self._last, expendable, message))
        for tab in self._tabs:
            tab.put(message, expendable=expendable)

    def _tell_link(self, link: dict[str, Any]) -> None:
        if link["connected"] != self._link["connected"]:
            log.info("daemon", **link)
        self._link = link
        self._status = self._status if link["connected"] else None
        for tab in self._tabs:
            tab.put(message_bytes("link", link))

    def _missed(self, last_seen: str | None) -> list[tuple[int, bool, bytes]] | None:
        """Return what came after *last_seen*; ``None`` where that is not known any more."""
        epoch, _, number = (last_seen or "").partition(".")
        if epoch != self._epoch or not (number.isascii() and number.isdigit()):
            return None
        seen = int(number)
        oldest = self._ring[0][0] if self._ring else self._last + 1
        if not oldest - 1 <= seen <= self._last or self._last - seen > TAB_EVENTS // 2:
            return None
        return [entry for entry in self._ring if entry[0] > seen]


def message_bytes(kind: str, fields: dict[str, Any], number: str | None = None) -> bytes:
    """Return one server-sent event. JSON has no bare line breaks, so one ``data`` line is enough."""
    head = f"id: {number}\n" if number is not None else ""
    return f"{head}event: {kind}\ndata: {json.dumps(fields, separators=(',', ':'))}\n\n".encode()


async def _until_one_fails(*works: Coroutine[Any, Any, None]) -> None:
    """Do all until one ends, end the others, and raise what it raised."""
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        outcomes = await asyncio.gather(*tasks, return_exceptions=True)
    for outcome in outcomes:
        if isinstance(outcome, Exception):
            raise outcome
