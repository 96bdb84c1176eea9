"""A clock for tests: time moves when somebody sleeps, and the actors (ports, worlds) live through it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol

from elpd.units import HostNs

if TYPE_CHECKING:
    from collections.abc import Callable


class Actor(Protocol):
    def advance_to(self, when: HostNs) -> None: ...


class TestClock:
    __test__ = False

    def __init__(self, start_ns: int = 1_000_000_000) -> None:
        self._now = HostNs(start_ns)
        self.actors: list[Actor] = []

    def now_ns(self) -> HostNs:
        return self._now

    def sleep_until(self, when: HostNs) -> None:
        if when > self._now:
            for actor in self.actors:
                actor.advance_to(when)
            self._now = when

    def pass_ms(self, ms: float, each: Callable[[], object] | None = None, step_ms: float = 1.0) -> None:
        end = HostNs(self._now + round(ms * 1e6))
        while self._now < end:
            self.sleep_until(HostNs(min(end, self._now + round(step_ms * 1e6))))
            if each is not None:
                each()


class MonotonicClock:
    """The machine's own clock, for tests against a pty: it waits, but nothing is asserted about how long."""

    def now_ns(self) -> HostNs:
        return HostNs(time.monotonic_ns())

    def sleep_until(self, when: HostNs) -> None:
        time.sleep(max(0.0, (when - time.monotonic_ns()) / 1e9))
