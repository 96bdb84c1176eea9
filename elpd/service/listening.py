"""The listening socket: made, taken over from a supervisor, never stolen.

Two daemons on one socket would be two programs that each believe to own the lens. So whoever listens holds a lock
beside the socket, for as long as it lives, with its process id in it; a socket whose owner is gone is removed.
"""

from __future__ import annotations

import fcntl
import os
import socket
import stat
import struct
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from elpd.client.wire import LONGEST_PATH, SYSTEM_SOCKET, may_make
from elpd.errors import BusyError, ConfigError

if TYPE_CHECKING:
    from collections.abc import MutableMapping

FIRST_DESCRIPTOR = 3
"""``SD_LISTEN_FDS_START``."""

MODE = 0o660
BACKLOG = 64

_FLOCK = "hhqqi4x"
"""``struct flock`` of 64-bit Linux: type, whence, start, length, pid."""


@dataclass(slots=True)
class Listening:
    """Sockets that listen, and what to undo at the end."""

    sockets: list[socket.socket]
    path: Path | None = None
    """The socket's file, if this process made it."""
    _lock: int | None = None
    _inode: tuple[int, int] | None = field(default=None)

    def claim(self) -> None:
        """Hold the lock of a socket that was handed over, where its folder lets us, so that others find this process.

        Raises ``BusyError`` if another daemon holds it.
        """
        with suppress(OSError):
            self._lock = _locked(Path(os.fsdecode(self.sockets[0].getsockname())))

    def close(self) -> None:
        """Listen no more; remove the file if it is still the one that was made here."""
        for listener in self.sockets:
            listener.close()
        if self.path is not None:
            with suppress(OSError):
                if _identity(self.path) == self._inode:
                    self.path.unlink()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def handed_over(environ: MutableMapping[str, str], pid: int) -> list[socket.socket]:
    """Take the sockets that a supervisor has opened (``LISTEN_FDS``); none if they are not for this process.

    The variables are removed, so that no child takes them for its own. Raises ``ConfigError`` for a descriptor that is
    not a listening Unix stream socket.
    """
    meant, count = environ.pop("LISTEN_PID", ""), environ.pop("LISTEN_FDS", "")
    environ.pop("LISTEN_FDNAMES", None)
    if meant != str(pid) or not count.isdecimal():
        return []
    return [_adopted(descriptor) for descriptor in range(FIRST_DESCRIPTOR, FIRST_DESCRIPTOR + int(count))]


def listen_at(path: Path) -> Listening:
    """Make the socket *path*, mode 0660.

    Raises ``BusyError`` if a daemon listens there (with its process id), ``ConfigError`` if it cannot be made.
    """
    if len(os.fsencode(path)) > LONGEST_PATH:
        raise ConfigError(f"api.socket: {path}: a socket's path may have {LONGEST_PATH} bytes; choose a shorter one")
    try:
        path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
        lock = _locked(path)
    except OSError as error:
        raise _not_made(path, error) from None
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
    try:
        _remove_stale(path)
        listener.bind(str(path))
        path.chmod(MODE)  # before it listens: nobody connects in between
        listener.listen(BACKLOG)
        return Listening([listener], path, lock, _identity(path))
    except BaseException as error:
        listener.close()
        os.close(lock)
        if isinstance(error, OSError):
            raise _not_made(path, error) from None
        raise


def default_path() -> Path:
    """Return where a daemon listens that was not told: the system's place if it may, else its user's."""
    if may_make(SYSTEM_SOCKET):
        return SYSTEM_SOCKET
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if not runtime:
        place = SYSTEM_SOCKET.parent
        raise ConfigError(
            f"api.socket: {place} may not be written and XDG_RUNTIME_DIR is not set; "
            "name a socket, such as --set api.socket=./elpd.sock, and then --socket ./elpd.sock to each command"
        )
    return Path(runtime, "elpd", "elpd.sock")


def holder_pid(path: Path) -> int | None:
    """Return the process that holds the lock beside *path*, as it wrote it; ``None`` if nobody does or may be asked."""
    try:
        descriptor = os.open(_lock_path(path), os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        asked = fcntl.fcntl(descriptor, fcntl.F_OFD_GETLK, _whole_file(fcntl.F_WRLCK))
        held = struct.unpack(_FLOCK, asked)[0] != fcntl.F_UNLCK
        text = os.read(descriptor, 32).decode("ascii", "replace").strip()
    finally:
        os.close(descriptor)
    return int(text) if held and text.isdecimal() else None


def _locked(path: Path) -> int:
    """Take the lock; it goes with the process, however that ends."""
    descriptor = os.open(_lock_path(path), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, _whole_file(fcntl.F_WRLCK))
    except BlockingIOError:
        os.close(descriptor)
        raise _busy(path, holder_pid(path)) from None
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    return descriptor


def _whole_file(kind: int) -> bytes:
    """Return the kernel's record of a lock over a whole file; unlike ``flock`` it can be asked for without taking."""
    return struct.pack(_FLOCK, kind, os.SEEK_SET, 0, 0, 0)


def _remove_stale(path: Path) -> None:
    try:
        found = path.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(found.st_mode):
        raise ConfigError(f"api.socket: {path} is not a socket; remove it, or choose another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
        except BlockingIOError:
            pass  # somebody listens, with a full queue
    raise _busy(path, None)


def _adopted(descriptor: int) -> socket.socket:
    try:
        listener = socket.socket(fileno=descriptor)
        fits = (
            listener.family == socket.AF_UNIX
            and listener.type == socket.SOCK_STREAM
            and listener.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
        )
    except OSError as error:
        raise ConfigError(f"LISTEN_FDS: descriptor {descriptor} is no socket ({error.strerror})") from None
    if not fits:
        listener.detach()
        raise ConfigError(f"LISTEN_FDS: descriptor {descriptor} is no listening Unix stream socket; see elpd.socket")
    os.set_inheritable(descriptor, False)
    return listener


def _lock_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.lock")


def _identity(path: Path) -> tuple[int, int]:
    found = path.lstat()
    return found.st_dev, found.st_ino


def _busy(path: Path, pid: int | None) -> BusyError:
    who = "a daemon" if pid is None else f"a daemon (process {pid})"
    return BusyError(f"{path}: {who} listens there already; stop it first, or set api.socket to another path")


def _not_made(path: Path, error: OSError) -> ConfigError:
    return ConfigError(f"api.socket: {path} cannot be made ({error.strerror}); choose a folder that may be written")
