"""One client's connection: what it says is looked at as it comes, what it is told waits in bounds.

The reader does three things with bytes: cut them into lines, do `stop` and `cancel` at once, and leave the rest in a
queue that the server works off, a few lines a turn, over all clients alike. So a client that floods delays nobody's
STOP, not even its own. A line that cannot be answered in time is never kept: past its bounds a client is dropped.
"""

from __future__ import annotations

import asyncio
import select
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol, cast

from elpd.service.lines import URGENT, LineCutter, RefusedLine, may_be_urgent, read_call
from elpd.service.outbox import Outbox

if TYPE_CHECKING:
    import socket

    from elpd.service.decimate import Decimator
    from elpd.service.engine_port import Caller
    from elpd.service.lines import Call, Number

READ_BYTES = 16 << 10
"""A turn of the reader takes so much at most, so that one sender cannot keep it."""

MOST_LINES_WAITING = 1024
"""A client that has sent so many requests without waiting for answers is flooding."""

MOST_SKIPPED = 16 << 20
"""Bytes of one over-long line that are skipped to find its end."""

KERNEL_BYTES = 64 << 10
"""What may wait in the transport; the rest waits in the outbox, where it can still be dropped."""

STALL_S = 5.0
"""A client that takes nothing for so long is dropped."""


class Owner(Protocol):
    """The server, as a connection sees it."""

    stops: int
    """How many STOPs and cancellations there have been."""

    def joined(self, connection: Connection) -> None:
        """Hear that a client is there."""
        ...

    def urgent(self, connection: Connection, call: Call) -> None:
        """Do a STOP or a cancellation, now."""
        ...

    def waits(self, connection: Connection) -> None:
        """Hear that lines wait, where none did."""
        ...

    def left(self, connection: Connection) -> None:
        """Hear that the client has gone."""
        ...

    def dropped(self, connection: Connection, events: int) -> None:
        """Hear that events were thrown away."""
        ...


class Connection(asyncio.BufferedProtocol):
    """A client. Made and used in the server's thread alone."""

    def __init__(self, owner: Owner) -> None:
        self._owner = owner
        self._buffer = bytearray(READ_BYTES)
        self._cutter = LineCutter()
        self._outbox = Outbox()
        self._transport: asyncio.Transport | None = None
        self._full = False
        self._written = 0
        self._taken, self._taken_s = 0, 0.0
        self._ended = False
        self.lines: deque[tuple[bytes | None, int]] = deque()
        """Requests that wait to be looked at, with how many STOPs there had been when they came; ``None`` for a line
        past the limit."""
        self.caller: Caller | None = None
        self.operates = False
        self.stop_only = False
        self.in_flight: list[Number] = []
        """Numbers of the requests that wait for their answers."""
        self.wanted: frozenset[str] = frozenset()
        self.decimator: Decimator | None = None
        self.told = 0
        """How many events this client was sent."""
        self.why_dropped = ""

    # --- what asyncio calls ---------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        self._transport = cast("asyncio.Transport", transport)
        self._transport.set_write_buffer_limits(high=KERNEL_BYTES)
        self._owner.joined(self)

    def get_buffer(self, sizehint: int) -> bytearray:
        """Lend the buffer that is read into."""
        del sizehint
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        """Look through what has come: the urgent now, the rest in its turn."""
        idle = not self.lines
        for line in self._cutter.feed(memoryview(self._buffer)[:nbytes]):
            if line is None or not may_be_urgent(line) or not self._did_at_once(line):
                self.lines.append((line, self._owner.stops))
        if len(self.lines) > MOST_LINES_WAITING:
            self.drop(f"more than {MOST_LINES_WAITING} requests wait for an answer")
        elif self._cutter.skipped > MOST_SKIPPED:
            self.drop(f"a line of more than {MOST_SKIPPED >> 20} MiB")
        elif self.lines and idle:
            self._owner.waits(self)

    def eof_received(self) -> bool:
        """Go on answering one that only ended its own sending (`socat`); leave one that has gone."""
        self._ended = True
        return not self.hung_up()

    def pause_writing(self) -> None:
        """Let further lines wait here."""
        self._full = True

    def resume_writing(self) -> None:
        """Pass on what waits."""
        self._full = False
        self._pour()

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        del exc
        self._transport = None
        self.lines.clear()
        self._owner.left(self)

    # --- what the server calls ------------------------------------------------------------------------------------

    @property
    def socket(self) -> socket.socket:
        """The connection's socket, to ask who is at its end."""
        assert self._transport is not None
        return cast("socket.socket", self._transport.get_extra_info("socket"))

    @property
    def open(self) -> bool:
        """Whether lines still reach the client."""
        return self._transport is not None and not self._transport.is_closing()

    def send(self, line: bytes, *, droppable: bool = False, seq: int = 0) -> None:
        """Send a line, or let it wait; whoever does not read loses samples first, then the connection.

        *seq* is an event's number, 0 for an answer.
        """
        if self._transport is None or self._transport.is_closing():
            return
        if not self._full and not self._outbox:
            self._write(line)
            return
        dropped = self._outbox.push(line, droppable=droppable, seq=seq)
        if dropped < 0:
            self.drop(f"more than {self._outbox.bound_bytes >> 10} KiB of answers wait to be read")
        elif dropped:
            self._owner.dropped(self, dropped)

    def check(self, now_s: float) -> None:
        """Drop a client that has taken nothing for too long or hung up; close one that is done."""
        if self._transport is None:
            return
        waiting = self._transport.get_write_buffer_size()
        taken = self._written - waiting
        if not waiting or taken != self._taken:
            self._taken, self._taken_s = taken, now_s
        elif now_s - self._taken_s >= STALL_S:
            self.drop(f"it has read nothing for {STALL_S:g} s")
        if self._ended:
            if self.hung_up():
                self._transport.abort()
            elif not (self.in_flight or self.lines or self.wanted or self._outbox or waiting):
                self._transport.close()

    def drop(self, why: str) -> None:
        """End the connection at once; what it has not read is lost to it."""
        self.why_dropped = self.why_dropped or why
        self.lines.clear()
        if self._transport is not None:
            self._transport.abort()

    def close(self) -> None:
        """End the connection once all that was said has been taken."""
        while self._transport is not None and (line := self._outbox.pop()) is not None:
            self._write(line)
        if self._transport is not None:
            self._transport.close()

    def hung_up(self) -> bool:
        """Say whether the far end is closed both ways, which the end of its sending alone does not mean."""
        if self._transport is None:
            return True
        poll = select.poll()
        with suppress(OSError, ValueError):
            poll.register(self.socket.fileno(), 0)
            return any(what & select.POLLHUP for _, what in poll.poll(0))
        return True

    def _did_at_once(self, line: bytes) -> bool:
        try:
            call = read_call(line)
        except RefusedLine:
            return False  # told in its turn
        if call.method not in URGENT:
            return False
        self._owner.urgent(self, call)
        return True

    def _pour(self) -> None:
        while not self._full and (line := self._outbox.pop()) is not None:
            self._write(line)

    def _write(self, line: bytes) -> None:
        assert self._transport is not None
        self._written += len(line)
        self._transport.write(line)
