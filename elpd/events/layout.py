"""Event arrays as camera libraries pack them, seen as four columns without a copy.

Every library has its own structured dtype: packed or aligned, ``t`` or ``timestamp``, signed or not, polarity as bool,
0/1 or -1/1. Viewed through a dtype of the same item size with the same offsets, each becomes columns of t (int64 or
uint32), x, y (uint16) and p (uint8, the low byte: 1 means ON in all of those conventions). A dtype is looked at once.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elpd.errors import UsageError

Columns = tuple[NDArray[Any], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]

_T_NAMES = ("t", "timestamp", "ts", "time")
_P_NAMES = ("p", "on", "polarity", "pol")
_T_VIEWS = {"i8": "<i8", "u8": "<i8", "u4": "<u4"}
_ADDRESS_VIEWS = {"u2": "<u2", "i2": "<u2"}


EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
"""Our own packing of an event: 13 bytes."""


def packed(t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> NDArray[Any]:
    """Return four columns, which must be in range, as one structured array of ``EVENT``."""
    events = np.empty(t.shape[0], EVENT)
    for name, column in zip("txyp", (t, x, y, p), strict=True):
        events[name] = column
    return events


def event_columns(events: NDArray[Any]) -> Columns:
    """Return t, x, y, p of a structured array, as views where its dtype allows.

    Parameters
    ----------
    events : (n,) structured
        Fields t or timestamp (us), x, y, and p, on or polarity, in any order and packing. Other integer widths than
        those cameras deliver (t of 4 or 8 bytes, x and y of 2) are converted, which copies.

    Raises
    ------
    UsageError
        If a field is missing or is not an integer.
    """
    names, target = _view_of(events.dtype)
    if target is None:
        t, x, y, p = (events[name] for name in names)
        return columns(t, x, y, p)
    view = events.view(target)
    return view["t"], view["x"], view["y"], view["p"]


def columns(t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> Columns:
    """Return four plain integer arrays as the columns that kernels take, copying only what must be widened.

    Raises
    ------
    UsageError
        If the arrays are not one-dimensional, equally long and integer (p may be bool).
    """
    if len({array.shape for array in (t, x, y, p)}) != 1 or t.ndim != 1:
        raise UsageError(f"t, x, y, p must be equally long columns; got {t.shape}, {x.shape}, {y.shape}, {p.shape}")
    for name, array in (("t", t), ("x", x), ("y", y)):
        _check_integer(name, array.dtype)
    _check_integer("p", p.dtype)
    return (
        _as(t, _T_VIEWS, np.dtype("<i8")),
        _as(x, _ADDRESS_VIEWS, np.dtype("<u2")),
        _as(y, _ADDRESS_VIEWS, np.dtype("<u2")),
        _low_byte(p),
    )


@lru_cache(maxsize=64)
def _view_of(dtype: np.dtype[Any]) -> tuple[tuple[str, str, str, str], np.dtype[Any] | None]:
    """Return the names of t, x, y, p in *dtype*, and the dtype to view it as; ``None`` if it must be converted."""
    fields = dtype.fields
    if fields is None:
        raise UsageError(f"events must have fields t, x, y, p; got {dtype}")
    t_name = next((name for name in _T_NAMES if name in fields), None)
    p_name = next((name for name in _P_NAMES if name in fields), None)
    if t_name is None or p_name is None or "x" not in fields or "y" not in fields:
        raise UsageError(
            f"events must have fields t or timestamp, x, y, and p, on or polarity; got {', '.join(fields)}"
        )
    names = (t_name, "x", "y", p_name)
    for name in names:
        _check_integer(name, fields[name][0])
    formats = [
        views.get(fields[name][0].str[1:])
        for name, views in ((t_name, _T_VIEWS), ("x", _ADDRESS_VIEWS), ("y", _ADDRESS_VIEWS))
    ]
    if None in formats or not all(fields[name][0].isnative for name in names):
        return names, None
    offsets = [fields[name][1] for name in names]
    return names, np.dtype(
        {
            "names": ["t", "x", "y", "p"],
            "formats": [*formats, "u1"],
            "offsets": offsets,
            "itemsize": dtype.itemsize,
        }
    )


def _check_integer(name: str, dtype: np.dtype[Any]) -> None:
    if dtype.kind not in ("biu" if name in _P_NAMES else "iu"):
        raise UsageError(f"event field {name} must be an integer (t in microseconds); got {dtype}")


def _as(array: NDArray[Any], views: dict[str, str], wide: np.dtype[Any]) -> NDArray[Any]:
    view = views.get(array.dtype.str[1:]) if array.dtype.isnative else None
    if view is not None:
        return array.view(view)
    if wide.itemsize == 2 and array.dtype.itemsize > 2:
        # An address that two bytes cannot say must not wrap into the sensor.
        return np.where((array < 0) | (array > 0xFFFF), 0xFFFF, array).astype(wide)
    return array.astype(wide)


def _low_byte(p: NDArray[Any]) -> NDArray[np.uint8]:
    if p.dtype.itemsize == 1:
        return p.view(np.uint8)
    if not p.dtype.isnative:
        p = p.astype(p.dtype.newbyteorder("="))
    byte = np.dtype({"names": ["b"], "formats": ["u1"], "offsets": [0], "itemsize": p.dtype.itemsize})
    return p.view(byte)["b"]
