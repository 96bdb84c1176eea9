"""Signs of life: each loop beats, and one that is late is named. No watchdog is fed while one is.

A loop says how long it may be silent; a limit can be widened for something that is slow and ends by itself. What is
fed from a timer of its own proves nothing, so only ``late`` decides.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Heartbeats:
    """Who beat when. Thread-safe."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._lock = threading.Lock()
        self._limits_s: dict[str, float] = {}
        self._allowed_s: dict[str, float] = {}
        self._beats_s: dict[str, float] = {}

    def now_s(self) -> float:
        """Return the present instant of the clock that beats are judged by."""
        return self._now_s()

    def expect(self, loop: str, limit_s: float) -> None:
        """Expect *loop* to beat at least every *limit_s* from now on."""
        with self._lock:
            self._limits_s[loop] = limit_s
            self._beats_s[loop] = self._now_s()

    def forget(self, loop: str) -> None:
        """*loop* has ended."""
        with self._lock:
            for known in (self._limits_s, self._allowed_s, self._beats_s):
                known.pop(loop, None)

    def beat(self, loop: str) -> None:
        """*loop* lives."""
        with self._lock:
            self._beats_s[loop] = self._now_s()

    def allow(self, loop: str, limit_s: float | None) -> None:
        """Let *loop* be silent for *limit_s* at a time, until ``allow(loop, None)``. Counts as a beat."""
        with self._lock:
            self._beats_s[loop] = self._now_s()
            if limit_s is None:
                self._allowed_s.pop(loop, None)
            else:
                self._allowed_s[loop] = limit_s

    def late(self) -> dict[str, float]:
        """Return the loops that are past their limit, with how long they have been silent."""
        with self._lock:
            now_s = self._now_s()
            return {
                loop: now_s - self._beats_s[loop]
                for loop, limit_s in self._limits_s.items()
                if now_s - self._beats_s[loop] > max(limit_s, self._allowed_s.get(loop, 0.0))
            }

    def limit_s(self, loop: str) -> float:
        """Return for how long *loop* may be silent now; for ever, if it is not expected."""
        with self._lock:
            return max(self._limits_s.get(loop, float("inf")), self._allowed_s.get(loop, 0.0))

    def ages(self) -> dict[str, float]:
        """Return how long ago each loop beat."""
        with self._lock:
            now_s = self._now_s()
            return {loop: now_s - self._beats_s[loop] for loop in self._limits_s}
