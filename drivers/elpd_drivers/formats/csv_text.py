"""Events as text: a line each, columns in any order that a header line names.

Separated by commas, semicolons, tabs or blanks. The first line may name the columns: t (also ts, time, timestamp, all
in microseconds; or with the unit in the name, as t_ns, t_ms, t_s), x, y, and p (on, polarity); further columns are
passed over. Without names the order is t, x, y, p or, as Metavision writes it, x, y, p, t, whichever has its polarities
in the place of polarities. Lines that begin with # or % are remarks; ``%geometry:640,480`` says the sensor's size.

Fractions of a microsecond are refused where no unit is named: they are mostly seconds, and nobody should guess.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError
from elpd.ports import WriterTraits
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs
from elpd_drivers.formats.columns import pack
from elpd_drivers.formats.csv_head import TRUTHS, Head, split_fields
from elpd_drivers.formats.output import Output, columns_inside

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

LONGEST_LINE_BYTES = 1 << 12


class CsvFormat:
    """Text with a line per event."""

    name = "CSV"

    def recognises(self, path: Path) -> bool:
        """Say whether the first line that is not a remark names the columns, or is four numbers."""
        try:
            head = Head(path)
        except FormatError:
            return False
        return head.columns is not None

    def open(self, path: Path) -> CsvReader:
        """Open for reading. Raises ``FormatError`` if the columns cannot be told."""
        return CsvReader(path)

    @property
    def writes(self) -> Mapping[str, str]:
        """``csv``: t,x,y,p and a line that says so."""
        return {"csv": ".csv", "txt": ".txt"}

    def can_write(self, word: str) -> None:
        """Nothing beyond numpy is needed."""
        del word

    def appends(self, word: str) -> bool:
        """Say yes: lines follow lines."""
        del word
        return True

    def create(self, path: Path, word: str, geometry: Geometry, facts: Mapping[str, str]) -> CsvWriter:
        """Begin a file."""
        del facts
        return CsvWriter(path, geometry, " " if word == "txt" else ",")


FORMAT = CsvFormat()


class CsvReader:
    """An open text file. ``notes``: format, warnings, lost, lost_reason."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._head = Head(path)
        if self._head.columns is None:
            raise FormatError(
                f"{path}: no columns t, x, y, p in {self._head.first_line!r}; name them in its first line"
            )
        self._columns = self._head.columns
        self._notes: dict[str, Any] = {
            "format": "CSV",
            "warnings": list(self._head.warnings),
            "lost": 0,
            "lost_reason": [],
        }
        self._file = path.open("rb")

    @property
    def geometry(self) -> Geometry | None:
        """The sensor's size, where a remark says it."""
        return self._head.geometry

    @property
    def notes(self) -> Mapping[str, Any]:
        """``format``, ``warnings``, ``lost`` (lines), ``lost_reason``."""
        return self._notes

    def packets(self, max_bytes: int = 1 << 20) -> Iterator[CameraPacket]:
        """Yield the events from the beginning, at most *max_bytes* of text, and a line, at a time."""
        self._notes["lost"], self._notes["lost_reason"] = 0, []
        self._file.seek(self._head.size)
        line = self._head.lines
        while True:
            text = self._file.read(max_bytes)
            if not text:
                break
            if not text.endswith(b"\n"):
                text += self._file.readline(LONGEST_LINE_BYTES)
            last = not text.endswith(b"\n")
            lines = [row for row in text.splitlines() if row.strip() and row.lstrip()[:1] not in {b"#", b"%"}]
            if last and lines and not self._whole(lines[-1]):
                lines.pop()
                self._notes["lost"] = 1
                self._notes["lost_reason"] = ["the file ends in the middle of a line: it was cut short"]
            if lines:
                yield CameraPacket(self._parse(lines, line), Encoding.ARRAY, HostNs(0))
            line += text.count(b"\n")

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def _whole(self, line: bytes) -> bool:
        """Say whether a last line without its end holds all that an event needs."""
        fields = split_fields(line, self._head.separator)
        return len(fields) > max(self._columns.places) and all(fields[at].strip("+-") for at in self._columns.places)

    def _parse(self, lines: list[bytes], begin: int) -> NDArray[Any]:
        """Return lines as events; *begin* is how many lines of the file lie before, for messages."""
        separator = self._head.separator
        if any(word in lines[0].lower() for word in TRUTHS):
            lines = [
                re.sub(rb"\b(true|false)\b", lambda found: TRUTHS[found[0].lower()], row, flags=re.IGNORECASE)
                for row in lines
            ]
        order = self._columns.places
        options: dict[str, Any] = {"delimiter": separator, "usecols": order, "ndmin": 2, "comments": None}
        text = [row.decode("latin-1") for row in lines]
        try:
            try:
                rows = np.loadtxt(text, np.int64, **options)
            except (ValueError, OverflowError):
                rows = np.loadtxt(text, np.float64, **options)
        except (ValueError, OverflowError) as error:
            raise FormatError(f"{self._path}, after line {begin}: {error}") from error
        t = rows[:, 0]
        if self._columns.us_per_t != 1.0:
            if not np.isfinite(t).all():
                raise FormatError(f"{self._path}, after line {begin}: a time is not a number")
            t = np.rint(t * self._columns.us_per_t)
        try:
            return pack(self._path, t, *rows.T[1:])
        except FormatError as error:
            raise FormatError(f"{error}; if these are seconds, name the column t_s in the first line") from error


class CsvWriter:
    """A text file being written."""

    def __init__(self, path: Path, geometry: Geometry, separator: str) -> None:
        self._geometry = geometry
        self._row = separator.join(["%d"] * 4)
        self._output = Output(path)
        self._output.append(f"{separator.join('txyp')}\n".encode())

    @property
    def traits(self) -> WriterTraits:
        """Events alone, of any time."""
        return WriterTraits()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Nothing is written in another way than it came."""
        return ()

    def write(self, packet: CameraPacket) -> None:
        """Append events. See ``RecordingWriter.write``."""
        columns = columns_inside(packet, self._geometry)
        for begin in range(0, columns[0].size, 1 << 16):  # strings are large; no more of them than that at a time
            rows = zip(*(column[begin : begin + (1 << 16)].tolist() for column in columns), strict=True)
            self._output.append("".join(f"{self._row % row}\n" for row in rows).encode())

    def close(self, *, complete: bool = True) -> None:
        """Finish. Idempotent. Text cannot say that it was cut short."""
        del complete
        self._output.close()
