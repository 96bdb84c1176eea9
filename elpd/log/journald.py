"""Lines for systemd's journal, with a field of its own for every value.

``journalctl ELPD_OUTCOME=NO_CROSSING`` then finds what it should. The native protocol is a datagram of ``NAME=value``
lines; a value with a newline in it follows its name as a little-endian u64 length, the bytes and a newline; what is too
large for a datagram goes as a sealed memfd (https://systemd.io/JOURNAL_NATIVE_PROTOCOL/). A journal that does not take
a line costs that line, never time: nothing here waits, and the next line says how many were lost.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import socket
import sys
from typing import TYPE_CHECKING, Any

from elpd.log.fields import json_text, with_traceback

if TYPE_CHECKING:
    from collections.abc import Mapping

    from structlog.typing import EventDict

SOCKET = "/run/systemd/journal/socket"
PRIORITIES = {"debug": 7, "info": 6, "warning": 4, "error": 3, "critical": 2}
_SEALS = fcntl.F_SEAL_SEAL | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE
_OWN = frozenset({"event", "level", "timestamp", "monotonic_ns", "exception"})
_NAME_LENGTH = 64


class Journal:
    """A sink for log events."""

    def __init__(self, address: str = SOCKET) -> None:
        self._address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        self._lost = 0

    @classmethod
    def if_stderr_is_it(cls, environment: Mapping[str, str] | None = None) -> Journal | None:
        """Return a journal where ``JOURNAL_STREAM`` names stderr; a service may have sent that elsewhere since."""
        stream = (os.environ if environment is None else environment).get("JOURNAL_STREAM")
        if stream is None:
            return None
        stderr = os.fstat(2)
        return cls() if stream == f"{stderr.st_dev}:{stderr.st_ino}" else None

    def __call__(self, event: EventDict) -> None:
        """Send one line."""
        entry = encode(fields(with_traceback(event), self._lost))
        try:
            self._send(entry)
        except BlockingIOError:
            self._lost += 1
        except OSError as error:  # no journal any more; stderr still goes somewhere
            self._lost += 1
            sys.stderr.write(f"elpd: journal: {error}; {event['event']}\n")
        else:
            self._lost = 0

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _send(self, entry: bytes) -> None:
        try:
            self._socket.sendto(entry, self._address)
        except OSError as error:
            if error.errno not in {errno.EMSGSIZE, errno.ENOBUFS}:
                raise
            memory = os.memfd_create("elpd-journal", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            try:
                os.write(memory, entry)
                fcntl.fcntl(memory, fcntl.F_ADD_SEALS, _SEALS)
                rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, memory.to_bytes(4, sys.byteorder))
                self._socket.sendmsg([b""], [rights], 0, self._address)
            finally:
                os.close(memory)


def fields(event: EventDict, lost: int = 0) -> dict[str, str]:
    """Return the journal's fields of a log event: its own ones, and ``ELPD_NAME`` for each of ours."""
    ours = {key: _text(value) for key, value in event.items() if key not in _OWN}
    if lost:
        ours["lost_lines"] = str(lost)
    message = " ".join([str(event["event"]), *(f"{key}={value}" for key, value in ours.items())])
    if "exception" in event:
        message += f"\n{event['exception']}"
    return {
        "MESSAGE": message,
        "PRIORITY": str(PRIORITIES[event["level"]]),
        "SYSLOG_IDENTIFIER": "elpd",
        "ELPD_EVENT": str(event["event"]),
        "ELPD_MONOTONIC_NS": str(event["monotonic_ns"]),
        **{_name(key): value for key, value in ours.items()},
    }


def encode(entry: Mapping[str, str]) -> bytes:
    """Return one entry as the journal's socket takes it."""
    parts = []
    for name, value in entry.items():
        data = value.encode("utf-8", "surrogateescape")
        if b"\n" in data:
            parts.append(name.encode("ascii") + b"\n" + len(data).to_bytes(8, "little") + data + b"\n")
        else:
            parts.append(name.encode("ascii") + b"=" + data + b"\n")
    return b"".join(parts)


def _name(key: str) -> str:
    """Return a field's name: the journal takes capital letters, digits and ``_``, at most 64."""
    return f"ELPD_{re.sub(r'[^A-Z0-9_]', '_', key.upper())}"[:_NAME_LENGTH]


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json_text(value).strip('"')
