"""A simulated board behind a real pty, in virtual time: the kernel's terminal carries bytes, a test's clock the time.

What passes through a terminal is handed on by a thread of the kernel, whenever the scheduler lets it. Nothing here
depends on that: before time passes, all that the driver has written is waited for (behind it comes a mark, which is
waited for and taken out), and so is the arrival of all that the board has said. Time stands still meanwhile. So a busy
machine makes these tests slow, and changes nothing else.
"""

from __future__ import annotations

import array
import fcntl
import os
import select
import termios
import tty
from typing import TYPE_CHECKING

from elpd_drivers.lenses.serial_port import SerialPort
from elpd_drivers.sim.boards.line import Wire

if TYPE_CHECKING:
    from elpd_drivers.sim.boards.line import SimulatedBoard, WireFaults

    from elpd.ports import Clock
    from elpd.units import HostNs

MARK = bytes.fromhex("00f1d2c3b4a5968778695a4b3c2d1e0f")
KERNEL_S = 60.0
"""The kernel's thread has been starved, or the terminal is full, if bytes take so long to pass."""


class PtyPort:
    """A ``BytePort`` to a simulated board through a pty; the driver's side is the one for real serial ports.

    It has what ``MemoryPort`` has: ``advance_to`` makes it an actor of a virtual world.
    """

    def __init__(self, board: SimulatedBoard, clock: Clock) -> None:
        self.wire = Wire(board)
        self._now = clock.now_ns()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._unplugged = False
        self._serial = SerialPort(self.path, 115_200)

    def __del__(self) -> None:
        """Give the terminal back."""
        if not self._unplugged:
            self.unplug()

    @property
    def faults(self) -> WireFaults:
        """The cable's faults."""
        return self.wire.faults

    def write(self, data: bytes) -> None:
        """Send *data*, which leaves at the present instant."""
        self._serial.write(data)

    def read_available(self) -> bytes:
        """Return what has arrived."""
        return self._serial.read_available()

    def close(self) -> None:
        """Give the driver's side back. Idempotent."""
        self._serial.close()

    def advance_to(self, when: HostNs) -> None:
        """Take what was written at the last instant, let wire and board live until *when*, and hand on their answer."""
        if self._unplugged:
            self.wire.advance_to(when)
            return
        written = self._written()
        if written:
            self.wire.send(written, self._now)
        self._now = when
        self.wire.advance_to(when)
        if self.wire.disconnected(when):
            self.unplug()
            return
        answer = self.wire.arrived(when)
        if answer:
            self._hand_on(answer)

    def unplug(self) -> None:
        """Pull the cable: both ends of the terminal that the board holds are closed."""
        self._unplugged = True
        os.close(self._master)
        os.close(self._slave)

    def _written(self) -> bytes:
        """Return all that was written into the terminal up to here."""
        os.write(self._slave, MARK)
        data = b""
        while MARK not in data:
            assert select.select([self._master], [], [], KERNEL_S)[0], "the kernel passes nothing on"
            data += os.read(self._master, 65536)
        return data.replace(MARK, b"")

    def _hand_on(self, answer: bytes) -> None:
        """Put *answer* into the terminal and wait until the driver's side could read all of it."""
        goal = self._readable() + len(answer)
        os.write(self._master, answer)
        watched = select.epoll()  # edges: each time that more has come
        with watched:
            watched.register(self._slave, select.EPOLLIN | select.EPOLLET)
            while self._readable() < goal:
                assert watched.poll(KERNEL_S), "the kernel passes nothing on"

    def _readable(self) -> int:
        count = array.array("i", [0])
        fcntl.ioctl(self._slave, termios.FIONREAD, count)
        return count[0]
