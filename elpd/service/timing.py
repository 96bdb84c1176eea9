"""The engine's time: seconds that never go back, real or simulated, whatever happens to the rig.

Real time is ``CLOCK_MONOTONIC``; jumps of the wall clock change nothing. On a rig in virtual time the rig's clock is
the time, and a rig that is opened again begins a new world: its time goes on where the old one's ended.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol

from elpd.timebase import MonotonicClock
from elpd.units import NS_PER_S, HostNs

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.ports import Clock


class Time(Protocol):
    """What tells the engine's time and lets it pass."""

    def now_s(self) -> float:
        """Return the present instant."""
        ...

    def follow(self, clock: Clock | None) -> None:
        """Hear which rig's clock runs now."""
        ...

    def nap(self, seconds: float) -> None:
        """Let time pass while nothing is to be done; a request may end it early."""
        ...


class RealTime:
    """The host's monotonic clock. A simulated rig that keeps the wall clock's pace lives beside it.

    Parameters
    ----------
    wait
        Returns after so many seconds, or when there is something to do.
    """

    def __init__(self, wait: Callable[[float], None]) -> None:
        self._wait = wait
        self._world: Clock | None = None

    def now_s(self) -> float:
        """Return the present instant."""
        return time.monotonic()

    def follow(self, clock: Clock | None) -> None:
        """Let a world that is not the host's live on while the engine naps."""
        self._world = None if isinstance(clock, MonotonicClock) else clock

    def nap(self, seconds: float) -> None:
        """Wait for something to do."""
        if self._world is None:
            self._wait(seconds)
        else:
            self._world.sleep_until(HostNs(self._world.now_ns() + round(seconds * NS_PER_S)))


class VirtualTime:
    """The rig's own clock, for an engine that is stepped."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._clock: Clock | None = None
        self._begun_s, self._from_ns = start_s, 0

    def now_s(self) -> float:
        """Return the present instant."""
        if self._clock is None:
            return self._begun_s
        return self._begun_s + (self._clock.now_ns() - self._from_ns) / NS_PER_S

    def follow(self, clock: Clock | None) -> None:
        """Go on from here by another clock."""
        self._begun_s = self.now_s()
        self._clock = clock
        self._from_ns = 0 if clock is None else clock.now_ns()

    def nap(self, seconds: float) -> None:
        """Let time pass."""
        if self._clock is None:
            self._begun_s += seconds
        else:
            self._clock.sleep_until(HostNs(self._clock.now_ns() + round(seconds * NS_PER_S)))
