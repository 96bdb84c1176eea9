"""What the page can ask the daemon for: a short table, and an HTTP status for each kind of refusal.

Parameters pass through as they came; the daemon judges them, and its sentence is what the person reads. STOP and
cancel have a connection of their own, so that nothing ever queues before them.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from elpd.web.link import DaemonError, Link

if TYPE_CHECKING:
    from pathlib import Path

URGENT = frozenset({"stop", "cancel"})
COMMANDS = URGENT | {"focus", "home", "move", "jog", "clear", "roi", "preset", "mode", "temperature", "record"}
QUESTIONS = frozenset({"hello", "status", "runs", "run", "map", "metrics", "roi", "mode", "presets"})
"""What a GET may ask; ``roi`` and ``mode`` without parameters only read, ``presets`` is ``preset`` asked for its list."""

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
    "FormatError": 400,
    "TooLarge": 413,
    "LensError": 502,
    "CameraError": 502,
    "DeviceError": 502,
    "Unavailable": 503,
    "TooMany": 429,
    "Timeout": 504,
}
"""HTTP status of each kind of error; 500 for a kind that a newer daemon may have."""


class Desk:
    """Carries requests to the daemon."""

    def __init__(self, socket: Path) -> None:
        self._ordinary = Link(socket)
        self._looking = Link(socket)
        self._urgent = Link(socket)
        self._in_flight = {"command": 0, "question": 0}

    async def command(self, method: str, params: dict[str, Any]) -> Any:
        """Ask for something that may move the lens. Raises ``DaemonError``."""
        if method in URGENT:
            return await self._now(method, params)
        return await self._counted("command", self._ordinary, method, params)

    async def question(self, method: str, params: dict[str, Any]) -> Any:
        """Ask for something that only reads: a slow answer never stands before a command. Raises ``DaemonError``."""
        return await self._counted("question", self._looking, method, params)

    async def close(self) -> None:
        """Hang up."""
        for link in (self._ordinary, self._looking, self._urgent):
            await link.close()

    async def _counted(self, side: str, link: Link, method: str, params: dict[str, Any]) -> Any:
        if self._in_flight[side] >= IN_FLIGHT:
            raise DaemonError("TooMany", f"{IN_FLIGHT} requests are still unanswered; wait for them")
        self._in_flight[side] += 1
        try:
            return await link.call(method, params)
        finally:
            self._in_flight[side] -= 1

    async def _now(self, method: str, params: dict[str, Any]) -> Any:
        try:
            async with asyncio.timeout(URGENT_WITHIN_S):
                return await self._urgent.call(method, params)
        except TimeoutError:
            await self._urgent.close()  # the next one gets a fresh connection
            raise DaemonError(
                "Timeout", f"the daemon has not answered {method} for {URGENT_WITHIN_S:g} s; use the rig's own switch"
            ) from None
