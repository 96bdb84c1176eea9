"""What is plugged in, without opening any of it.

Looking must never disturb: a serial port that is opened resets many controllers, a camera that is opened belongs to us.
So serial ports come from the kernel's own list, cameras from the USB descriptors, and whether we might open them from
the permissions of their device nodes.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import usb.core
from serial.tools import list_ports

from elpd.errors import DeviceError
from elpd.ports import FoundDevice

if TYPE_CHECKING:
    from collections.abc import Sequence

CAMERAS = {
    (0x04B4, 0x00F4): "Prophesee EVK3",
    (0x04B4, 0x00F5): "Prophesee EVK4 or EVK3 HD",
    (0x31F7, 0x0003): "CenturyArks SilkyEvCam",
    (0x31F7, 0x0004): "CenturyArks SilkyEvCam",
    (0x1409, 0x8E00): "IDS uEye XCP-E",
}
"""Vendor and product numbers of the makers' udev rules. Cypress' 04b4 is shared with other FX3 devices."""

INIVATION = 0x152A
_INIVATION_PRODUCTS = range(0x8400, 0x8420)


def serial_ports() -> Sequence[FoundDevice]:
    """List the serial ports that have hardware behind them."""
    return [
        FoundDevice(
            kind="serial port",
            name=port.description if port.description not in {"n/a", None} else port.name,
            where=port.device,
            next_step=_access(
                Path(port.device), "add yourself to its group (`ls -l` shows it, often dialout), log in anew"
            ),
        )
        for port in sorted(list_ports.comports(), key=lambda port: str(port.device))
        if port.hwid != "n/a"
    ]


def usb_cameras() -> Sequence[FoundDevice]:
    """List the event cameras on the USB.

    Raises
    ------
    DeviceError
        If libusb is missing or the bus cannot be read.

    """
    try:
        devices = list(usb.core.find(find_all=True) or ())
    except usb.core.NoBackendError:
        raise DeviceError(
            "libusb-1.0 is not installed; install it to find USB cameras (Debian: libusb-1.0-0)"
        ) from None
    except usb.core.USBError as error:
        raise DeviceError(f"the USB cannot be read: {error}") from None
    return [_camera(device) for device in devices if _model(device) is not None]


def _camera(device: Any) -> FoundDevice:
    node = Path(f"/dev/bus/usb/{device.bus or 0:03d}/{device.address or 0:03d}")
    rule = f'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{device.idVendor:04x}", GROUP="video", TAG+="uaccess"'
    return FoundDevice(
        kind="camera",
        name=f"{_model(device)} ({device.idVendor:04x}:{device.idProduct:04x})",
        where=str(node),
        next_step=_access(node, f"put this line into /etc/udev/rules.d/70-elpd.rules and plug it in again: {rule}"),
    )


def _model(device: Any) -> str | None:
    if device.idVendor == INIVATION and device.idProduct in _INIVATION_PRODUCTS:
        return "iniVation DAVIS or DVXplorer"
    return CAMERAS.get((device.idVendor, device.idProduct))


def _access(node: Path, remedy: str) -> str | None:
    return None if os.access(node, os.R_OK | os.W_OK) else f"no permission to open {node}: {remedy}"
