"""Is a silent loop hung, or does the machine not let it run? The scheduler knows how long threads stood in line.

Without real-time priority a loop on a starved machine is silent for seconds although nothing is wrong with it. Linux
counts, for every thread, the time that it was ready to run and did not (``/proc/self/task/*/schedstat``, the second
number). A silence less what this process's threads stood in line meanwhile is the loop's own; all threads count, for
one that waits for the interpreter waits for a thread that stands in line. A loop with real-time priority stands in no
line, so for it this changes nothing.
"""

from __future__ import annotations

import os
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

TASKS = Path("/proc/self/task")
MOST_PATIENCE_S = 10.0
"""A loop that was silent for so long has hung, whatever else goes on: nobody could tell any more."""

REMEMBERED_S = 2 * MOST_PATIENCE_S


def waited_s(tasks: Path = TASKS) -> float:
    """Return how long this process's threads have stood in line for a processor; 0 where the kernel does not tell."""
    total_ns = 0
    with suppress(OSError):
        for task in os.listdir(tasks):  # noqa: PTH208  (asked ten times a second, of every thread)
            with (
                suppress(OSError, ValueError, IndexError),  # a thread that ended meanwhile
                open(f"{tasks}/{task}/schedstat", "rb", 0) as file,  # noqa: PTH123
            ):
                total_ns += int(file.read().split()[1])
    return 1e-9 * total_ns


class Overload:
    """How much of a silence the machine is answerable for.

    Parameters
    ----------
    waited
        Tells the seconds stood in line so far.
    """

    def __init__(self, waited: Callable[[], float] = waited_s) -> None:
        self._waited = waited
        self._seen: deque[tuple[float, float]] = deque()

    def look(self, now_s: float) -> None:
        """Note how things are; to be called again and again."""
        self._seen.append((now_s, self._waited()))
        while self._seen[0][0] < now_s - REMEMBERED_S:
            self._seen.popleft()

    def starved_s(self, silent_s: float) -> float:
        """Return how much of the last *silent_s* before the last look this process stood in line; not more than all."""
        if not self._seen:
            return 0.0
        now_s, waited = self._seen[-1]
        before = [line_s for at_s, line_s in self._seen if at_s <= now_s - silent_s]
        since = before[-1] if before else self._seen[0][1]
        return min(silent_s, max(0.0, waited - since))

    def hung(self, silent_s: float, limit_s: float) -> bool:
        """Say whether a silence is more than the machine explains."""
        return silent_s > MOST_PATIENCE_S + limit_s or silent_s - self.starved_s(silent_s) > limit_s
