"""What runs against the clock, and how the rounds go."""

from __future__ import annotations

import time
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True, slots=True)
class Contender:
    """One row: *prepare* makes what is needed (a decoder, a table) and returns what is then timed.

    *megabytes* and *events* are what one run reads.
    """

    name: str
    prepare: Callable[[], Callable[[], object]]
    megabytes: float
    events: int


@dataclass(frozen=True, slots=True)
class Missing:
    """A row that cannot run here, and why."""

    name: str
    reason: str


def race(contenders: list[Contender], rounds: int) -> dict[str, list[float]]:
    """Run everybody twice per round, the first time uncounted; return MB/s of CPU time by name.

    What is measured is a stream that goes on, so nobody starts from what the one before left: caches full of something
    else, and on an idle machine clocks that a loop without memory traffic has let fall.
    """
    speeds: dict[str, list[float]] = {one.name: [] for one in contenders}
    for _ in range(rounds):
        for one in contenders:
            one.prepare()()
            run = one.prepare()
            begun = time.process_time()
            run()
            speeds[one.name].append(one.megabytes / max(time.process_time() - begun, 1e-9))
    return speeds


def ratio(ours: list[float], theirs: list[float]) -> tuple[float, float, float]:
    """Return the median over rounds of one speed over another, and the smallest and largest."""
    each = [a / b for a, b in zip(ours, theirs, strict=True)]
    return median(each), min(each), max(each)
