"""Lines in: cut at line ends, bounded, and read into a call or a refusal. Pure; no socket, no engine.

Whatever bytes come, the answer is a call whose parameters are known to be good, or an error with the number of the
request it belongs to where that can be told. Nothing here recurses, waits or keeps more than one line.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

from pydantic import ValidationError

from elpd.errors import ElpdError, TooLargeError, UsageError
from elpd.service.messages import METHODS, Params

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

LONGEST_LINE = 64 << 10
"""Bytes of a request, its line end included."""

DEEPEST = 16
"""Levels of nesting; the deepest request there is has three."""

LONGEST_TEXT_ID = 64
"""Characters. A number is echoed whatever it is, as long as it is a whole one that fits 64 bits."""

URGENT = frozenset({"stop", "cancel"})
"""What is done before anything else that has arrived."""

Number = int | str | None
_KEYS = {"id", "method", "params", "jsonrpc"}


@dataclass(frozen=True, slots=True)
class Call:
    """A request, its parameters validated."""

    number: Number
    method: str
    params: Params


class RefusedLine(Exception):  # noqa: N818  (what a line is, not what the program did wrong)
    """A line that is no request; *error* says why, *number* whose answer that is."""

    def __init__(self, number: Number, error: ElpdError) -> None:
        super().__init__(str(error))
        self.number = number
        self.error = error


class LineCutter:
    """Cut a stream of bytes into lines; ``None`` stands for a line past the limit, told once, when it is noticed."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self.skipped = 0
        """Bytes of the over-long line that is being skipped, 0 when none is."""

    def feed(self, data: bytes | bytearray | memoryview) -> Iterator[bytes | None]:
        """Yield the lines that *data* completes, without their ends; empty ones are left out."""
        if self.skipped:
            data = bytes(data)
            end = data.find(b"\n")
            if end < 0:
                self.skipped += len(data)
                return
            self.skipped = 0
            data = data[end + 1 :]
        self._rest += data
        *lines, rest = bytes(self._rest).split(b"\n") if b"\n" in self._rest else (bytes(self._rest),)
        self._rest = bytearray(rest)
        for line in lines:
            if len(line) >= LONGEST_LINE:
                yield None
            elif line.strip():
                yield line
        if len(self._rest) >= LONGEST_LINE:
            self.skipped = len(self._rest)
            self._rest.clear()
            yield None


def may_be_urgent(line: bytes) -> bool:
    """Say whether to look at a line first; costs two searches, and may say yes to another request."""
    return b'"stop"' in line or b'"cancel"' in line


def too_long() -> TooLargeError:
    """Return the error of a line past the limit."""
    return TooLargeError(f"a request has at most {LONGEST_LINE} bytes, its line end included; this one was skipped")


def read_call(line: bytes) -> Call:
    """Read one line. Raises ``RefusedLine``, and nothing else, for what is not a request."""
    message = _object(line)
    number = _number(message)
    unknown = sorted(set(message) - _KEYS)
    if unknown:
        raise RefusedLine(number, UsageError(f"unknown key {unknown[0]!r}; a request has id, method and params"))
    method = message.get("method")
    if not isinstance(method, str) or method not in METHODS:
        told = repr(method)[:80]
        raise RefusedLine(number, UsageError(f"there is no method {told}; there are {', '.join(METHODS)}"))
    params = message.get("params", {})
    if params is None:
        params = {}
    if not isinstance(params, dict):
        raise RefusedLine(number, UsageError(f"{method}: params is an object, such as {{}}; got {repr(params)[:80]}"))
    try:
        # By way of JSON again, because that is where strict means what the schema says: no text for a number, but a
        # whole number for a real one and a list for a tuple.
        return Call(number, method, METHODS[method].model_validate_json(json.dumps(params), strict=True))
    except ValidationError as error:
        raise RefusedLine(number, UsageError(f"{method}: {_first(error)}")) from None


def _object(line: bytes) -> dict[str, Any]:
    try:
        message = json.loads(line.decode("utf-8"), parse_constant=_no_constant, parse_float=_finite)
    except UnicodeDecodeError as error:
        raise RefusedLine(None, UsageError(f"not UTF-8 (byte {error.start}: 0x{line[error.start]:02x})")) from None
    except RecursionError:
        raise RefusedLine(None, _too_deep()) from None
    except ValueError as error:
        raise RefusedLine(None, UsageError(f"not JSON: {error}; send one object a line")) from None
    if not isinstance(message, dict):
        raise RefusedLine(None, UsageError(f"a request is an object; got {repr(message)[:40]}"))
    # Brackets are counted first, because hardly any line has enough of them to be too deep.
    if line.count(b"[") + line.count(b"{") > DEEPEST and _depth_beyond(message.values(), DEEPEST - 1):
        raise RefusedLine(_number(message), _too_deep())
    return message


def _number(message: dict[str, Any]) -> Number:
    number = message.get("id")
    if number is None or (isinstance(number, str) and len(number) <= LONGEST_TEXT_ID and number.isprintable()):
        return number
    if isinstance(number, int) and not isinstance(number, bool) and -(2**63) <= number < 2**63:
        return number
    raise RefusedLine(
        None, UsageError(f"id is a whole number of 64 bits or a text of {LONGEST_TEXT_ID}; got {repr(number)[:40]}")
    )


def _depth_beyond(values: Iterable[Any], allowed: int) -> bool:
    """Say whether *values* nest more than *allowed* levels deep; level by level, so nothing recurses."""
    level = list(values)
    for _ in range(allowed):
        level = [
            inner
            for value in level
            if isinstance(value, dict | list)
            for inner in (value.values() if isinstance(value, dict) else value)
        ]
        if not level:
            return False
    return any(isinstance(value, dict | list) for value in level)


def _too_deep() -> TooLargeError:
    return TooLargeError(f"a request nests at most {DEEPEST} levels deep")


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number")


def _finite(text: str) -> float:
    number = float(text)
    if number in {float("inf"), float("-inf")}:
        raise ValueError(f"{text[:40]} is too large")
    return number


def _first(error: ValidationError) -> str:
    """Say the first thing that is wrong with parameters."""
    first = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    what = "unknown key" if first["type"] == "extra_forbidden" else first["msg"].removeprefix("Value error, ")
    got = "" if first["type"] == "missing" or not where else f" (got {repr(first['input'])[:60]})"
    return f"{where}: {what}{got}" if where else what
