"""A serial line as a ``BytePort``: exclusive, never waiting, one system call per write.

pyserial opens and configures the line (it knows every platform's quirks); reading and writing then go past it, because
its ``write`` costs a select and its timeouts are for people who wait. A stop byte is one ``write`` of the C library,
called without letting go of the interpreter: ``os.write`` lets another thread have it first, and waits until that
thread runs if it has asked, which on a busy machine takes milliseconds. The line never blocks, so nobody waits for it.
Two locks keep a second program out: an advisory ``flock`` and ``TIOCEXCL``, which also stops those who do not ask.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import select
import termios
import time
from contextlib import suppress

import serial

from elpd.errors import BusyError, ConfigError, ElpdError, LensError

WRITE_TIMEOUT_S = 0.05

_write = ctypes.PyDLL(None, use_errno=True).write  # PyDLL, unlike CDLL, keeps the interpreter while it calls
_write.argtypes = (ctypes.c_int, ctypes.c_char_p, ctypes.c_size_t)
_write.restype = ctypes.c_ssize_t


class SerialPort:
    """A port, opened exclusively.

    Parameters
    ----------
    path
        Such as ``/dev/ttyACM0``; better a name under ``/dev/serial/by-id``, which survives re-plugging.
    baud
        Bits per second.

    Raises
    ------
    BusyError
        If another program holds the port.
    LensError
        If the port is missing or may not be opened.
    """

    def __init__(self, path: str, baud: int) -> None:
        if not path:
            raise ConfigError("lens.port is empty; set it to the controller's serial port, such as /dev/ttyACM0")
        self.path = path
        try:
            self._serial = serial.Serial(path, baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, exclusive=True)
        except (serial.SerialException, OSError) as error:
            raise _why_not(path, error) from None
        self._descriptor: int | None = self._serial.fileno()
        with suppress(OSError):
            fcntl.ioctl(self._descriptor, termios.TIOCEXCL)
        self.low_latency = self._set_low_latency()
        self._poll = select.poll()
        self._poll.register(self._descriptor, select.POLLIN)

    def write(self, data: bytes) -> None:
        """Hand *data* to the kernel, in one call unless its buffer is full (then within the write timeout)."""
        descriptor = self._open()
        sent = int(_write(descriptor, data, len(data)))
        if sent < 0:
            code = ctypes.get_errno()
            if code not in {errno.EAGAIN, errno.EINTR}:
                raise self._gone("write to", OSError(code, os.strerror(code)))
            sent = 0
        if sent < len(data):
            self._write_rest(descriptor, data[sent:])

    def read_available(self) -> bytes:
        """Return what has arrived."""
        descriptor = self._open()
        try:
            ready = self._poll.poll(0)
            if not ready:
                return b""
            if ready[0][1] & select.POLLIN:
                received = os.read(descriptor, 65536)
                if received:
                    return received
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._gone("read from", error) from None
        raise self._gone("read from", OSError(errno.EIO, os.strerror(errno.EIO)))

    def close(self) -> None:
        """Give the port back. Idempotent."""
        if self._descriptor is None:
            return
        with suppress(OSError, termios.error):
            fcntl.ioctl(self._descriptor, termios.TIOCNXCL)
        self._descriptor = None
        with suppress(OSError, serial.SerialException):
            self._serial.close()

    def _write_rest(self, descriptor: int, data: bytes) -> None:
        deadline = time.monotonic() + WRITE_TIMEOUT_S
        while data:
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                with suppress(termios.error):
                    termios.tcflush(descriptor, termios.TCOFLUSH)  # so that a stop is not queued behind this
                raise LensError(
                    f"lens port {self.path}: the far end takes no bytes ({len(data)} left after "
                    f"{WRITE_TIMEOUT_S * 1e3:.0f} ms); check its power and flow control"
                )
            select.select([], [descriptor], [], left_s)
            try:
                data = data[os.write(descriptor, data) :]
            except BlockingIOError:
                continue
            except OSError as error:
                raise self._gone("write to", error) from None

    def _open(self) -> int:
        if self._descriptor is None:
            raise LensError(f"lens port {self.path}: it is closed; open it again")
        return self._descriptor

    def _gone(self, doing: str, error: OSError) -> LensError:
        return LensError(
            f"lens port {self.path}: cannot {doing} it, the device is gone ({error.strerror}); "
            "check the cable, then home the lens again"
        )

    def _set_low_latency(self) -> bool:
        """Ask the adapter to pass bytes on at once; FTDI's default is to wait up to 16 ms."""
        try:
            self._serial.set_low_latency_mode(True)
        except (ValueError, OSError, NotImplementedError):
            return False  # a pty, or an adapter without that knob
        return True


def _why_not(path: str, error: Exception) -> ElpdError:
    """Turn the ways in which opening fails into what a person can do."""
    code = getattr(error, "errno", None)
    if code is None and "exclusively lock" in str(error):
        code = errno.EAGAIN
    if code in {errno.EAGAIN, errno.EBUSY}:
        return BusyError(
            f"lens port {path}: it is in use by another program; close that first (`fuser {path}` names it)"
        )
    if code == errno.ENOENT or not os.path.exists(path):  # noqa: PTH110  (a string from a config, not a path of ours)
        return LensError(f"lens port {path}: there is no such port; plug the controller in, or correct lens.port")
    if code == errno.EACCES:
        return LensError(f"lens port {path}: permission denied; add this user to the port's group (often `dialout`)")
    return LensError(f"lens port {path}: cannot be opened as a serial port ({error}); correct lens.port")
