"""What discovery sees of a camera that is emulated on the USB, through the machine's own libusb."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import usb.backend.libusb1
from elpd_drivers.cameras.refusals import udev_rule
from hardware_emulation import usbfs
from hardware_emulation.davis346 import Davis346
from hardware_emulation.evk4 import VENDOR, Evk4

pytestmark = [
    pytest.mark.skipif(usbfs.missing() is not None, reason=str(usbfs.missing())),
    pytest.mark.skipif(usb.backend.libusb1.get_backend() is None, reason="libusb-1.0 is not installed"),
]

LOOK = """
import dataclasses, json
from elpd_drivers.discovery import usb_cameras
print(json.dumps([dataclasses.asdict(camera) for camera in usb_cameras()]))
"""


def look(bus: usbfs.Bus) -> list[dict[str, object]]:
    environment = {**os.environ, **bus.environment, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    told = subprocess.run([sys.executable, "-c", LOOK], env=environment, capture_output=True, text=True, check=True)
    found: list[dict[str, object]] = json.loads(told.stdout)
    return found


@pytest.mark.parametrize(
    ("plugged", "name"),
    [
        (Evk4(), "Prophesee EVK4 or EVK3 HD (04b4:00f5)"),
        (Davis346(), "iniVation DAVIS or DVXplorer (152a:841a)"),
    ],
)
def test_a_camera_is_seen_when_it_is_plugged_in_and_only_then(plugged: Evk4 | Davis346, name: str) -> None:
    with usbfs.Bus() as bus:
        assert look(bus) == []
        bus.plug(plugged)
        (camera,) = look(bus)
        assert (camera["name"], camera["where"]) == (name, "/dev/bus/usb/002/002")
        assert not plugged.registers, "looking opens nothing"
        bus.unplug()
        assert look(bus) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
def test_a_camera_that_may_not_be_opened_comes_with_the_rule_that_lets_it() -> None:
    with usbfs.Bus() as bus:
        bus.plug(Evk4(), mode=0o000)
        (camera,) = look(bus)
        assert udev_rule(VENDOR) in str(camera["next_step"])
