"""Prophesee DAT files: a text header, then eight bytes an event.

After the header one byte says the kind of event and one its size: 0x00 ("2d") and 0x0C ("CD") are both addresses with
a polarity; longer ones (optical flow) begin with the same eight bytes, and only those are read. The time is 32 bits of
microseconds and turns over every 71.6 minutes, which is undone. Addresses have 14 bits each since version 2; before,
the column had nine and the row eight. A file without a version is read as old if no event has a bit above those.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError
from elpd.events.layout import packed
from elpd.ports import WriterTraits
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs
from elpd_drivers.formats.output import Output, columns_inside
from elpd_drivers.formats.text_header import read_header

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

KINDS = {0x00: "2d", 0x0C: "CD", 0x28: "optical flow"}
OTHER_KINDS = {0x0E: "trigger edges"}
CD, EVENT_BYTES = 0x0C, 8
TURN_US = 1 << 32
MAX_SIDE = 1 << 14


class DatFormat:
    """DAT files of address events."""

    name = "DAT"

    def recognises(self, path: Path) -> bool:
        """Say whether a text header is followed by a kind of event and its size."""
        header, offset = read_header(path)
        if not header or "evt" in header or header.get("format", "").upper().startswith("EVT"):
            return False
        kind, size = _kind_of(path, offset)
        return kind in KINDS | OTHER_KINDS and size >= EVENT_BYTES

    def open(self, path: Path) -> DatReader:
        """Open for reading. Raises ``FormatError`` for events without addresses."""
        return DatReader(path)

    @property
    def writes(self) -> Mapping[str, str]:
        """``dat``: version 2, CD."""
        return {"dat": ".dat"}

    def can_write(self, word: str) -> None:
        """Nothing beyond numpy is needed."""
        del word

    def appends(self, word: str) -> bool:
        """Say yes: events follow events."""
        del word
        return True

    def create(self, path: Path, word: str, geometry: Geometry, facts: Mapping[str, str]) -> DatWriter:
        """Begin a file. Raises ``FormatError`` for a sensor whose addresses do not fit 14 bits."""
        del word
        return DatWriter(path, geometry, facts)


FORMAT = DatFormat()


class DatReader:
    """An open DAT file. ``notes``: format, header, warnings, lost, lost_reason."""

    def __init__(self, path: Path) -> None:
        self._path = path
        header, self._offset = read_header(path)
        self._kind, self._size = _kind_of(path, self._offset)
        if self._kind not in KINDS:
            what = OTHER_KINDS.get(self._kind, "something else")
            raise FormatError(f"{path} holds {what} (kind 0x{self._kind:02x}), not events with addresses")
        self._warnings: list[str] = []
        self._notes: dict[str, Any] = {
            "format": "DAT",
            "header": header,
            "warnings": self._warnings,
            "lost": 0,
            "lost_reason": [],
        }
        if self._kind not in {0x00, CD}:
            self._warnings.append(f"only the addresses and polarities of its {KINDS[self._kind]} events are read")
        self._geometry = _geometry_of(header)
        self._file = path.open("rb", buffering=0)
        self._row_at, self._on_at = self._layout(header.get("version"))

    @property
    def geometry(self) -> Geometry | None:
        """The sensor's size, where the header says it."""
        return self._geometry

    @property
    def notes(self) -> Mapping[str, Any]:
        """``format``, ``header``, ``warnings``, ``lost`` (events), ``lost_reason``."""
        return self._notes

    def packets(self, max_bytes: int = 1 << 20) -> Iterator[CameraPacket]:
        """Yield the events from the beginning, at most *max_bytes* of the file at a time."""
        self._notes["lost"], self._notes["lost_reason"] = 0, []
        self._file.seek(self._offset + 2)
        clock = _Clock()
        step = max(max_bytes // self._size, 1) * self._size
        held = b""
        while True:
            data = self._file.read(step)
            if not data:
                break
            held += data
            whole = len(held) // self._size * self._size
            if whole:
                low, address = self._split(held[:whole])
                x = address & ((1 << self._row_at) - 1)
                y = (address >> self._row_at) & ((1 << (self._on_at - self._row_at)) - 1)
                on = (address >> self._on_at) & 1
                yield CameraPacket(packed(clock.unfold(low), x, y, on), Encoding.ARRAY, HostNs(0))
            held = held[whole:]
        if held:
            self._notes["lost"] = 1
            self._notes["lost_reason"] = [
                f"the file ends in the middle of an event ({len(held)} of {self._size} bytes): it was cut short"
            ]

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def _split(self, data: bytes) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        """Return the times and the addresses of whole events."""
        fields = np.dtype({"names": ["t", "a"], "formats": ["<u4", "<u4"], "offsets": [0, 4], "itemsize": self._size})
        events = np.frombuffer(data, fields)
        return events["t"], events["a"]

    def _layout(self, version: str | None) -> tuple[int, int]:
        """Return at which bits of an address the row and the polarity lie."""
        old, new = (9, 17), (14, 28)
        if version is not None:
            digits = version.partition(".")[0]
            return old if digits.isdecimal() and int(digits) < 2 else new
        self._file.seek(self._offset + 2)
        sample = self._file.read((1 << 16) // self._size * self._size)
        _, address = self._split(sample[: len(sample) // self._size * self._size])
        is_old = address.size > 0 and int(address.max()) >> 18 == 0
        self._warnings.append(f"the header has no version; taken as {'an old one' if is_old else 'version 2'}")
        return old if is_old else new


class DatWriter:
    """A DAT file being written."""

    def __init__(self, path: Path, geometry: Geometry, facts: Mapping[str, str]) -> None:
        if not (0 < geometry.width < MAX_SIDE and 0 < geometry.height < MAX_SIDE):
            raise FormatError(f"{path}: a sensor of {geometry.width}x{geometry.height} does not fit 14-bit addresses")
        self._geometry = geometry
        self._last_us: int | None = None
        lines = ["Data file containing CD events.", "Version 2"]
        lines += [f"Date {date}" for key, date in facts.items() if key.lower() == "date" and date.isprintable()]
        lines += [f"Height {geometry.height}", f"Width {geometry.width}"]
        self._output = Output(path)
        self._output.append("".join(f"% {line}\n" for line in lines).encode() + bytes([CD, EVENT_BYTES]))

    @property
    def traits(self) -> WriterTraits:
        """Events alone; the first within 71.6 minutes, after that the clock turns."""
        return WriterTraits(first_limit_us=TURN_US - 1)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Nothing is written in another way than it came."""
        return ()

    def write(self, packet: CameraPacket) -> None:
        """Append events. See ``RecordingWriter.write``."""
        t, x, y, p = columns_inside(packet, self._geometry)
        if t.size == 0:
            return
        first = int(t[0]) if self._last_us is None else self._last_us
        steps = np.diff(t, prepend=first)
        if int(t.min()) < 0 or int(np.abs(steps).max()) >= TURN_US // 2 or (t[0] >= TURN_US and self._last_us is None):
            raise FormatError(
                f"times from {t.min()} to {t.max()} us with steps of up to {np.abs(steps).max()} us cannot be said in "
                "the 32 bits of DAT; write a format with whole times (npz, csv, hdf5)"
            )
        self._last_us = int(t[-1])
        events = np.empty((t.size, 2), "<u4")
        events[:, 0] = t & (TURN_US - 1)
        events[:, 1] = x.astype(np.uint32) | y.astype(np.uint32) << 14 | p.astype(np.uint32) << 28
        self._output.append(events)

    def close(self, *, complete: bool = True) -> None:
        """Finish. Idempotent. A DAT file cannot say that it was cut short."""
        del complete
        self._output.close()


class _Clock:
    """Undoes the turning over of a 32-bit clock: a step of half a turn or more is one."""

    def __init__(self) -> None:
        self._last = -1
        self._turn = 0

    def unfold(self, low: NDArray[np.uint32]) -> NDArray[np.int64]:
        """Return whole times."""
        t = low.astype(np.int64)
        if self._last < 0:
            self._last = int(t[0])
        steps = np.diff(t, prepend=self._last)
        self._last = int(t[-1])
        turns = np.zeros(t.size, np.int64)
        for at in np.flatnonzero(np.abs(steps) >= TURN_US // 2).tolist():
            # A late event from before the turn belongs to the turn before, unless there was none.
            turn = 1 if steps[at] < 0 else -min(1, self._turn)
            self._turn += turn
            turns[at] = turn
        begin = self._turn - int(turns.sum())
        return t + (begin + np.cumsum(turns)) * TURN_US


def _kind_of(path: Path, offset: int) -> tuple[int, int]:
    """Return the kind of event and its size in bytes; (-1, 0) if the file ends before."""
    with path.open("rb") as file:
        file.seek(offset)
        two = file.read(2)
    return (two[0], two[1]) if len(two) == 2 else (-1, 0)


def _geometry_of(header: Mapping[str, str]) -> Geometry | None:
    width, height = header.get("width", ""), header.get("height", "")
    if not (width.isdecimal() and height.isdecimal()):
        return None
    geometry = Geometry(int(width), int(height))
    return geometry if 0 < geometry.width <= MAX_SIDE and 0 < geometry.height <= MAX_SIDE else None
