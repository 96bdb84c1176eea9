"""Writing Prophesee's HDF5 layout: tables of events and trigger edges, each with an index by time.

Compressed by ECF, as their software reads it and nothing else (it takes each chunk for ECF without asking), or by
deflate, which every HDF5 reader knows. The index has an entry for every 2 ms: the first event of the period before
the last one that had any, which is what their reader seeks with.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError
from elpd.events.ecf import pack_chunk
from elpd.ports import WriterTraits
from elpd_drivers.formats.output import columns_inside

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.records import CameraPacket, Geometry

ECF_FILTER = 0x8ECF
CHUNK = 16_384
PERIOD_US = 2000
LONGEST_SILENCE_US = 86_400_000_000
MAX_SIDE = 2048
EVENT = np.dtype({"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"], "offsets": [0, 2, 4, 8],
                  "itemsize": 16})  # fmt: skip
EDGE = np.dtype({"names": ["p", "t", "id"], "formats": ["<i2", "<i8", "<i2"], "offsets": [0, 8, 16], "itemsize": 24})
ENTRY = np.dtype([("id", "<u8"), ("ts", "<i8")])


class Hdf5Writer:
    """An HDF5 file being written."""

    def __init__(self, path: Path, geometry: Geometry, facts: Mapping[str, str], *, ecf: bool) -> None:
        if ecf and not (0 < geometry.width <= MAX_SIDE and 0 < geometry.height <= MAX_SIDE):
            raise FormatError(f"{path}: a sensor of {geometry.width}x{geometry.height} does not fit 11-bit addresses")
        h5py = importlib.import_module("h5py")
        self._geometry = geometry
        self._file = h5py.File(path, "w")
        self._closed = False
        text = h5py.string_dtype("ascii")
        known = {key: value for key, value in facts.items() if key.lower() not in {"evt", "plugin_name", "format"}}
        known |= {"geometry": f"{geometry.width}x{geometry.height}", "version": "1.0"}
        if ecf:
            known["format"] = "ECF"
        for key, value in known.items():
            self._file.attrs.create(key, str(value).encode("ascii", "replace"), dtype=text)
        self._events = _Table(h5py, self._file.create_group("CD"), EVENT, ecf=ecf)
        self._edges = _Table(h5py, self._file.create_group("EXT_TRIGGER"), EDGE, ecf=False, deflate=not ecf)

    @property
    def traits(self) -> WriterTraits:
        """Events and trigger edges, of any time."""
        return WriterTraits(triggers=True)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Nothing is written in another way than it came."""
        return ()

    def write(self, packet: CameraPacket) -> None:
        """Append events and edges. See ``RecordingWriter.write``."""
        t, x, y, p = columns_inside(packet, self._geometry)
        events = np.zeros(t.size, EVENT)
        events["t"], events["x"], events["y"], events["p"] = t, x, y, p
        edges = np.zeros(len(packet.triggers), EDGE)
        for k, edge in enumerate(packet.triggers):
            edges[k] = (edge.rising, edge.t_us, edge.id)
        try:
            self._events.append(events)
            self._edges.append(edges)
        except RuntimeError as error:  # how h5py tells of a full disk, at times
            raise OSError(str(error)) from error

    def close(self, *, complete: bool = True) -> None:
        """Finish. Idempotent."""
        del complete
        if self._closed:
            return
        self._closed = True
        try:
            self._events.finish()
            self._edges.finish()
        except RuntimeError as error:
            raise OSError(str(error)) from error
        finally:
            self._file.close()


class _Table:
    """A growing table ``events`` and its ``indexes`` in a group."""

    def __init__(self, h5py: Any, group: Any, dtype: np.dtype[Any], *, ecf: bool, deflate: bool = True) -> None:
        self._ecf = ecf
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk((CHUNK,))
        if ecf:
            # Optional: the library need not have the filter, the chunks are compressed here.
            plan.set_filter(ECF_FILTER, h5py.h5z.FLAG_OPTIONAL)
        elif deflate:
            plan.set_shuffle()
            plan.set_deflate(4)
        space = h5py.h5s.create_simple((0,), (h5py.h5s.UNLIMITED,))
        kind = h5py.h5t.py_create(dtype, logical=True)
        self._events = h5py.Dataset(h5py.h5d.create(group.id, b"events", kind, space, plan))
        self._index = group.create_dataset("indexes", (0,), ENTRY, chunks=(CHUNK,), maxshape=(None,))
        self._text = h5py.string_dtype("ascii")
        self._held = np.empty(CHUNK, dtype)
        self._held_count = 0
        self._written = self._seen = 0
        self._origin_us: int | None = None
        self._latest_us = 0
        self._entries = 0
        self._before = (0, -1)
        self._due: list[NDArray[Any]] = []
        self._due_count = 0

    def append(self, events: NDArray[Any]) -> None:
        """Append rows with a field ``t``."""
        if events.size == 0:
            return
        self._note_times(events["t"])
        while events.size:
            part = events[: CHUNK - self._held_count]
            self._held[self._held_count : self._held_count + part.size] = part
            self._held_count += part.size
            events = events[part.size :]
            if self._held_count == CHUNK:
                self._write_held()

    def finish(self) -> None:
        """Write what is held, and the last entry."""
        self._write_held()
        if self._origin_us is not None:
            self._add_entries(np.array([self._before], ENTRY))
            self._write_entries()

    def _write_held(self) -> None:
        if self._held_count == 0:
            return
        rows = self._held[: self._held_count]
        begin, end = self._written, self._written + rows.size
        self._events.resize((end,))
        if self._ecf:
            columns = (rows["t"].copy(), rows["x"].copy(), rows["y"].copy(), rows["p"].astype(np.uint8))
            self._events.id.write_direct_chunk((begin,), pack_chunk(*columns))
        else:
            self._events[begin:end] = rows
        self._written, self._held_count = end, 0

    def _note_times(self, t: NDArray[np.int64]) -> None:
        """Bring the index up to these times."""
        if self._origin_us is None:
            self._origin_us = self._latest_us = int(t[0])
            self._index.attrs.create("offset", str(-self._origin_us).encode(), dtype=self._text)
        since_us = np.maximum.accumulate(np.maximum(t, self._latest_us)) - self._origin_us
        self._latest_us = int(since_us[-1]) + self._origin_us
        periods = since_us // PERIOD_US + 1
        due = np.diff(periods, prepend=self._entries)
        if int(due.max()) * PERIOD_US > LONGEST_SILENCE_US:
            raise FormatError(
                f"time jumps ahead by more than a day, to {self._latest_us} us; the index would need an entry for "
                f"every {PERIOD_US} us of it; write another format (npz, csv, aedat4)"
            )
        for at in np.flatnonzero(due).tolist():
            for begin in range(0, int(due[at]), CHUNK):
                self._add_entries(np.full(min(CHUNK, int(due[at]) - begin), np.array(self._before, ENTRY), ENTRY))
            self._before = (self._seen + at, int(t[at]) - self._origin_us)
        self._seen += t.size

    def _add_entries(self, entries: NDArray[Any]) -> None:
        self._due.append(entries)
        self._due_count += entries.size
        self._entries += entries.size
        if self._due_count >= CHUNK:
            self._write_entries()

    def _write_entries(self) -> None:
        self._index.resize((self._entries,))
        self._index[self._entries - self._due_count :] = np.concatenate(self._due)
        self._due, self._due_count = [], 0
