"""The part of reading HDF5 that a damaged file can crash, as a program of its own.

libhdf5 trusts what it reads: a few flipped bytes end in a segmentation fault or in a search without an end (seen with
HDF5 2.0 in three of six runs over 100 to 150 damaged files). So it runs in a child process, which answers one question
after another: a line of JSON on stdin, then on stdout two lengths, a JSON header and bytes. It needs numpy and h5py
alone, so that it starts quickly.
"""

from __future__ import annotations

import importlib
import json
import struct
import sys
from contextlib import suppress
from typing import Any

import numpy as np

ECF_FILTER = 0x8ECF
TABLES = ("CD/events", "events", "data/events")
GROUPS = ("events", "CD/events", "/")
SPELLINGS = {
    "t": ("t", "ts", "timestamp", "timestamps"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity", "polarities", "on"),
}
HEAD = struct.Struct("<II")
Answer = tuple[dict[str, Any], bytes]


class Content:
    """An HDF5 file's events, as far as the library knows them.

    Raises what h5py raises, and ``LookupError`` if there are no events.
    """

    def __init__(self, path: str) -> None:
        self._h5py = importlib.import_module("h5py")
        with suppress(ImportError):
            importlib.import_module("hdf5plugin")  # its filters, where it is installed
        self._file = self._h5py.File(path, "r")
        try:
            self._columns, self._ecf = self._find()
            self._edges = self._edge_columns()
        except Exception:
            self._file.close()
            raise

    def answer(self, question: dict[str, Any]) -> Answer:
        """Answer ``file``, ``events``, ``chunk`` or ``edges``; the latter from ``begin``, at most ``count``."""
        kind = question["ask"]
        if kind == "file":
            return self._describe(), b""
        begin, end = question["begin"], question["begin"] + question["count"]
        if kind == "chunk":
            skipped, data = self._ecf.id.read_direct_chunk((begin,))
            if skipped & 1:
                return _packed(_split(self._ecf[begin:end]))
            return {}, bytes(data)
        table, columns = self._edges if kind == "edges" else self._columns
        if table is not None:
            return _packed(_split(table[begin:end], columns))
        return _packed([column[begin:end] for column in columns])

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _describe(self) -> dict[str, Any]:
        table, columns = self._columns
        edges = self._edges[0]
        return {
            "attributes": {key: _text(value) for key, value in self._file.attrs.items()},
            "events": len(table if table is not None else columns[0]),
            "edges": 0 if edges is None else len(edges),
            "ecf_chunk": 0 if self._ecf is None else int(self._ecf.chunks[0]),
            "t_offset": int(self._file["t_offset"][()]) if "t_offset" in self._file else 0,
        }

    def _find(self) -> tuple[tuple[Any, list[Any]], Any]:
        """Return the table and the names of its columns, or ``None`` and the columns; and the table if ECF has it."""
        for name in TABLES:
            found = self._file.get(name)
            if not isinstance(found, self._h5py.Dataset) or found.ndim != 1 or found.dtype.names is None:
                continue
            names = [next((one for one in many if one in found.dtype.names), None) for many in SPELLINGS.values()]
            if None in names:
                raise LookupError(f"{name} must have fields t, x, y, p; got {', '.join(found.dtype.names)}")
            plan = found.id.get_create_plist()
            filters = [plan.get_filter(k)[0] for k in range(plan.get_nfilters())]
            return (found, names), found if ECF_FILTER in filters else None
        for name in GROUPS:
            group = self._file.get(name)
            if not isinstance(group, self._h5py.Group):
                continue
            columns = [
                next((group[one] for one in many if isinstance(group.get(one), self._h5py.Dataset)), None)
                for many in SPELLINGS.values()
            ]
            if any(column is None for column in columns):
                continue
            shapes = {column.shape for column in columns if column is not None}
            if len(shapes) != 1 or len(next(iter(shapes))) != 1:
                raise LookupError(f"t, x, y, p must be equally long columns; got {sorted(shapes)}")
            return (None, columns), None
        raise LookupError("it holds no /CD/events and no columns t, x, y, p in /events")

    def _edge_columns(self) -> tuple[Any, list[Any]]:
        table = self._file.get("EXT_TRIGGER/events")
        if table is None or not {"t", "id", "p"} <= set(getattr(table.dtype, "names", None) or ()):
            return None, []
        return table, ["t", "id", "p"]


def _split(rows: Any, names: list[Any] | None = None) -> list[Any]:
    """Return a table's rows as columns."""
    return [rows[name] for name in names or ("t", "x", "y", "p")]


def _packed(columns: list[Any]) -> Answer:
    """Return columns as their kinds and their bytes, one after another."""
    plain = [np.ascontiguousarray(column) for column in columns]
    kinds = [column.dtype.str for column in plain]
    if any(column.dtype.kind not in "biuf" for column in plain):
        raise LookupError(f"events must be numbers; got {', '.join(kinds)}")
    return {"columns": kinds, "count": len(plain[0])}, b"".join(column.tobytes() for column in plain)


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def main() -> None:
    """Open the file that the command line names, and answer until stdin ends."""
    content: Content | None = None
    for line in sys.stdin:
        try:
            if content is None:
                content = Content(sys.argv[1])
            header, data = content.answer(json.loads(line))
        except Exception as error:  # noqa: BLE001  (whatever the library says is an answer)
            header, data = {"error": " ".join(str(error).split()) or type(error).__name__}, b""
        text = json.dumps(header).encode()
        sys.stdout.buffer.write(HEAD.pack(len(text), len(data)) + text + data)
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
