"""What the focus thread asks itself while it works: does somebody want this to end, has time jumped.

A process that was stopped, or a machine that slept, resumes in the middle of a sweep with seconds of the world unseen.
The gap shows between two of these questions, which come every few milliseconds; what was being done ends then, with the
lens stopped first.
"""

from __future__ import annotations

import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

from elpd.records import Cancel, StopMode
from elpd.timebase import MonotonicClock
from elpd.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from elpd.ports import Clock, Lens
    from elpd.service.heartbeats import Heartbeats
    from elpd.service.job import Job

PAUSE_S = 0.5
"""No turn of any loop takes a tenth of this; the boards' own dead-men bite after one or two seconds."""

STILL_S = 15.0
"""Between a cycle's motions pictures are made and files written: on a slow disk that takes time."""

MOVING_PHASES = frozenset({"probe", "sweep", "stop", "recross", "return"})
"""Phases of a cycle in which the lens moves."""


def host_s() -> float:
    """Return seconds that go on while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Attention:
    """Questions of the focus thread.

    Parameters
    ----------
    heartbeats
        Where this thread's signs of life go.
    loop
        Under which name.
    """

    def __init__(self, heartbeats: Heartbeats, loop: str) -> None:
        self._heartbeats = heartbeats
        self._loop = loop
        self._world_s = host_s
        self._asked_s = host_s()
        self._moving = self._moved = False

    def follow(self, clock: Clock | None) -> None:
        """Judge pauses by the world that the lens lives in: the machine's seconds, or a simulated rig's own."""
        if clock is None or isinstance(clock, MonotonicClock):
            self._world_s = host_s
        else:
            self._world_s = lambda: clock.now_ns() / NS_PER_S
        self._asked_s = self._world_s()

    def beat(self) -> float:
        """Give a sign of life; return how many seconds passed since the last."""
        self._heartbeats.beat(self._loop)
        now_s = self._world_s()
        passed_s, self._asked_s = now_s - self._asked_s, now_s
        return passed_s

    def enter(self, phase: str) -> None:
        """Hear of a cycle's phase: in those where nothing moves it may be silent for longer."""
        self._moving = phase in MOVING_PHASES
        self._heartbeats.allow(self._loop, None if self._moving else STILL_S)

    def question(self, job: Job, lens: Lens, *, moving: bool) -> Callable[[], Cancel]:
        """Return what *job* asks each time round: true once it must end. *moving*: whether the lens moves meanwhile."""
        self.beat()
        self._moving = self._moved = moving

        def interrupted() -> Cancel:
            passed_s = self.beat()
            if passed_s > PAUSE_S and self._moving and self._moved:
                lens.stop(StopMode.ABRUPT)
                job.why_cancelled = (
                    f"this process stood still for {passed_s:.1f} s while the lens moved (limit {PAUSE_S:g}); the lens "
                    "was stopped; try again, and see what keeps the machine from running it"
                )
                job.cancel(Cancel.HOLD)
            self._moved = self._moving
            return job.cancelled

        return interrupted

    @contextmanager
    def without_signs(self, seconds: float) -> Iterator[None]:
        """Let this thread be silent for so long, for something that ends by itself."""
        self._heartbeats.allow(self._loop, seconds)
        try:
            yield
        finally:
            self._heartbeats.allow(self._loop, None)
            self.beat()
