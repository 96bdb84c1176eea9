"""HDF5 files of events: Prophesee's, and columns as DSEC and others store them.

Prophesee's have a table ``/CD/events`` of x, y, p, t, mostly compressed by ECF, which is undone here without their
plug-in, and ``/EXT_TRIGGER/events``. Others have columns of their own (``/events/t``, x, y, p or p under another name;
DSEC adds ``/t_offset``) or a table ``/events``. What h5py can decompress is read; Blosc and its like need hdf5plugin.

A damaged file can crash the HDF5 library, so that lives in a process of its own (``hdf5_child``).
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError
from elpd.events.ecf import unpack_chunk
from elpd.events.layout import EVENT
from elpd.records import CameraPacket, Encoding, Geometry, Trigger
from elpd.units import HostNs, SensorUs
from elpd_drivers.formats import hdf5_write
from elpd_drivers.formats.columns import pack
from elpd_drivers.formats.hdf5_library import NO_H5PY, Library, installed

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

MAGIC = b"\x89HDF\r\n\x1a\n"
EDGES_AT_A_TIME = 4096


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
        return None if installed() else NO_H5PY

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
        self._path = path
        self._library = Library(path)
        try:
            self._about, _ = self._library.ask(ask="file")
        except FormatError:
            self._library.close()
            raise
        attributes = self._about["attributes"]
        self._geometry = _geometry_of(attributes)
        self._notes: dict[str, Any] = {"format": "HDF5", "warnings": [], "lost": 0, "lost_reason": []}
        self._notes["header"] = {
            key: value for key, value in attributes.items() if key not in {"format", "geometry", "version"}
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
        step = max(max_bytes // EVENT.itemsize, 1)
        edges = self._edges()
        waiting: list[Trigger] = []
        edge = next(edges, None)
        for events in self._ecf_chunks(step) if self._about["ecf_chunk"] else self._pieces(step):
            until_us = int(events["t"][-1])
            while edge is not None and edge.t_us <= until_us:
                waiting.append(edge)
                edge = next(edges, None)
            yield CameraPacket(events, Encoding.ARRAY, HostNs(0), triggers=tuple(waiting))
            waiting.clear()
        while edge is not None:
            waiting.append(edge)
            edge = next(edges, None)
            if edge is None or len(waiting) == EDGES_AT_A_TIME:
                yield CameraPacket(np.empty(0, EVENT), Encoding.ARRAY, HostNs(0), triggers=tuple(waiting))
                waiting.clear()

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._library.close()

    def _pieces(self, step: int) -> Iterator[NDArray[Any]]:
        """Yield pieces that the library decompressed."""
        for begin in range(0, self._about["events"], step):
            count = min(step, self._about["events"] - begin)
            yield self._packed(*_columns(*self._library.ask(ask="events", begin=begin, count=count)))

    def _ecf_chunks(self, step: int) -> Iterator[NDArray[Any]]:
        """Yield pieces of a table that ECF compressed; a chunk that is damaged is counted and passed over."""
        chunk = self._about["ecf_chunk"]
        for begin in range(0, self._about["events"], chunk):
            wanted = min(chunk, self._about["events"] - begin)
            header, data = self._library.ask(ask="chunk", begin=begin, count=wanted)
            try:
                events = self._packed(*_columns(header, data)) if "columns" in header else unpack_chunk(data)
            except FormatError as error:
                self._notes["lost"] += wanted
                self._notes["lost_reason"].append(f"events {begin} to {begin + wanted - 1}: {error}")
                continue
            for at in range(0, min(wanted, events.size), step):
                yield events[at : min(at + step, wanted)]

    def _packed(self, t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> NDArray[Any]:
        if self._about["t_offset"]:
            t = t.astype(np.int64) + self._about["t_offset"]
        return pack(self._path, t, x, y, p)

    def _edges(self) -> Iterator[Trigger]:
        """Yield the trigger edges."""
        for begin in range(0, self._about["edges"], EDGES_AT_A_TIME):
            count = min(EDGES_AT_A_TIME, self._about["edges"] - begin)
            columns = _columns(*self._library.ask(ask="edges", begin=begin, count=count))
            for t, channel, rising in zip(*(column.tolist() for column in columns), strict=True):
                yield Trigger(SensorUs(t), channel, rising == 1)


def _columns(header: Mapping[str, Any], data: bytes) -> list[NDArray[Any]]:
    """Return the columns that an answer packs."""
    found, at = [], 0
    for kind in header["columns"]:
        found.append(np.frombuffer(data, kind, header["count"], at))
        at += found[-1].nbytes
    return found


def _geometry_of(attributes: Mapping[str, str]) -> Geometry | None:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", attributes.get("geometry", ""))
    width, height = found.groups() if found else (attributes.get("width", ""), attributes.get("height", ""))
    if width.isdecimal() and height.isdecimal() and int(width) and int(height):
        return Geometry(int(width), int(height))
    return None
