"""Lines out, to a client that may not read: bounded, oldest samples dropped first, and told.

The transport below takes what the kernel takes. What does not fit waits here. A sample or a position that is dropped
costs a dot in a curve, so the oldest go when the bound is met, and where the first of them was the client is told how
many; an answer, a result or a fault is never dropped: a client that leaves so many of those unread is itself dropped.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

BOUND_BYTES = 1 << 20
"""What may wait for one client. One answer (a picture) may be larger: it is let in when less than this waits."""


@dataclass(slots=True)
class Waiting:
    """A line, or (*line* empty) so many that were dropped. *seq* is an event's number, 0 for an answer."""

    line: bytes
    droppable: bool
    seq: int
    dropped: int = 0

    def told(self) -> bytes:
        """Return what goes to the client."""
        return self.line or b'{"event":"dropped","seq":%d,"count":%d}\n' % (self.seq, self.dropped)


@dataclass(slots=True)
class Outbox:
    """What waits for one client."""

    bound_bytes: int = BOUND_BYTES
    waiting_bytes: int = 0
    _lines: deque[Waiting] = field(default_factory=deque)
    _gap: Waiting | None = None
    """What tells of the lines that were dropped, if any were since it was last told."""

    def push(self, line: bytes, *, droppable: bool, seq: int = 0) -> int:
        """Let a line wait; return how many older (or this one) were dropped for it, or -1: the client must go."""
        excess_bytes = self.waiting_bytes + len(line) - self.bound_bytes
        dropped = self._drop(excess_bytes) if excess_bytes > 0 else 0
        new = Waiting(line, droppable, seq)
        if droppable and self.waiting_bytes + len(line) > self.bound_bytes:
            self._lines.append(new)
            self.waiting_bytes += len(line)
            self._leave_out(len(self._lines) - 1)
            return dropped + 1
        if self.waiting_bytes > self.bound_bytes:
            return -1
        self._lines.append(new)
        self.waiting_bytes += len(line)
        return dropped

    def pop(self) -> bytes | None:
        """Take the oldest line."""
        if not self._lines:
            return None
        oldest = self._lines.popleft()
        if oldest is self._gap:
            self._gap = None
        self.waiting_bytes -= len(oldest.line)
        return oldest.told()

    def __len__(self) -> int:
        return len(self._lines)

    def _drop(self, excess_bytes: int) -> int:
        """Drop the oldest droppable lines until *excess_bytes* are freed or none is left; return how many."""
        dropped = index = 0
        while index < len(self._lines) and excess_bytes > 0:
            if self._lines[index].droppable:
                excess_bytes -= len(self._lines[index].line)
                dropped += 1
                index += self._leave_out(index)
            else:
                index += 1
        return dropped

    def _leave_out(self, index: int) -> int:
        """Put the gap where a line was, or count the line to the gap that there is; return how many stand there now."""
        line = self._lines[index]
        self.waiting_bytes -= len(line.line)
        if self._gap is not None:
            self._gap.dropped += 1
            del self._lines[index]
            return 0
        self._gap = self._lines[index] = Waiting(b"", droppable=False, seq=line.seq, dropped=1)
        return 1
