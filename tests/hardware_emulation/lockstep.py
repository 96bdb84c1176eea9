"""A simulated rig whose words go over the emulated USB and whose bytes go over a pty, in lock step with its own time.

The world's time moves only when the camera is read; each packet that the simulated sensor then has is handed to the
emulated EVK4, and the read ends when the packet has come out at the other end: vendor library, capture process, ring.
However slow this machine is, the cycle notes the same times. The lens's line is a pty in the same way: what the driver
wrote is waited for at the far end, and what the board answers at the driver's.
"""

from __future__ import annotations

import array
import fcntl
import os
import pty
import select
import termios
import time
import tty
from collections import deque
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from elpd_drivers.lenses.serial_port import SerialPort

if TYPE_CHECKING:
    from collections.abc import Sequence

    from elpd_drivers.cameras.capture import CapturedCamera
    from elpd_drivers.sim.boards.line import Wire
    from elpd_drivers.sim.camera import SimulatedCamera
    from hardware_emulation.evk4 import Evk4

    from elpd.ports import Clock
    from elpd.records import BiasSet, CameraPacket, Geometry, Roi

PATIENCE_S = 60.0


class UsbCamera:
    """What the simulated sensor says, as it comes out of the captured camera; its settings go both ways."""

    def __init__(self, sensor: SimulatedCamera, evk4: Evk4, captured: CapturedCamera) -> None:
        self._sensor, self._evk4, self._captured = sensor, evk4, captured
        self._arrived: deque[CameraPacket] = deque()
        self.geometry: Geometry = captured.geometry
        self.min_latency_us: float = captured.min_latency_us
        self.sent_bytes = self.packets = 0
        sensor.enable_trigger(on=evk4.listening)  # the library tells the camera when it opens

    def start(self) -> None:
        self._sensor.start()
        self._captured.start()

    def read(self, timeout_s: float) -> CameraPacket | None:
        """Let the world's time pass until the sensor has a packet, and the host's until that has gone its way."""
        if self._arrived:
            return self._arrived.popleft()
        spoken = self._sensor.read(timeout_s)
        if spoken is None:
            return None
        words = spoken.data.tobytes()
        self._evk4.send(words)
        self.sent_bytes += len(words)
        self.packets += 1
        missing, until = len(words), time.monotonic() + PATIENCE_S
        while missing > 0:
            assert time.monotonic() < until, f"{missing} of {len(words)} bytes did not come within {PATIENCE_S:g} s"
            packet = self._captured.read(0.02)
            if packet is not None:
                missing -= packet.data.nbytes
                self._arrived.append(replace(packet, data=packet.data.copy(), received_ns=spoken.received_ns))
        return self._arrived.popleft()

    def stop(self) -> None:
        self._sensor.stop()
        self._captured.stop()

    def set_window(self, window: Roi | None) -> None:
        self._captured.call("set_window", None if window is None else [window.x, window.y, window.width, window.height])
        self._sensor.set_window(window)

    def apply_biases(self, biases: BiasSet) -> None:
        self._captured.call("apply_biases", biases.value)
        self._sensor.apply_biases(biases)

    def set_mask(self, pixels: Sequence[tuple[int, int]]) -> int:
        self._captured.call("set_mask", [list(pixel) for pixel in pixels])
        return self._sensor.set_mask(pixels)


class PtyPort:
    """A ``BytePort``: the driver's own serial port on one side of a pty, a simulated board's wire on the other."""

    def __init__(self, wire: Wire, clock: Clock) -> None:
        self._wire, self._clock = wire, clock
        self._board_end, self._host_end = pty.openpty()
        tty.setraw(self._host_end)
        self.port = SerialPort(os.ttyname(self._host_end), 115_200)
        self.written = self.read = 0

    def write(self, data: bytes) -> None:
        self.port.write(data)
        now, left = self._clock.now_ns(), len(data)
        while left:
            arrived = select.select([self._board_end], [], [], PATIENCE_S)[0] and os.read(self._board_end, left)
            assert arrived, f"{left} of {len(data)} bytes did not reach the board within {PATIENCE_S:g} s"
            self._wire.send(arrived, now)
            left -= len(arrived)
        self.written += len(data)

    def read_available(self) -> bytes:
        now = self._clock.now_ns()
        self._wire.advance_to(now)
        answer = self._wire.arrived(now)
        os.write(self._board_end, answer)
        until = time.monotonic() + PATIENCE_S
        while self._waiting() < len(answer):
            assert time.monotonic() < until, f"{len(answer)} bytes did not reach the host within {PATIENCE_S:g} s"
        self.read += len(answer)
        return self.port.read_available()

    def close(self) -> None:
        self.port.close()
        for end in (self._board_end, self._host_end):
            with suppress(OSError):
                os.close(end)

    def _waiting(self) -> int:
        count = array.array("i", [0])
        fcntl.ioctl(self._host_end, termios.FIONREAD, count)
        return count[0]
