"""The udev rules, read as udev reads them, and applied to the devices that they are for.

``Rules`` is the part of udev(7) that the file uses; a key, operator or pattern beyond that is refused, so that a typing
error cannot hide. Where udev itself is installed, it reads the file too (tests/systemd).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from elpd_drivers.discovery import CAMERAS, INIVATION

FILE = Path(__file__).parents[2] / "systemd" / "70-elpd.rules"

TOKEN = re.compile(r'(?P<key>[A-Z_]+)(?:\{(?P<name>[^}]+)\})?(?P<operator>==|!=|\+=|=)"(?P<value>[^"]*)"\Z')
MATCHES = {"ACTION", "SUBSYSTEM", "SUBSYSTEMS", "DRIVER", "ATTRS", "TEST"}
ASSIGNS = {"GOTO", "LABEL", "GROUP", "MODE", "TAG"}
BOTH = {"ENV", "ATTR"}


@dataclass
class Device:
    """A device as rules see it, and what they made of it. *vendor*, *product*: of the USB device it is or hangs on."""

    subsystem: str
    vendor: str = ""
    product: str = ""
    driver: str = ""
    action: str = "add"
    env: dict[str, str] = field(default_factory=dict)
    made: dict[str, str] = field(default_factory=dict)


class Rules:
    def __init__(self, text: str) -> None:
        self.lines = [self._parse(line) for line in text.splitlines() if line.strip() and not line.startswith("#")]
        self.labels = {
            token["value"]: at for at, line in enumerate(self.lines) for token in line if token["key"] == "LABEL"
        }

    @staticmethod
    def _parse(line: str) -> list[dict[str, str]]:
        tokens = []
        for part in line.split(", "):
            match = TOKEN.match(part.strip())
            assert match, part
            token = {key: value or "" for key, value in match.groupdict().items()}
            compares = token["operator"] in {"==", "!="}
            assert token["key"] in BOTH | (MATCHES if compares else ASSIGNS), part
            assert (token["key"] in BOTH | {"ATTRS"}) == bool(token["name"]), part
            tokens.append(token)
        return tokens

    def apply(self, device: Device) -> Device:
        at = 0
        while at < len(self.lines):
            line, at = self.lines[at], at + 1
            if all(self._holds(token, device) for token in line):
                for token in line:
                    if token["key"] == "GOTO":
                        assert self.labels[token["value"]] >= at, "udev only jumps forwards"
                        at = self.labels[token["value"]]
                    elif token["operator"] in {"=", "+="} and token["key"] != "LABEL":
                        where = device.env if token["key"] == "ENV" else device.made
                        where[token["name"] or token["key"]] = token["value"]
        return device

    @staticmethod
    def _holds(token: dict[str, str], device: Device) -> bool:
        if token["operator"] not in {"==", "!="}:
            return True
        identity = {"idVendor": device.vendor, "idProduct": device.product}
        seen = {
            "ACTION": device.action,
            "SUBSYSTEM": device.subsystem,
            "SUBSYSTEMS": "usb" if device.vendor else "",
            "DRIVER": device.driver,
            "ENV": device.env.get(token["name"], ""),
            "ATTR": identity.get(token["name"], "") if device.subsystem == "usb" else "",
            "ATTRS": identity.get(token["name"], ""),
            "TEST": token["value"] if device.subsystem == "usb" else "",
        }[token["key"]]
        found = any(fnmatchcase(seen, pattern) for pattern in token["value"].split("|"))
        return found == (token["operator"] == "==")


@pytest.fixture(scope="module")
def rules() -> Rules:
    return Rules(FILE.read_text(encoding="utf-8"))


def usb(vendor: str, product: str, **more: str) -> Device:
    return Device("usb", vendor, product, env={"DEVTYPE": "usb_device"}, **more)


KNOWN = [*CAMERAS, (INIVATION, 0x841A), (INIVATION, 0x8419), (INIVATION, 0x840D)]


@pytest.mark.parametrize(("vendor", "product"), KNOWN, ids=lambda number: f"{number:04x}")
def test_every_camera_that_can_be_found_can_be_opened_by_the_group_alone(
    rules: Rules, vendor: int, product: int
) -> None:
    made = rules.apply(usb(f"{vendor:04x}", f"{product:04x}")).made
    assert (made["GROUP"], made["MODE"], made["TAG"], made["power/control"]) == ("elpd", "0660", "uaccess", "on")


def test_other_usb_devices_are_none_of_our_business(rules: Rules) -> None:
    for vendor, product in (("046d", "c077"), ("04b4", "00f3"), ("152a", "8425"), ("1d6b", "0002")):
        device = rules.apply(usb(vendor, product))
        assert device.made == {}
        assert set(device.env) == {"DEVTYPE"}


ADAPTERS = [
    ("0403", "6001"), ("0403", "6015"), ("10c4", "ea60"), ("067b", "2303"), ("067b", "23a3"), ("1a86", "7523"),
    ("1a86", "55d4"), ("0483", "5740"), ("2341", "0043"), ("2a03", "0043"), ("2939", "495b"), ("2a3c", "0700"),
]  # fmt: skip


@pytest.mark.parametrize(("vendor", "product"), ADAPTERS)
def test_modem_manager_keeps_off_lens_controllers(rules: Rules, vendor: str, product: str) -> None:
    port = rules.apply(Device("tty", vendor, product))
    assert port.env["ID_MM_PORT_IGNORE"] == port.env["ID_MM_DEVICE_IGNORE"] == "1"
    assert "GROUP" not in port.made  # dialout, as the distribution has it
    assert rules.apply(usb(vendor, product)).env["ID_MM_DEVICE_IGNORE"] == "1"


def test_modems_and_ports_without_usb_stay_as_they_are(rules: Rules) -> None:
    for device in (Device("tty", "12d1", "1506"), Device("tty")):
        assert rules.apply(device).env == {}
        assert device.made == {}


def test_ftdi_adapters_tell_at_once_what_they_have_received(rules: Rules) -> None:
    made = rules.apply(Device("usb-serial", "0403", "6015", driver="ftdi_sio")).made
    assert made["latency_timer"] == "1"
    assert rules.apply(Device("usb-serial", "10c4", "ea60", driver="cp210x")).made == {}


def test_nothing_is_done_to_what_is_unplugged(rules: Rules) -> None:
    assert rules.apply(usb("04b4", "00f5", action="remove")).made == {}


@pytest.mark.parametrize(
    "line", ['SUBSYTEM=="usb"', 'ATTR{idVendor}="04b4" GROUP="elpd"', 'GROUP=="elpd"', "MODE=0660"]
)
def test_a_typing_error_would_be_seen(line: str) -> None:
    with pytest.raises(AssertionError):
        Rules(line)
