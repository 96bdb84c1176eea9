"""A camera that is emulated on the USB, plugged in and open, with the patience that a busy machine needs."""

from __future__ import annotations

import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import pytest
from elpd_drivers.cameras import neuromorphic
from hardware_emulation import usbfs

from elpd.timebase import MonotonicClock

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from elpd_drivers.cameras.capture import CapturedCamera

    from elpd.records import CameraPacket

PATIENCE_S = 120.0
PATIENT = {
    "max_delay_ms": 0,
    "open_timeout_s": PATIENCE_S,
    "hang_ms": 1e3 * PATIENCE_S,
}
"""Settings with which nothing depends on how fast the machine is."""

marks = [
    pytest.mark.xdist_group("usb"),
    pytest.mark.skipif(usbfs.missing() is not None, reason=str(usbfs.missing())),
]


class Plugged:
    """A device on a bus, and the camera that has been opened over it."""

    def __init__(self, bus: usbfs.Bus, device: usbfs.Device, settings: dict[str, Any]) -> None:
        self.bus = bus
        bus.plug(device)
        self.camera: CapturedCamera = neuromorphic.open_camera(settings, MonotonicClock())

    def read_until(self, over: Callable[[CameraPacket], bool], what: str) -> Iterator[CameraPacket]:
        """Yield what is delivered, up to the packet with which it is *over*; *what* is said if none comes."""
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            packet = self.camera.read(0.02)
            if packet is not None:
                yield packet
                if over(packet):
                    return
        raise AssertionError(f"{what} did not come within {PATIENCE_S:g} s")

    def wait_for(self, condition: Callable[[], bool]) -> None:
        """Read on until *condition* holds."""
        until = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < until, f"not within {PATIENCE_S:g} s"
            self.camera.read(0.005)

    def reopen(self) -> None:
        """Ask for the camera until it is there again, and start it."""
        until = time.monotonic() + PATIENCE_S
        while not self.camera.reopen():
            assert time.monotonic() < until, f"not opened again within {PATIENCE_S:g} s"
            time.sleep(0.01)  # the EVK4's driver sleeps through 2.5 s of opening
        self.camera.start()


Rig = TypeVar("Rig", bound=Plugged)


@contextmanager
def on_a_bus(make: Callable[[usbfs.Bus], Rig]) -> Iterator[Rig]:
    """Show this process a bus of its own, and close the camera afterwards."""
    with usbfs.Bus() as bus, pytest.MonkeyPatch.context() as patch:
        for name, value in bus.environment.items():
            patch.setenv(name, value)
        made = make(bus)
        yield made
        made.camera.close()
