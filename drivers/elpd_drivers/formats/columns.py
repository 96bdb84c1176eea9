"""Columns of numbers, as libraries and people store them, made into events.

Times are whole microseconds. A column of floats will do where it holds whole numbers; fractions are refused, because
they are mostly seconds, and nobody should guess.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError, UsageError
from elpd.events.layout import columns, packed

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

EXACT = 2**53
"""Where doubles stop being whole numbers one by one."""

NAMES = (("t", "timestamp", "ts"), ("x",), ("y",), ("p", "on", "polarity"))
"""What arrays are called that hold t, x, y, p."""


def pack(path: Path, t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> NDArray[Any]:
    """Return columns of any number type as one structured array.

    Raises ``FormatError`` for fractions, and for columns that are not one-dimensional and equally long.
    """
    whole = []
    for name, column in (("t", t), ("x", x), ("y", y), ("p", p)):
        if column.dtype.kind == "f":
            rounded = np.rint(column)
            # Not finite fails this too.
            if not (np.abs(column) <= EXACT).all() or (rounded != column).any():
                raise FormatError(f"{path}: {name} must be whole numbers (t in microseconds); it holds fractions")
            column = rounded.astype(np.int64)
        whole.append(column)
    try:
        return packed(*columns(*whole))
    except UsageError as error:
        raise FormatError(f"{path}: {error}") from error
