"""HDF5 files of events: Prophesee's, and columns as DSEC and others store them.

Prophesee's have a table ``/CD/events`` of x, y, p, t, mostly compressed by ECF, which is undone here without their
plug-in, and ``/EXT_TRIGGER/events``. Others have columns of their own (``/events/t``, x, y, p or p under another name;
DSEC adds ``/t_offset``) or a table ``/events``. What h5py can decompress is read; Blosc and its like need hdf5plugin.
"""

from __future__ import annotations

import importlib
import re
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError, UsageError
from elpd.events.ecf import unpack_chunk
from elpd.events.layout import event_columns
from elpd.records import CameraPacket, Encoding, Geometry, Trigger
from elpd.units import HostNs, SensorUs
from elpd_drivers.formats import hdf5_write
from elpd_drivers.formats.columns import pack

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

MAGIC = b"\x89HDF\r\n\x1a\n"
NO_H5PY = "HDF5 files need h5py: pip install h5py"
ECF_FILTER = 0x8ECF
TABLES = ("CD/events", "events", "data/events")
GROUPS = ("events", "CD/events", "/")
SPELLINGS = {
    "t": ("t", "ts", "timestamp", "timestamps"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity", "polarities", "on"),
}
EDGES_AT_A_TIME = 4096
EVENT_BYTES = 16


class Hdf5Format:
    """HDF5 files with events in them."""

    name = "HDF5"

    def recognises(self, path: Path) -> bool:
        """Say whether the file begins as HDF5 files do."""
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC

    def open(self, path: Path) -> Hdf5Reader:
        """Open for reading. Raises ``FormatError`` if no events are found in it, or h5py is missing."""
        return Hdf5Reader(path)

    @property
    def writes(self) -> Mapping[str, str]:
        """``hdf5`` as Prophesee's software writes and reads it; ``hdf5-deflate`` for readers without ECF."""
        return {"hdf5": ".hdf5", "hdf5-deflate": ".h5"}

    def can_write(self, word: str) -> str | None:
        """Say whether h5py is missing."""
        del word
        return None if _h5py() is not None else NO_H5PY

    def appends(self, word: str) -> bool:
        """Say no: HDF5 keeps its own books."""
        del word
        return False

    def create(self, path: Path, word: str, geometry: Geometry, facts: Mapping[str, str]) -> hdf5_write.Hdf5Writer:
        """Begin a file."""
        return hdf5_write.Hdf5Writer(path, geometry, facts, ecf=word == "hdf5")


FORMAT = Hdf5Format()


class Hdf5Reader:
    """An open HDF5 file. ``notes``: format, header, warnings, lost, lost_reason."""

    def __init__(self, path: Path) -> None:
        h5py = _h5py()
        if h5py is None:
            raise FormatError(f"{path}: {NO_H5PY}")
        self._path = path
        with self._failures():
            self._file = h5py.File(path, "r")
        try:
            with self._failures():
                self._events, self._columns = self._find(h5py)
                self._attributes = {key: _text(value) for key, value in self._file.attrs.items()}
                self._offset_us = int(self._file["t_offset"][()]) if "t_offset" in self._file else 0
        except FormatError:
            self._file.close()
            raise
        self._geometry = _geometry_of(self._attributes)
        self._notes: dict[str, Any] = {"format": "HDF5", "warnings": [], "lost": 0, "lost_reason": []}
        self._notes["header"] = {
            key: value for key, value in self._attributes.items() if key not in {"format", "geometry", "version"}
        }

    @property
    def geometry(self) -> Geometry | None:
        """The sensor's size, where an attribute says it."""
        return self._geometry

    @property
    def notes(self) -> Mapping[str, Any]:
        """``format``, ``header``, ``warnings``, ``lost`` (events), ``lost_reason``."""
        return self._notes

    def packets(self, max_bytes: int = 1 << 20) -> Iterator[CameraPacket]:
        """Yield the events from the beginning, with the trigger edges of their time."""
        self._notes["lost"], self._notes["lost_reason"] = 0, []
        step = max(max_bytes // EVENT_BYTES, 1)
        edges = self._edges()
        waiting: list[Trigger] = []
        edge = next(edges, None)
        pieces = self._table(step) if self._events is not None else self._separate(step)
        for events in pieces:
            until_us = int(event_columns(events[-1:])[0][0])
            while edge is not None and edge.t_us <= until_us:
                waiting.append(edge)
                edge = next(edges, None)
            yield CameraPacket(events, Encoding.ARRAY, HostNs(0), triggers=tuple(waiting))
            waiting.clear()
        while edge is not None:
            waiting.append(edge)
            edge = next(edges, None)
            if edge is None or len(waiting) == EDGES_AT_A_TIME:
                yield CameraPacket(np.empty(0, hdf5_write.EVENT), Encoding.ARRAY, HostNs(0), triggers=tuple(waiting))
                waiting.clear()

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def _find(self, h5py: Any) -> tuple[Any, dict[str, Any]]:
        """Return the table of events, or ``None`` and the columns."""
        for name in TABLES:
            found = self._file.get(name)
            if isinstance(found, h5py.Dataset) and found.ndim == 1:
                try:
                    event_columns(np.empty(0, found.dtype))
                except UsageError as error:
                    raise FormatError(f"{self._path}: {name}: {error}") from error
                return found, {}
        for name in GROUPS:
            group = self._file.get(name)
            if not isinstance(group, h5py.Group):
                continue
            columns = {
                wanted: next((group[one] for one in spellings if isinstance(group.get(one), h5py.Dataset)), None)
                for wanted, spellings in SPELLINGS.items()
            }
            if any(column is None for column in columns.values()):
                continue
            shapes = [column.shape for column in columns.values() if column is not None]
            if len(set(shapes)) != 1 or len(shapes[0]) != 1:
                raise FormatError(f"{self._path}: t, x, y, p must be equally long columns; got {shapes}")
            return None, columns
        raise FormatError(f"{self._path} holds no /CD/events and no columns t, x, y, p in /events")

    def _table(self, step: int) -> Iterator[NDArray[Any]]:
        """Yield pieces of a table of events."""
        table = self._events
        if ECF_FILTER in _filters(table):
            yield from self._ecf_chunks(step)
            return
        for begin in range(0, len(table), step):
            with self._failures():
                events = table[begin : begin + step]
            yield events

    def _ecf_chunks(self, step: int) -> Iterator[NDArray[Any]]:
        """Yield pieces of a table that ECF compressed; a chunk that is damaged is counted and passed over."""
        table = self._events
        chunk = table.chunks[0]
        for begin in range(0, len(table), chunk):
            wanted = min(chunk, len(table) - begin)
            try:
                with self._failures():
                    skipped, data = table.id.read_direct_chunk((begin,))
                events = np.frombuffer(data, table.dtype) if skipped & 1 else unpack_chunk(bytes(data))
            except (FormatError, ValueError) as error:
                self._notes["lost"] += wanted
                self._notes["lost_reason"].append(f"events {begin} to {begin + wanted - 1}: {error}")
                continue
            for at in range(0, min(wanted, events.size), step):
                yield events[at : min(at + step, wanted)]

    def _separate(self, step: int) -> Iterator[NDArray[Any]]:
        """Yield pieces made of four columns."""
        size = self._columns["t"].shape[0]
        for begin in range(0, size, step):
            with self._failures():
                t, x, y, p = (self._columns[name][begin : begin + step] for name in "txyp")
            if self._offset_us:
                t = t.astype(np.int64) + self._offset_us
            yield pack(self._path, t, x, y, p)

    def _edges(self) -> Iterator[Trigger]:
        """Yield the trigger edges."""
        table = self._file.get("EXT_TRIGGER/events")
        if table is None or not {"t", "p", "id"} <= set(getattr(table.dtype, "names", None) or ()):
            return
        for begin in range(0, len(table), EDGES_AT_A_TIME):
            with self._failures():
                rows = table[begin : begin + EDGES_AT_A_TIME]
            for t, channel, rising in zip(rows["t"].tolist(), rows["id"].tolist(), rows["p"].tolist(), strict=True):
                yield Trigger(SensorUs(t), channel, rising == 1)

    @contextmanager
    def _failures(self) -> Iterator[None]:
        """Turn what h5py raises into ``FormatError``."""
        try:
            yield
        except FormatError:
            raise
        except (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError) as error:
            told = " ".join(str(error).split())
            if "filter" in told or "plugin" in told:
                raise FormatError(
                    f"{self._path} is compressed in a way that is not installed here; try: pip install hdf5plugin "
                    f"({told})"
                ) from error
            raise FormatError(f"{self._path} is damaged: {told}") from error


def _h5py() -> Any:
    """Return h5py, with hdf5plugin's filters where that is installed; ``None`` if there is no h5py."""
    try:
        h5py = importlib.import_module("h5py")
    except ImportError:
        return None
    with suppress(ImportError):
        importlib.import_module("hdf5plugin")
    return h5py


def _filters(dataset: Any) -> list[int]:
    """Return the codes of a dataset's filters."""
    plan = dataset.id.get_create_plist()
    return [plan.get_filter(k)[0] for k in range(plan.get_nfilters())]


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _geometry_of(attributes: Mapping[str, str]) -> Geometry | None:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", attributes.get("geometry", ""))
    width, height = found.groups() if found else (attributes.get("width", ""), attributes.get("height", ""))
    if width.isdecimal() and height.isdecimal() and int(width) and int(height):
        return Geometry(int(width), int(height))
    return None
