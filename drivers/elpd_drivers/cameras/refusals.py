"""Why a camera cannot be opened, in words that end in what to do.

Libraries say it in libusb's words, each in its own spelling. What they mean is one of a handful of things, and for each
there is one thing a person can do.
"""

from __future__ import annotations

UDEV_FILE = "/etc/udev/rules.d/71-elpd-camera.rules"
"""Beside the rules of a whole installation, and before those that read the tag "uaccess"."""

UDEV_RULES = {
    0x04B4: 'SUBSYSTEM=="usb", ATTRS{idVendor}=="04b4", ATTRS{idProduct}=="00f[45]", GROUP="video", TAG+="uaccess"',
    0x31F7: 'SUBSYSTEM=="usb", ATTRS{idVendor}=="31f7", ATTRS{idProduct}=="000[34]", GROUP="video", TAG+="uaccess"',
    0x1409: 'SUBSYSTEM=="usb", ATTRS{idVendor}=="1409", ATTRS{idProduct}=="8e00", GROUP="video", TAG+="uaccess"',
    0x152A: 'SUBSYSTEM=="usb", ATTRS{idVendor}=="152a", ATTRS{idProduct}=="84[01]?", GROUP="video", TAG+="uaccess"',
}
"""By vendor: Prophesee (Cypress FX3), CenturyArks, IDS, iniVation."""

_MEANINGS = (
    (
        ("access", "permission", "insufficient"),
        "no permission to open it; `elpd check` prints the udev rule that gives it, then plug it in again",
    ),
    (
        ("busy", "already open", "already used", "in use"),
        "another program holds it; close that one first, `elpd check` names it",
    ),
    (
        ("nodevice", "no such device", "disconnected", "not connected"),
        "it was unplugged (no device); plug it in again",
    ),
    (
        ("no device found", "device not found", "notfound", "not found"),
        "none found; check the cable, `elpd check` lists what is plugged in",
    ),
    (("pipe", "stall"), "its USB endpoint stalled; unplug it and plug it in again"),
    (("timeout", "timed out"), "it does not answer; unplug it and plug it in again"),
    (("overflow",), "it sent more than the USB takes; use a USB 3 port of its own"),
    (("other error",), "the USB cannot be looked at (no /dev/bus/usb here); check that this machine has a USB"),
)


def explain(said: str, library: str) -> str:
    """Turn what a library said into a sentence that ends in what to do."""
    words = said.lower()
    for signs, meaning in _MEANINGS:
        if any(sign in words for sign in signs):
            return f"camera: {meaning} ({library}: {said})"
    return f"camera: {library} failed: {said}; unplug it and plug it in again"


def udev_rule(vendor: int) -> str | None:
    """Return the line that lets people open a maker's cameras, ``None`` for a maker that is not known."""
    return UDEV_RULES.get(vendor)
