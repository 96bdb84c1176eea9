"""What is plugged in, who opens it, what is in the way; found through pyusb's own backend interface."""

from __future__ import annotations

import os
import types
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import usb.backend
import usb.core
from elpd_drivers import discovery
from elpd_drivers.cameras.refusals import UDEV_RULES, explain
from serial.tools import list_ports

from elpd.errors import DeviceError
from elpd.ports import FoundDevice

if TYPE_CHECKING:
    from collections.abc import Iterator


@dataclass
class Libusb(usb.backend.IBackend):
    """A bus of descriptors: nothing on it can be opened, so nothing may try."""

    devices: list[tuple[int, int, int]] = field(default_factory=list)
    broken: bool = False

    def enumerate_devices(self) -> Iterator[tuple[int, int, int]]:
        if self.broken:
            raise usb.core.USBError("Other error", errno=None)
        return iter(self.devices)

    def get_parent(self, device: tuple[int, int, int]) -> None:
        return None

    def get_device_descriptor(self, device: tuple[int, int, int]) -> Any:
        vendor, product, address = device
        return types.SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x300, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=9, idVendor=vendor, idProduct=product, bcdDevice=0x100, iManufacturer=1, iProduct=2,
            iSerialNumber=3, bNumConfigurations=1, address=address, bus=999, port_number=1, port_numbers=(1,), speed=4,
        )  # fmt: skip


EVK4, DAVIS, MOUSE = (0x04B4, 0x00F5, 7), (0x152A, 0x841A, 8), (0x046D, 0xC077, 9)


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Return a set of the device nodes that may be opened."""
    open_to_us: set[str] = set()
    monkeypatch.setattr(discovery.os, "access", lambda node, _: str(node) in open_to_us)
    monkeypatch.setattr(discovery, "_holder", lambda _: None)
    monkeypatch.setattr(discovery, "INSTALLED_RULES", Path("/nowhere"))
    return open_to_us


def installed(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    monkeypatch.setattr(discovery, "find_spec", lambda package: package if package in packages else None)


def test_each_camera_names_the_drivers_that_open_it(nodes: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    nodes |= {"/dev/bus/usb/999/007", "/dev/bus/usb/999/008"}
    installed(monkeypatch, "neuromorphic_drivers", "dv_processing")
    evk4, davis = discovery.usb_cameras(Libusb([EVK4, MOUSE, DAVIS]))
    assert evk4 == FoundDevice(
        "camera", "Prophesee EVK4 or EVK3 HD (04b4:00f5)", "/dev/bus/usb/999/007", drivers=("neuromorphic",)
    )
    assert (davis.name, davis.drivers) == ("iniVation DAVIS or DVXplorer (152a:841a)", ("davis", "neuromorphic"))
    assert discovery.usb_cameras(Libusb([MOUSE])) == []


def test_a_node_that_is_closed_to_us_gives_the_udev_rule(nodes: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert not nodes
    installed(monkeypatch, "neuromorphic_drivers")
    for device in (EVK4, DAVIS):
        (found,) = discovery.usb_cameras(Libusb([device]))
        assert found.next_step is not None
        assert "no permission to open /dev/bus/usb/999/" in found.next_step
        told, line = found.next_step.splitlines()
        assert told.endswith("type this, then plug it in again:")
        assert line == f"echo '{UDEV_RULES[device[0]]}' | sudo tee /etc/udev/rules.d/71-elpd-camera.rules"


def test_where_the_rules_are_installed_the_group_is_what_is_missing(
    nodes: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another rule would take the camera from the daemon's group."""
    assert not nodes
    installed(monkeypatch, "neuromorphic_drivers")
    (tmp_path / "70-elpd.rules").touch()
    monkeypatch.setattr(discovery, "INSTALLED_RULES", tmp_path / "70-elpd.rules")
    (found,) = discovery.usb_cameras(Libusb([EVK4]))
    assert found.next_step is not None
    assert "add yourself to its group" in found.next_step
    assert "udev" not in found.next_step


def test_a_camera_without_a_driver_gives_the_line_that_installs_one(
    nodes: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes |= {"/dev/bus/usb/999/007"}
    installed(monkeypatch)
    (found,) = discovery.usb_cameras(Libusb([EVK4]))
    assert found.next_step == (
        "no driver for it is installed: pip install 'elpd[neuromorphic]' or install OpenEB or the Metavision SDK"
    )


def test_all_that_is_in_the_way_is_told_at_once(nodes: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert not nodes
    installed(monkeypatch)
    (found,) = discovery.usb_cameras(Libusb([DAVIS]))
    assert found.next_step is not None
    assert "pip install 'elpd[davis]' or pip install 'elpd[neuromorphic]'" in found.next_step
    assert "no permission" in found.next_step


def test_a_camera_that_another_program_holds_names_it(nodes: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    nodes |= {"/dev/bus/usb/999/007"}
    monkeypatch.setattr(discovery, "_holder", lambda node: f"metavision_viewer (process 42) of {node}"[:32])
    (found,) = discovery.usb_cameras(Libusb([EVK4]))
    assert found.next_step == "metavision_viewer (process 42) o holds /dev/bus/usb/999/007; close it first"


def test_who_holds_a_node_is_read_from_the_open_files(tmp_path: Path) -> None:
    for pid, target in (("17", "/dev/null"), ("42", "/dev/bus/usb/002/003"), (str(os.getpid()), "/dev/ttyUSB0")):
        (tmp_path / pid / "fd").mkdir(parents=True)
        (tmp_path / pid / "fd" / "5").symlink_to(target)
        (tmp_path / pid / "comm").write_text("viewer\n")
        (tmp_path / pid / "cmdline").write_bytes(b"/usr/bin/viewer\0--full")
    (tmp_path / "99").mkdir()
    assert discovery._holder(Path("/dev/bus/usb/002/003"), tmp_path) == "viewer (process 42)"
    for words in (
        "python3 -m elpd_drivers.cameras.capture_child 5",
        "python3 /opt/bin/elpd serve",
        "python3 -m elpd serve",
    ):
        (tmp_path / "42" / "cmdline").write_bytes("\0".join(words.split()).encode())
        assert discovery._holder(Path("/dev/bus/usb/002/003"), tmp_path) is None, "elpd is in nobody's way"
    assert discovery._holder(Path("/dev/ttyUSB0"), tmp_path) is None, "our own open files are not in our way"
    assert discovery._holder(Path("/dev/ttyUSB1"), tmp_path) is None


def test_a_missing_libusb_and_a_missing_bus_are_sentences(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceError, match=r"the USB cannot be read: .*Other error; check that"):
        discovery.usb_cameras(Libusb(broken=True))

    def no_libusb(**_: object) -> object:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", no_libusb)
    with pytest.raises(DeviceError, match=r"libusb-1\.0 is not installed; install it to find USB cameras"):
        discovery.usb_cameras()


def test_hot_plug_tells_what_came_and_what_went(nodes: set[str]) -> None:
    assert not nodes
    bus = Libusb([EVK4])
    watch = discovery.HotPlug(lambda: discovery.usb_cameras(bus))
    assert watch.poll() == ([], [])
    bus.devices = [DAVIS]
    came, went = watch.poll()
    assert [device.where for device in came] == ["/dev/bus/usb/999/008"]
    assert [device.where for device in went] == ["/dev/bus/usb/999/007"]
    bus.devices = [DAVIS, EVK4]
    assert [device.where for device in watch.poll()[0]] == ["/dev/bus/usb/999/007"]


def test_serial_ports_are_looked_for_without_being_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ttyUSB0").touch()
    ports = [
        types.SimpleNamespace(device=str(tmp_path / name), name=name, description=text, hwid=hwid, vid=vid)
        for name, text, hwid, vid in (
            ("ttyUSB1", "n/a", "USB VID:PID=1FFB:00B3", 0x1FFB),
            ("ttyS0", "n/a", "n/a", None),
            ("ttyUSB0", "Arduino Uno", "USB VID:PID=2341:0043", 0x2341),
        )
    ]
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    first, second = discovery.serial_ports()
    assert first == FoundDevice("serial port", "Arduino Uno", str(tmp_path / "ttyUSB0"))
    assert (second.name, second.drivers) == ("ttyUSB1", ("tic",))
    assert second.next_step is not None
    assert "no permission" in second.next_step


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("Access denied (insufficient permissions)", "prints the udev rule"),
        ("Failed to open USB device. This usually happens due to permissions or driver issues", "udev rule"),
        ("Resource busy", "another program holds it"),
        ("the device is already used by another program", "another program holds it"),
        ("PropheseeEvk4(Usb(Rusb(NoDevice)))", "unplugged (no device)"),
        ("no device found", "none found"),
        ("PropheseeEvk4(Usb(Rusb(Pipe)))", "stalled"),
        ("Operation timed out", "does not answer"),
        ("Other error", "no /dev/bus/usb"),
        ("the moon is full", "libx failed: the moon is full"),
    ],
)
def test_what_a_library_says_becomes_what_to_do(said: str, meant: str) -> None:
    sentence = explain(said, "libx")
    assert sentence.startswith("camera: ")
    assert meant in sentence
    assert said in sentence
