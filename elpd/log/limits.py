"""Lines that come again and again: the first few are kept, then one a second, and what was held back is counted.

A lens that is plugged out makes the same line ten times a second for a weekend. The canonical line of a cycle and debug
lines are never held back: the first is the record of what happened, the second was asked for.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import structlog

if TYPE_CHECKING:
    from structlog.typing import EventDict, WrappedLogger

CANONICAL = frozenset({"focus cycle"})
BURST = 10
PER_S = 1.0


class Limits:
    """Raises ``DropEvent`` for lines beyond the limit; the next line of any name tells how many, as ``held_back``."""

    def __init__(self, burst: int = BURST, per_s: float = PER_S) -> None:
        self._burst = float(burst)
        self._per_s = per_s
        self._allowance: dict[str, tuple[float, int]] = {}
        self._held_back: dict[str, int] = {}
        self._lock = threading.Lock()

    def __call__(self, _: WrappedLogger, __: str, event: EventDict) -> EventDict:
        """Pass or drop a line, by its name and its own ``monotonic_ns``."""
        name = str(event["event"])
        if event["level"] == "debug" or name in CANONICAL:
            return event
        with self._lock:
            if not self._may_pass(name, event["monotonic_ns"]):
                self._held_back[name] = self._held_back.get(name, 0) + 1
                raise structlog.DropEvent
            if self._held_back:
                event["held_back"] = self._held_back
                self._held_back = {}
        return event

    def _may_pass(self, name: str, now_ns: int) -> bool:
        left, before_ns = self._allowance.get(name, (self._burst, now_ns))
        left = min(self._burst, left + (now_ns - before_ns) * 1e-9 * self._per_s)
        passes = left >= 1.0
        self._allowance[name] = (left - passes, now_ns)
        return passes
