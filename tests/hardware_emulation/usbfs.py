"""A USB device in user space, as the kernel's usbfs would show it to libusb.

``libumockdev-preload`` (Debian's umockdev) redirects a program's /sys and /dev into a folder and its ioctls on a device
node to a socket beside it. The other end of that socket is served here: URBs are queued in the order in which they were
submitted, per endpoint, and completed in that order, with their data written into the program's own buffer when it
reaps them, as the kernel does. The protocol is the preload library's: three machine words a message.
"""

from __future__ import annotations

import ctypes.util
import errno
import shutil
import socket
import struct
import tempfile
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self

if TYPE_CHECKING:
    from types import TracebackType

PRELOAD = "libumockdev-preload.so.0"
_WORDS = struct.Struct("=3Q")
_IOCTL, _DONE, _READ_MEMORY, _WRITE_MEMORY = 1, 3, 5, 6
_SUBMIT, _DISCARD, _REAP, _REAP_NO_DELAY, _CAPABILITIES = 10, 11, 12, 13, 26
_CLAIM = 15
_ACCEPTED = {3, 4, 5, 15, 16, 20, 21, 22, 23, 27}  # claim, release, reset, clear halt and the like
_URB = struct.Struct("=BBxxiIxxxxQiiiiiIQ")
_STATUS_AT, _ACTUAL_AT = 4, 28
_CONTROL_URB = 2
_CONTROL_IN, _CONTROL_OUT = -1, -2  # endpoint 0, by direction
_NO_PACKET_SIZE_LIMIT, _REAP_AFTER_DISCONNECT = 0x04, 0x10
HELD_S, BUSY_HELD_S, BUSY_S = 0.002, 0.0001, 0.05
"""A regular file is always ready, so libusb asks without pause, and while a question is held none of its threads can
ask another: it is held long where nothing has happened for a while, shortly where something has."""


QUEUED_S = 0.02
"""A host queues many requests on a streaming endpoint, one after the other, in less time than a sensor takes to begin.
Here each takes a hundred times longer, so a stream begins once so long has passed without another."""


class Device(Protocol):
    """What is plugged in. On ``streaming_endpoints`` the host keeps many requests queued."""

    streaming_endpoints: frozenset[int]
    descriptors: bytes
    attributes: dict[str, str]
    vendor: int
    product: int

    def control(self, setup: bytes, data: bytes) -> bytes | None:
        """Answer a control transfer; ``None`` stalls."""
        ...

    def written(self, endpoint: int, data: bytes) -> None:
        """Take what the host wrote."""
        ...

    def next_packet(self, endpoint: int, length: int) -> bytes | None:
        """Return what to send now, ``None`` for nothing yet; ``BrokenPipeError`` stalls the endpoint."""
        ...


@dataclass
class _Urb:
    address: int
    kind: int
    endpoint: int
    buffer: int
    length: int
    setup: bytes = b""

    @property
    def written(self) -> int:
        """How many bytes the host sends with it."""
        return self.length - (len(self.setup) if self.endpoint == _CONTROL_OUT else 0)


class Bus:
    """One USB port and the environment in which a program sees it; the device can come and go."""

    def __init__(self) -> None:
        self.root = Path(tempfile.mkdtemp(prefix="elpd-usb-"))
        for folder in ("dev/bus/usb/002", "sys/bus/usb/devices", "sys/class", "ioctl/dev/bus/usb/002"):
            (self.root / folder).mkdir(parents=True)
        self.environment = {"UMOCKDEV_DIR": str(self.root), "LD_PRELOAD": PRELOAD}
        self._number = 1
        self._port: _Port | None = None
        self.claimed = threading.Event()
        """While set, another program has claimed the device's interface."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._port is not None:
            self.unplug()
        shutil.rmtree(self.root)

    def plug(self, device: Device, mode: int = 0o660) -> None:
        """Plug *device* in, under a new device number as the kernel gives."""
        self._number += 1
        name = f"bus/usb/002/{self._number:03d}"
        self._port = _Port(device, self.root / "ioctl/dev" / name, self.claimed)
        node = self.root / "dev" / name
        node.write_bytes(device.descriptors)
        node.chmod(mode)
        place = self.root / "sys/devices/pci0000:00/0000:00:14.0/usb2/2-1"
        place.mkdir(parents=True)
        (place / "descriptors").write_bytes(device.descriptors)
        (place / "uevent").write_text(
            f"DEVNAME={name}\nDEVTYPE=usb_device\nDRIVER=usb\nMAJOR=189\nMINOR={127 + self._number}\nBUSNUM=002\n"
            f"DEVNUM={self._number:03d}\nPRODUCT={device.vendor:x}/{device.product:x}/100\n"
        )
        attributes = {
            "busnum": "2",
            "devnum": str(self._number),
            "speed": "5000",
            "bConfigurationValue": "1",
            "idVendor": f"{device.vendor:04x}",
            "idProduct": f"{device.product:04x}",
            **device.attributes,
        }
        for key, value in attributes.items():
            (place / key).write_text(value + "\n")
        (place / "subsystem").symlink_to("../../../../../bus/usb")
        (self.root / "sys/bus/usb/devices/2-1").symlink_to("../../../devices/pci0000:00/0000:00:14.0/usb2/2-1")

    def unplug(self) -> None:
        """Pull the plug: what is under way fails as the kernel lets it fail, nothing new begins."""
        assert self._port is not None, "nothing is plugged in"
        self._port.unplug()
        self._port = None
        name = f"bus/usb/002/{self._number:03d}"
        (self.root / "sys/bus/usb/devices/2-1").unlink()
        shutil.rmtree(self.root / "sys/devices")
        (self.root / "dev" / name).unlink()
        (self.root / "ioctl/dev" / name).unlink()


class _Port:
    """The socket behind one device node."""

    def __init__(self, device: Device, path: Path, claimed: threading.Event) -> None:
        self._device, self.claimed = device, claimed
        self.gone = False
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen()
        threading.Thread(target=self._accept, daemon=True).start()

    def unplug(self) -> None:
        self.gone = True
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                opened = _OpenDevice(self, self._device, connection)
                threading.Thread(target=opened.serve, daemon=True).start()


class _OpenDevice:
    """One program's open device node: its URBs, in order."""

    def __init__(self, port: _Port, device: Device, connection: socket.socket) -> None:
        self._port, self._device, self._line = port, device, connection
        self._pending: dict[int, deque[_Urb]] = {}
        self._discarded: deque[_Urb] = deque()
        self._active = 0.0
        self._flowing: set[int] = set()

    def serve(self) -> None:
        with self._line, suppress(ConnectionError):
            while (message := self._receive(_WORDS.size)) is not None:
                command, request, argument = _WORDS.unpack(message)
                assert command == _IOCTL, f"the preload library sent {command}"
                result = self._answer(request & 0xFF, argument)
                self._line.sendall(_WORDS.pack(_DONE, *((0, 0) if result == 0 else (2**64 - 1, result))))

    def _answer(self, number: int, argument: int) -> int:
        """Serve one ioctl; return 0 or an errno."""
        if number in {_REAP, _REAP_NO_DELAY}:
            return self._reap(argument)
        if number == _DISCARD:
            return self._discard(argument)
        if self._port.gone:
            return errno.ENODEV
        if number == _SUBMIT:
            return self._submit(argument)
        if number == _CLAIM and self._port.claimed.is_set():
            return errno.EBUSY
        if number == _CAPABILITIES:
            self._write(argument, struct.pack("=I", _NO_PACKET_SIZE_LIMIT | _REAP_AFTER_DISCONNECT))
            return 0
        return 0 if number in _ACCEPTED else errno.ENOTTY

    def _submit(self, address: int) -> int:
        self._active = time.monotonic()
        kind, endpoint, _, _, buffer, length, *_ = _URB.unpack(self._read(address, _URB.size))
        urb = _Urb(address, kind, endpoint, buffer, length)
        if kind == _CONTROL_URB:
            content = self._read(buffer, length)
            urb.setup, data = content[:8], content[8:]
            urb.endpoint = _CONTROL_IN if urb.setup[0] & 0x80 else _CONTROL_OUT
            if urb.endpoint == _CONTROL_OUT:
                self._device.control(urb.setup, data)
        elif not endpoint & 0x80:
            self._device.written(endpoint, self._read(buffer, length))
        waiting = self._pending.setdefault(urb.endpoint, deque())
        if not waiting:
            self._flowing.discard(urb.endpoint)
        waiting.append(urb)
        return 0

    def _discard(self, address: int) -> int:
        for waiting in self._pending.values():
            for urb in waiting:
                if urb.address == address:
                    waiting.remove(urb)
                    self._discarded.append(urb)
                    return 0
        return errno.EINVAL

    def _reap(self, argument: int) -> int:
        now = time.monotonic()
        held_s = BUSY_HELD_S if now - self._active < BUSY_S else HELD_S
        until = now + held_s
        while True:
            done = self._completed()
            if done is not None:
                urb, status, data = done
                if data:
                    self._write(urb.buffer + (8 if urb.kind == _CONTROL_URB else 0), data)
                actual = len(data) if urb.endpoint & 0x80 and urb.endpoint != _CONTROL_OUT else urb.written
                self._write(urb.address + _STATUS_AT, struct.pack("=i", status))
                self._write(urb.address + _ACTUAL_AT, struct.pack("=i", actual))
                self._write(argument, struct.pack("=Q", urb.address))
                return 0
            if self._port.gone:
                return errno.ENODEV
            if time.monotonic() > until:
                return errno.EAGAIN
            time.sleep(held_s / 4)

    def _completed(self) -> tuple[_Urb, int, bytes] | None:
        """Return the next URB that is done, its status and its data; the first of its endpoint, always."""
        if self._discarded:
            return self._discarded.popleft(), -errno.ENOENT, b""
        for endpoint, waiting in self._pending.items():
            if not waiting:
                continue
            urb = waiting[0]
            if self._port.gone:
                return waiting.popleft(), -errno.ESHUTDOWN, b""
            if endpoint == _CONTROL_IN:
                data = self._device.control(urb.setup, b"")
                return waiting.popleft(), 0 if data is not None else -errno.EPIPE, (data or b"")[: urb.length - 8]
            if endpoint == _CONTROL_OUT or not endpoint & 0x80:
                return waiting.popleft(), 0, b""
            if endpoint in self._device.streaming_endpoints and endpoint not in self._flowing:
                if time.monotonic() - self._active < QUEUED_S:
                    continue
                self._flowing.add(endpoint)
            try:
                packet = self._device.next_packet(endpoint, urb.length)
            except BrokenPipeError:
                return waiting.popleft(), -errno.EPIPE, b""
            if packet is not None:
                return waiting.popleft(), 0, packet
        return None

    # --- the program's memory --------------------------------------------------------------------------------------

    def _read(self, address: int, length: int) -> bytes:
        if length == 0:
            return b""
        self._line.sendall(_WORDS.pack(_READ_MEMORY, address, length))
        content = self._receive(length)
        if content is None:
            raise ConnectionError("the program ended")
        return content

    def _write(self, address: int, data: bytes) -> None:
        self._line.sendall(_WORDS.pack(_WRITE_MEMORY, address, len(data)) + data)

    def _receive(self, length: int) -> bytes | None:
        pieces = bytearray()
        while len(pieces) < length:
            piece = self._line.recv(length - len(pieces))
            if not piece:
                return None
            pieces += piece
        return bytes(pieces)


def missing() -> str | None:
    """Return why no device can be emulated here, ``None`` if it can."""
    if ctypes.util.find_library("umockdev-preload") is None:
        return f"{PRELOAD} is not installed; tools/packages installs umockdev"
    return None
