"""What the page can ask the daemon for: a short table, and an HTTP status for each kind of refusal.

Parameters pass through as they came; the daemon judges them, and its sentence is what the person reads. STOP and
cancel have a connection of their own, so that nothing ever queues before them.

A lease belongs to a connection, and all tabs share one. Which of them asked for it is known here alone, so here the
others are kept out; from everybody else the daemon keeps the rig.
"""

from __future__ import annotations

import asyncio
import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from elpd.client.aio import AsyncClient
from elpd.errors import BusyError, ElpdError, UnreachableError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

URGENT = frozenset({"stop", "cancel"})
COMMANDS = URGENT | {
    "focus", "home", "move", "jog", "clear", "roi", "preset", "mode", "temperature", "record", "lease",
}  # fmt: skip
QUESTIONS = frozenset({"hello", "status", "runs", "run", "map", "metrics", "roi", "mode", "presets"})
"""What a GET may ask. ``roi`` and ``mode`` without parameters only read; ``presets`` is the list of ``preset``."""

AUTO = ("frame", "map")
"""What somebody who draws a region wants to see; the newest of what there is, if there is neither."""

IN_FLIGHT = 6
"""The daemon allows eight requests in flight on a connection."""
URGENT_WITHIN_S = 2.0

STATUS_OF = {
    "Busy": 409,
    "Unreferenced": 409,
    "Forbidden": 403,
    "Fault": 423,
    "UsageError": 400,
    "ConfigError": 400,
    "TooLarge": 413,
    "DeviceError": 502,
    "LensError": 502,
    "CameraError": 502,
    "Unavailable": 503,
    "Unreachable": 503,
}
"""HTTP status of each kind of error; 500 for one that is not listed."""


def kind_of(error: ElpdError) -> str:
    """Return the socket's word for an error."""
    return error.kind.removesuffix("Error") if isinstance(error, BusyError) else error.kind


class Desk:
    """Carries requests to the daemon."""

    def __init__(self, daemon: Path) -> None:
        self._ordinary = AsyncClient(daemon)
        self._looking = AsyncClient(daemon)
        self._urgent = AsyncClient(daemon, timeout_s=URGENT_WITHIN_S)
        self._in_flight = {"command": 0, "question": 0}
        self._keeper: tuple[str, float] | None = None
        """The tab that has the lease, and until when (the loop's clock)."""

    async def command(self, method: str, params: dict[str, Any], tab: str = "") -> Any:
        """Ask, for a *tab*, for something that may move the lens. Raises ``ElpdError``."""
        if method in URGENT:
            return await self._now(method, params)
        self._refuse_other_tabs(tab)
        if method == "lease":
            return await self._lease(params, tab)
        return await self._counted("command", self._ordinary, method, params)

    async def question(self, method: str, params: dict[str, Any]) -> Any:
        """Ask for something that only reads: a slow answer never stands before a command. Raises ``ElpdError``."""
        return await self._counted("question", self._looking, method, params)

    async def picture(self, params: dict[str, Any]) -> Any:
        """Ask for a picture; the kind ``auto`` is the first of those that there are. Raises ``ElpdError``."""
        if params.get("kind") == "auto":
            for kind in AUTO:
                with suppress(UsageError):
                    return await self.question("map", params | {"kind": kind})
            params = params | {"kind": "latest"}
        return await self.question("map", params)

    async def close(self) -> None:
        """Hang up."""
        for client in (self._ordinary, self._looking, self._urgent):
            await client.close()

    def _refuse_other_tabs(self, tab: str) -> None:
        left_s = 0.0 if self._keeper is None else self._keeper[1] - asyncio.get_running_loop().time()
        if self._keeper is not None and self._keeper[0] != tab and left_s > 0:
            raise BusyError("another page keeps the rig for itself; wait, or give it back there")

    async def _lease(self, params: dict[str, Any], tab: str) -> Any:
        before, self._keeper = self._keeper, (tab, math.inf)  # nobody comes between the question and the answer
        try:
            answer = await self._counted("command", self._ordinary, "lease", params)
        except BaseException:
            self._keeper = before
            raise
        kept = answer["holder"] is not None
        self._keeper = (tab, asyncio.get_running_loop().time() + answer["until_s"]) if kept else None
        return answer

    async def _counted(self, side: str, client: AsyncClient, method: str, params: dict[str, Any]) -> Any:
        if self._in_flight[side] >= IN_FLIGHT:
            raise BusyError(f"{IN_FLIGHT} requests of the page are still unanswered; wait for them")
        self._in_flight[side] += 1
        try:
            return await client.call(method, params)
        finally:
            self._in_flight[side] -= 1

    async def _now(self, method: str, params: dict[str, Any]) -> Any:
        try:
            return await self._urgent.call(method, params)
        except UnreachableError as error:
            await self._urgent.close()  # the next one gets a fresh connection
            raise UnreachableError(f"{error}; use the rig's own switch if anything moves") from None
