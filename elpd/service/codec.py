"""Numbers as JSON has them: numpy's scalars become Python's, what is not finite becomes nothing."""

from __future__ import annotations

import math
from typing import Any


def plain(value: Any) -> Any:
    """Return *value* made of dicts, lists, strings, numbers, booleans and ``None`` alone."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int | bool):
        return value
    return str(value)
