"""What is plugged in, which driver opens it, and what stands in the way; without opening any of it.

Looking must never disturb: a serial port that is opened resets many controllers, a camera that is opened belongs to us.
So serial ports come from the kernel's own list, cameras from the USB descriptors, whether we might open them from
the permissions of their device nodes, and who holds them from the kernel's list of open files.
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import usb.core
from serial.tools import list_ports

from elpd.errors import DeviceError
from elpd.ports import FoundDevice
from elpd_drivers.cameras.process import CHILD
from elpd_drivers.cameras.refusals import UDEV_FILE, udev_rule

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence


class Backend(NamedTuple):
    """A driver of ours, the package that it needs, and how to install that."""

    driver: str
    package: str
    install: str


NEUROMORPHIC = Backend("neuromorphic", "neuromorphic_drivers", "pip install 'elpd[neuromorphic]'")
DAVIS = Backend("davis", "dv_processing", "pip install 'elpd[davis]'")
METAVISION = Backend("metavision", "metavision_hal", "install OpenEB or the Metavision SDK")

PROPHESEE = (NEUROMORPHIC, METAVISION)
CAMERAS = {
    (0x04B4, 0x00F4): ("Prophesee EVK3", PROPHESEE),
    (0x04B4, 0x00F5): ("Prophesee EVK4 or EVK3 HD", PROPHESEE),
    (0x31F7, 0x0003): ("CenturyArks SilkyEvCam", PROPHESEE),
    (0x31F7, 0x0004): ("CenturyArks SilkyEvCam", PROPHESEE),
    (0x1409, 0x8E00): ("IDS uEye XCP-E", PROPHESEE),
}
"""Vendor and product numbers of the makers' udev rules. Cypress' 04b4 is shared with other FX3 devices."""

INSTALLED_RULES = Path("/etc/udev/rules.d/70-elpd.rules")
"""Where ``tools/install`` puts the rules of a whole installation."""

INIVATION = 0x152A
_INIVATION_PRODUCTS = range(0x8400, 0x8420)
_INIVATION = ("iniVation DAVIS or DVXplorer", (DAVIS, NEUROMORPHIC))

LENS_DRIVERS = {0x1FFB: ("tic",), 0x2A3C: ("tmcl",)}
"""Makers of controllers whose USB number is their own: Pololu, Trinamic. Others use numbers that many share."""


def serial_ports() -> Sequence[FoundDevice]:
    """List the serial ports that have hardware behind them."""
    return [
        FoundDevice(
            kind="serial port",
            name=port.description if port.description not in {"n/a", None} else port.name,
            where=port.device,
            next_step=_in_the_way(
                Path(port.device), "add yourself to its group (`ls -l` shows it, often dialout), log in anew"
            ),
            drivers=LENS_DRIVERS.get(port.vid or 0, ()),
        )
        for port in sorted(list_ports.comports(), key=lambda port: str(port.device))
        if port.hwid != "n/a"
    ]


def usb_cameras(libusb: Any = None) -> Sequence[FoundDevice]:
    """List the event cameras on the USB, through pyusb's default backend or the one that is given.

    Raises
    ------
    DeviceError
        If libusb is missing or the bus cannot be read.

    """
    try:
        devices = list(usb.core.find(find_all=True, backend=libusb) or ())
    except usb.core.NoBackendError:
        raise DeviceError(
            "libusb-1.0 is not installed; install it to find USB cameras (Debian: libusb-1.0-0)"
        ) from None
    except usb.core.USBError as error:
        raise DeviceError(f"the USB cannot be read: {error}; check that this machine has a USB") from None
    return [_camera(device) for device in devices if _known(device) is not None]


class HotPlug:
    """Tells what came and what went, by looking: pyusb has no news of its own, and looking costs a millisecond.

    Parameters
    ----------
    look
        ``usb_cameras``, ``serial_ports`` or the like.
    """

    def __init__(self, look: Callable[[], Iterable[FoundDevice]]) -> None:
        self._look = look
        self._there = {device.where: device for device in look()}

    def poll(self) -> tuple[list[FoundDevice], list[FoundDevice]]:
        """Return what was plugged in and what was unplugged since the last look. Raises what looking raises."""
        now = {device.where: device for device in self._look()}
        before, self._there = self._there, now
        came = [device for where, device in now.items() if where not in before]
        went = [device for where, device in before.items() if where not in now]
        return came, went


def _camera(device: Any) -> FoundDevice:
    known = _known(device)
    assert known is not None, "only known cameras are listed"
    name, backends = known
    node = Path(f"/dev/bus/usb/{device.bus or 0:03d}/{device.address or 0:03d}")
    installed = [backend.driver for backend in backends if find_spec(backend.package) is not None]
    steps = []
    if not installed:
        steps.append(f"no driver for it is installed: {' or '.join(backend.install for backend in backends)}")
    in_the_way = _in_the_way(node, _permission(device.idVendor))
    if in_the_way is not None:
        steps.append(in_the_way)
    return FoundDevice(
        kind="camera",
        name=f"{name} ({device.idVendor:04x}:{device.idProduct:04x})",
        where=str(node),
        next_step="\n".join(steps) or None,
        drivers=tuple(installed),
    )


def _permission(vendor: int) -> str:
    """Say how a person gets to open a maker's cameras; what is to be typed stands on a line of its own."""
    if INSTALLED_RULES.exists():
        return "add yourself to its group (`ls -l` shows it, usually elpd), log in anew, or ask the daemon"
    return f"type this, then plug it in again:\necho '{udev_rule(vendor)}' | sudo tee {UDEV_FILE}"


def _known(device: Any) -> tuple[str, tuple[Backend, ...]] | None:
    if device.idVendor == INIVATION and device.idProduct in _INIVATION_PRODUCTS:
        return _INIVATION
    return CAMERAS.get((device.idVendor, device.idProduct))


def _in_the_way(node: Path, remedy: str) -> str | None:
    """Say why *node* cannot be opened now and what to do, ``None`` if nothing is in the way."""
    if not os.access(node, os.R_OK | os.W_OK):
        return f"no permission to open {node}: {remedy}"
    holder = _holder(node)
    return None if holder is None else f"{holder} holds {node}; close it first"


def _holder(node: Path, processes: Path = Path("/proc")) -> str | None:
    """Name a process of others that has *node* open, as far as this user may know; elpd itself is in nobody's way."""
    for process in processes.glob("[0-9]*"):
        if process.name == str(os.getpid()):
            continue
        try:
            if any(link.readlink() == node for link in (process / "fd").iterdir()):
                if _is_ours((process / "cmdline").read_bytes()):
                    continue
                name = (process / "comm").read_text(encoding="utf-8", errors="replace").strip()
                return f"{name} (process {process.name})"
        except OSError:
            continue  # it has ended, or it is somebody else's
    return None


def _is_ours(command: bytes) -> bool:
    """Say whether a command line is elpd's, or that of the process that reads a camera for it."""
    words = command.decode(errors="replace").split("\0")
    return CHILD in words or any(Path(word).name == "elpd" for word in words[:2]) or words[1:3] == ["-m", "elpd"]
