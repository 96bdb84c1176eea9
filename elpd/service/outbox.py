"""Lines out, to a client that may not read: bounded, oldest samples dropped first, and told.

The transport below takes what the kernel takes. What does not fit waits here. A sample or a position that is dropped
costs a dot in a curve, so the oldest go when the bound is met, and the client is told how many; an answer, a result or
a fault is never dropped: a client that leaves so many of those unread is itself dropped.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

BOUND_BYTES = 1 << 20
"""What may wait for one client. One answer (a picture) may be larger: it is let in when less than this waits."""


@dataclass(slots=True)
class Outbox:
    """What waits for one client."""

    bound_bytes: int = BOUND_BYTES
    waiting_bytes: int = 0
    dropped: int = 0
    """Events that were dropped and that the client has not been told of yet."""
    _lines: deque[tuple[bytes, bool]] = field(default_factory=deque)

    def push(self, line: bytes, *, droppable: bool) -> int:
        """Let a line wait; return how many older (or this one) were dropped for it, or -1: the client must go."""
        before = self.dropped
        if self.waiting_bytes + len(line) > self.bound_bytes:
            self._drop(self.waiting_bytes + len(line) - self.bound_bytes)
            full = self.waiting_bytes + (len(line) if droppable else 0) > self.bound_bytes
            if full and not droppable:
                return -1
            if full:
                self.dropped += 1
                return self.dropped - before
        self._lines.append((line, droppable))
        self.waiting_bytes += len(line)
        return self.dropped - before

    def pop(self) -> bytes | None:
        """Take the oldest line."""
        if not self._lines:
            return None
        line, _ = self._lines.popleft()
        self.waiting_bytes -= len(line)
        return line

    def take_dropped(self) -> int:
        """Return how many were dropped since this was last asked."""
        dropped, self.dropped = self.dropped, 0
        return dropped

    def __len__(self) -> int:
        return len(self._lines)

    def _drop(self, excess_bytes: int) -> None:
        """Drop the oldest droppable lines until *excess_bytes* are freed or none is left."""
        kept: deque[tuple[bytes, bool]] = deque()
        while self._lines and excess_bytes > 0:
            line, droppable = self._lines.popleft()
            if droppable:
                excess_bytes -= len(line)
                self.waiting_bytes -= len(line)
                self.dropped += 1
            else:
                kept.append((line, droppable))
        self._lines.extendleft(reversed(kept))
