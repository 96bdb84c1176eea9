"""What is to happen on a board, and when: its clock, a queue of commands, and slots that are filled anew."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Agenda:
    """Actions at instants, in the order of their times; each gets the instant at which it happens.

    Parameters
    ----------
    begin_ns
        When the board's life begins.
    """

    def __init__(self, begin_ns: int) -> None:
        self.now_ns = begin_ns
        self._queue: deque[tuple[int, Callable[[int], None]]] = deque()
        self._slots: dict[str, tuple[int, Callable[[int], None]]] = {}

    def queue(self, at_ns: int, action: Callable[[int], None]) -> None:
        """Let *action* happen at *at_ns*, or right after the one before it in the queue."""
        self._queue.append((max(at_ns, self.queued_until_ns), action))

    @property
    def queued_until_ns(self) -> int:
        """When the last of the queue happens; the present if it is empty."""
        return self._queue[-1][0] if self._queue else self.now_ns

    def put(self, slot: str, at_ns: int | None, action: Callable[[int], None]) -> None:
        """Let *action* happen at *at_ns* instead of what was in the slot; with ``None`` nothing will."""
        self._slots.pop(slot, None)
        if at_ns is not None:
            self._slots[slot] = (at_ns, action)

    def clear(self) -> None:
        """Forget everything that was to happen."""
        self._queue.clear()
        self._slots.clear()

    def run_until(self, when_ns: int) -> None:
        """Let everything happen that is due by *when_ns*; the queue goes first where times are equal."""
        while True:
            slot = min(self._slots, key=lambda name: self._slots[name][0], default=None)
            slot_ns = when_ns + 1 if slot is None else self._slots[slot][0]
            queue_ns = self._queue[0][0] if self._queue else when_ns + 1
            due = min(slot_ns, queue_ns)
            if due > when_ns:
                break
            self.now_ns = max(due, self.now_ns)
            if queue_ns <= slot_ns or slot is None:
                _, action = self._queue.popleft()
            else:
                _, action = self._slots.pop(slot)
            action(self.now_ns)
        self.now_ns = max(when_ns, self.now_ns)
