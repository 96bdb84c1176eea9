"""The lines themselves: requests into bytes, bytes into answers and events, and what an error is called here."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from elpd import errors
from elpd.errors import BusyError, DeviceError, ElpdError, UnreachableError, UsageError

SYSTEM_SOCKET = Path("/run/elpd/elpd.sock")

LONGEST_ANSWER = 64 << 20
"""Bytes; a picture of the largest sensor, 16 bit and in base64, takes a tenth of it."""

LONGEST_PATH = 107
"""Bytes of a socket's path; the kernel's ``sun_path`` holds no more."""

READS = frozenset({"hello", "status", "runs", "run", "metrics", "map"})
"""What may be asked again when an answer is lost: it changes nothing."""

PATIENCE_S = {"focus": 60.0, "home": 60.0, "move": 30.0, "jog": 30.0, "preset": 30.0, "map": 15.0, "run": 15.0}
"""How long to wait for what takes its time, unless told; the daemon's own deadlines are shorter."""

_ERRORS: dict[str, type[ElpdError]] = {
    "Busy": BusyError,
    **{kind.kind: kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, ElpdError)},
}
"""What the daemon calls an error, and what it is here."""


def socket_path(given: str | Path | None = None) -> Path:
    """Say where the daemon listens: *given*, ``ELPD_SOCKET``, the system's socket if there is one, else the user's.

    Where there is none yet, it is where a daemon of this user would make one. Raises ``UsageError`` for a path longer
    than a socket's may be.
    """
    path = Path(given or os.environ.get("ELPD_SOCKET") or SYSTEM_SOCKET)
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if not given and not os.environ.get("ELPD_SOCKET") and not SYSTEM_SOCKET.exists() and runtime:
        users = Path(runtime, "elpd", "elpd.sock")
        path = users if users.exists() or not may_make(SYSTEM_SOCKET) else SYSTEM_SOCKET
    if len(os.fsencode(path)) > LONGEST_PATH:
        raise UsageError(f"{path}: a socket's path may have {LONGEST_PATH} bytes; choose a shorter one")
    return path


def may_make(socket: Path) -> bool:
    """Say whether a daemon of this user could make a socket there."""
    place = socket.parent
    return os.access(place if place.exists() else place.parent, os.W_OK | os.X_OK)


def request_line(number: int, method: str, params: dict[str, Any]) -> bytes:
    """Write a request. Raises ``UsageError`` for what JSON does not have (NaN, objects of other types)."""
    try:
        text = json.dumps({"id": number, "method": method, "params": params}, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{method}: its parameters are not JSON ({error})") from None
    return text.encode() + b"\n"


def patience_s(method: str, params: dict[str, Any] | None, otherwise_s: float) -> float:
    """Say how long an answer may take."""
    if method == "record" and params is not None and isinstance(params.get("seconds"), int | float):
        return float(params["seconds"]) + PATIENCE_S["move"]
    return max(otherwise_s, PATIENCE_S.get(method, otherwise_s))


def result_of(message: dict[str, Any]) -> Any:
    """Return an answer's result, or raise its error under the name it has here."""
    error = message.get("error")
    if error is None:
        return message.get("result")
    kind, text = str(error.get("kind")), str(error.get("message"))
    if kind in _ERRORS:
        raise _ERRORS[kind](text)
    raise DeviceError(f"{kind}: {text}")


def why_not(error: OSError) -> str:
    """Say why nobody could be reached, and what to do."""
    if isinstance(error, FileNotFoundError):
        return "no daemon has made this socket; start one with `elpd serve`"
    if isinstance(error, ConnectionRefusedError):
        return "its daemon is gone; start one with `elpd serve`"
    if isinstance(error, PermissionError):
        return "permission denied; be in the socket's group (often `elpd`)"
    return error.strerror or str(error)


class Unset:
    """The type of what was not given, where ``None`` says something."""


UNSET = Unset()
NULL = object()
"""Stands for a ``null`` that is said."""


def given(**params: Any) -> dict[str, Any]:
    """Leave out what was not given, or says what is so anyway."""
    return {
        name: None if value is NULL else value
        for name, value in params.items()
        if value is not None and value is not False and value is not UNSET
    }


class Lines:
    """Bytes as they come in, objects out."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def feed(self, data: bytes) -> list[dict[str, Any]]:
        """Return the objects that *data* completes. Raises ``UnreachableError`` if these are not the daemon's lines."""
        *complete, rest = data.split(b"\n")
        messages = []
        for line in complete:
            messages.append(_parsed(b"".join((*self._parts, line))))
            self._parts.clear()
            self._size = 0
        if rest:
            self._parts.append(rest)
            self._size += len(rest)
        if self._size > LONGEST_ANSWER:
            raise UnreachableError(f"the daemon sent a line of over {LONGEST_ANSWER >> 20} MiB; is this its socket?")
        return messages


def _parsed(line: bytes) -> dict[str, Any]:
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        message = None
    if not isinstance(message, dict):
        raise UnreachableError(f"what answers does not speak elpd's protocol ({line[:40]!r}); is this its socket?")
    return message
