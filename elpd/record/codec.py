"""Values to JSON text and back, exactly.

Tapes and decisions are compared byte for byte, so there is one way to write each value: compact, ASCII, floats by
their shortest exact representation, numpy scalars as the Python numbers they hold, enums by value, records as objects
in the order of their fields. The text is strict JSON (``jq`` reads it): what JSON lacks, ``nan`` and the infinities,
becomes the strings ``"nan"``, ``"inf"`` and ``"-inf"``, which ``number`` reads back.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from enum import Enum
from pathlib import PurePath
from typing import Any


def to_json(value: Any, *, sort_keys: bool = False) -> str:
    """Return *value* as one line of strict JSON. Raises ``TypeError`` for what has no such form."""
    encoder = _SORTED if sort_keys else _ORDERED
    try:
        return encoder.encode(value)
    except ValueError:  # a nan or an infinity somewhere: rare, so only then is the whole value walked
        return encoder.encode(_finite(value))


def note_line(event: str, fields: dict[str, Any]) -> str:
    """Return one line of ``decisions.jsonl``: the event first, then its fields in alphabetical order."""
    head = f'{{"event":{to_json(event)}'
    return f"{head},{to_json(fields, sort_keys=True)[1:]}" if fields else f"{head}}}"


def number(value: Any) -> Any:
    """Read a number that ``to_json`` wrote; ``None`` stays ``None``."""
    return float(value) if isinstance(value, str) else value


@functools.cache
def _names(record: type) -> tuple[str, ...]:
    return tuple(item.name for item in dataclasses.fields(record))


def _plain(value: Any) -> Any:
    """Take the outermost wrapping off a value that JSON does not know."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {name: getattr(value, name) for name in _names(type(value))}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, PurePath):
        return str(value)
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return value.tolist()
    if isinstance(value, (set, frozenset)):
        return sorted(value)
    raise TypeError(f"{type(value).__name__} has no place in a journal; pass numbers, strings, lists or dicts")


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else str(float(value))
    if value is None or isinstance(value, (str, int)):
        return value
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return _finite(_plain(value))


_ORDERED = json.JSONEncoder(separators=(",", ":"), allow_nan=False, default=_plain)
_SORTED = json.JSONEncoder(separators=(",", ":"), allow_nan=False, default=_plain, sort_keys=True)
