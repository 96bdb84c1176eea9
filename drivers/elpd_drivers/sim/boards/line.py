"""The wire between a host and a simulated board: byte times, both ways, in memory or behind a pty.

``Wire`` is the wire itself: it knows when each byte arrives and nothing of clocks. ``MemoryPort`` puts it under a
virtual clock as a ``BytePort``; ``PtyServer`` under the machine's own, so that any program can open the board. Both
carry the same faults, because a cable fails in the same ways whoever holds its end.
"""

from __future__ import annotations

import fcntl
import os
import pty
import select
import struct
import termios
import threading
import time
import tty
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from elpd.errors import LensError

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.ports import Clock
    from elpd.units import HostNs


TIOCGEXCL = 0x80045440
"""Linux: whether a terminal is marked exclusive; Python does not name it."""


class SimulatedBoard(Protocol):
    """The board's side of the wire. Times never go backwards over the two methods that take one."""

    byte_ns: int
    """How long one byte takes on the wire, ns."""

    def receive(self, data: bytes, at_ns: int) -> None:
        """Take bytes whose last one is complete at *at_ns*."""
        ...

    def advance_to(self, when_ns: int) -> None:
        """Let everything happen that happens by itself up to *when_ns*."""
        ...

    def take_output(self) -> list[tuple[int, bytes]]:
        """Return (and forget) what was handed to the wire, each with the instant at which it was."""
        ...


@dataclass(slots=True)
class WireFaults:
    """What can be wrong with a cable; change a field at any time.

    ``garble`` rewrites what the host receives (bytes in, bytes out); ``disconnect_at_ns`` pulls the plug.
    ``latency_timer_ns`` makes the adapter an FTDI: it keeps what it received until its timer runs out (16 ms unless
    somebody set it), or until ``ADAPTER_PACKET`` bytes have come.
    """

    drop_to_board: bool = False
    drop_to_host: bool = False
    garble: Callable[[bytes], bytes] | None = None
    disconnect_at_ns: int | None = None
    latency_timer_ns: int = 0


ADAPTER_PACKET = 62
"""The payload of an FTDI's full-speed packet: 64 bytes less two of modem status (FTDI AN232B-04)."""


class Wire:
    """Two queues of bytes in flight.

    Parameters
    ----------
    board
        The far end.
    latency_ns
        What an adapter adds between the host's write and the first bit on the wire.
    """

    def __init__(self, board: SimulatedBoard, *, latency_ns: int = 0) -> None:
        self.board = board
        self.faults = WireFaults()
        self._latency_ns = latency_ns
        self._to_board: deque[tuple[int, int]] = deque()
        self._to_host: deque[tuple[int, int]] = deque()
        self._out_free_ns = self._in_free_ns = 0
        self._sending = threading.Lock()
        self._kept: list[int] = []
        self._kept_until_ns = 0

    def send(self, data: bytes, at_ns: int) -> None:
        """Let the host write at *at_ns*; the bytes follow those already in flight."""
        with self._sending:  # a stop from another thread comes between two commands, never inside one
            free = max(self._out_free_ns, at_ns + self._latency_ns)
            for byte in data:
                free += self.board.byte_ns
                self._to_board.append((free, byte))
            self._out_free_ns = free

    def advance_to(self, when_ns: int) -> None:
        """Deliver what arrives at the board by *when_ns*, and let the board live until then."""
        while self._to_board and self._to_board[0][0] <= when_ns:
            at_ns, byte = self._to_board.popleft()
            if not self.faults.drop_to_board:
                self.board.receive(bytes((byte,)), at_ns)
        self.board.advance_to(when_ns)
        for ready_ns, data in self.board.take_output():
            if self.faults.drop_to_host:
                continue
            sent = self.faults.garble(data) if self.faults.garble else data
            free = max(self._in_free_ns, ready_ns)
            for byte in sent:
                free += self.board.byte_ns
                self._to_host.append((free, byte))
            self._in_free_ns = free

    def arrived(self, when_ns: int) -> bytes:
        """Return (and forget) what the host has received by *when_ns*."""
        received = bytearray()
        while self._to_host and self._to_host[0][0] <= when_ns:
            at_ns, byte = self._to_host.popleft()
            received += self._passed_on(at_ns)
            self._keep(byte, at_ns)
            if len(self._kept) >= ADAPTER_PACKET:
                received += self._passed_on(self._kept_until_ns)
        return bytes(received + self._passed_on(when_ns))

    def _keep(self, byte: int, at_ns: int) -> None:
        """Let the adapter have a byte; its timer runs on a grid of its own."""
        if not self._kept:
            timer_ns = self.faults.latency_timer_ns
            self._kept_until_ns = at_ns if timer_ns == 0 else (at_ns // timer_ns + 1) * timer_ns
        self._kept.append(byte)

    def _passed_on(self, when_ns: int) -> bytes:
        """Return (and forget) what the adapter hands to the host by *when_ns*."""
        if when_ns < self._kept_until_ns:
            return b""
        passed, self._kept = bytes(self._kept), []
        return passed

    def disconnected(self, when_ns: int) -> bool:
        """Say whether the plug is out."""
        return self.faults.disconnect_at_ns is not None and when_ns >= self.faults.disconnect_at_ns


class MemoryPort:
    """A ``BytePort`` to a simulated board, in the time of *clock*.

    ``advance_to`` makes it an actor of a simulated world: call it (with times that never go back) before asking the
    lens for positions up to that time. ``write`` and ``read_available`` advance to the present by themselves.
    """

    def __init__(self, board: SimulatedBoard, clock: Clock, *, latency_ns: int = 0) -> None:
        self.wire = Wire(board, latency_ns=latency_ns)
        self._clock = clock
        self._closed = False

    @property
    def faults(self) -> WireFaults:
        """The cable's faults."""
        return self.wire.faults

    def advance_to(self, when: HostNs) -> None:
        """Let wire and board live until *when*."""
        self.wire.advance_to(when)

    def write(self, data: bytes) -> None:
        """Send *data* now."""
        now = self._alive("write to")
        self.wire.send(data, now)

    def read_available(self) -> bytes:
        """Return what has arrived by now."""
        now = self._alive("read from")
        self.wire.advance_to(now)
        return self.wire.arrived(now)

    def close(self) -> None:
        """Give the line back. Idempotent."""
        self._closed = True

    def _alive(self, doing: str) -> int:
        now = self._clock.now_ns()
        if self._closed:
            raise LensError(f"lens port: cannot {doing} a closed port; open it again")
        if self.wire.disconnected(now):
            raise LensError(f"lens port: cannot {doing} it, the device is gone (EIO); check the cable, then home again")
        return now


class PtyServer:
    """A board behind a pty, in real time, served by a thread until closed.

    Parameters
    ----------
    board
        The far end, whose time is ``CLOCK_MONOTONIC``.
    """

    _TICK_S = 0.002
    _LOOK_S = 0.1

    def __init__(self, board: SimulatedBoard) -> None:
        self.wire = Wire(board)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._wake_read, self._wake_write = os.pipe()
        self._name = os.ttyname(self._slave)
        self._thread = threading.Thread(target=self._serve, name="simulated-board", daemon=True)
        self._thread.start()

    @property
    def port(self) -> str:
        """The path that any program can open as a serial port."""
        return self._name

    def close(self) -> None:
        """Stop serving and remove the pty. Idempotent."""
        if self._thread.is_alive():
            os.write(self._wake_write, b"x")
            self._thread.join()
        for descriptor in (self._master, self._slave, self._wake_read, self._wake_write):
            with suppress(OSError):
                os.close(descriptor)
        self._master = self._slave = self._wake_read = self._wake_write = -1

    def _serve(self) -> None:
        looked_ns = time.monotonic_ns()
        while True:
            readable, _, _ = select.select([self._master, self._wake_read], [], [], self._TICK_S)
            if self._wake_read in readable:
                return
            now = time.monotonic_ns()
            if now - looked_ns > self._LOOK_S * 1e9:
                looked_ns = now
                self._free_from_the_dead()
            if self._master in readable:
                with suppress(BlockingIOError):
                    self.wire.send(os.read(self._master, 4096), now)
            self.wire.advance_to(now)
            answer = self.wire.arrived(now)
            while answer:
                try:
                    answer = answer[os.write(self._master, answer) :]
                except BlockingIOError:
                    break  # nobody reads: a UART drops it too

    def _free_from_the_dead(self) -> None:
        """Clear the mark of exclusive use that a killed program left; on a real port the last close does that.

        Here we have it open too. Who lives and holds the port exclusively also holds its lock (``serial_port``), so the
        lock says whether the mark is meant.
        """
        marked = struct.unpack("i", fcntl.ioctl(self._slave, TIOCGEXCL, bytes(4)))[0]
        if not marked:
            return
        try:
            fcntl.flock(self._slave, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return
        fcntl.ioctl(self._slave, termios.TIOCNXCL)
        fcntl.flock(self._slave, fcntl.LOCK_UN)
