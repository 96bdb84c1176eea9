"""What the first lines of a text file say: where its columns are, how long a unit of time is, how large the sensor.

Names of columns win; without them the polarities tell the order, because only they are nothing but -1, 0 and 1.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

from elpd.errors import FormatError
from elpd.records import Geometry

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

LOOK_BYTES = 1 << 14
T_NAMES = {"t", "ts", "time", "timestamp"}
P_NAMES = {"p", "on", "pol", "polarity"}
PER_US = {"us": 1.0, "µs": 1.0, "ns": 1e-3, "ms": 1e3, "s": 1e6}
POLARITIES = {-1.0, 0.0, 1.0}
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
TRUTHS = {b"true": b"1", b"false": b"0"}


class Columns(NamedTuple):
    """Where t, x, y, p stand in a line, and how many microseconds one of t is."""

    places: tuple[int, int, int, int]
    us_per_t: float
    named: bool


class Head:
    """What the first lines say.

    Attributes
    ----------
    size, lines : int
        Bytes and lines before the first event.
    separator : str or None
        ``None`` for blanks.
    columns : Columns or None
        ``None`` if this is not text with events.
    """

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as file:
                text = file.read(LOOK_BYTES)
        except OSError as error:
            raise FormatError(f"{path} cannot be read: {error.strerror}") from error
        self.geometry: Geometry | None = None
        self.warnings: list[str] = []
        self.columns: Columns | None = None
        self.separator: str | None = None
        self.size = self.lines = 0
        self.first_line = ""
        if any(byte < 0x20 and byte not in b"\t\n\r" for byte in text):
            return
        rows = text.removeprefix(BYTE_ORDER_MARK)
        mark = len(text) - len(rows)
        metavision = False
        while rows:
            line, end, rest = rows.partition(b"\n")
            content = line.strip()
            remark = content[:1] in {b"#", b"%"}
            if content and not remark:
                break
            found = re.match(rb"[#%]\s*geometry\W+(\d{1,5})\W+(\d{1,5})", content, re.IGNORECASE)
            if found and int(found[1]) and int(found[2]):
                self.geometry = Geometry(int(found[1]), int(found[2]))
                metavision |= content[:1] == b"%"
            named = self._named(content.lstrip(b"#% "))
            if remark and named is not None:
                self.columns = named
            self.size, self.lines, rows = self.size + len(line) + len(end), self.lines + 1, rest
        self.size += mark
        line, end, rest = rows.partition(b"\n")
        self.first_line = line.decode("utf-8", "replace").strip()[:80]
        named = self._named(line.strip())
        if named is not None:
            self.columns = named
            self.size, self.lines = self.size + len(line) + len(end), self.lines + 1
            first = next((row for row in rest.split(b"\n") if row.strip() and row.lstrip()[:1] not in b"#%"), b"")
            if first:
                self.separator = separator_of(first)
            return
        self.separator = separator_of(line)
        if self.columns is None:
            whole_lines = rows.split(b"\n")[: -1 if rows.count(b"\n") else None]
            self.columns = self._by_content(whole_lines, metavision=metavision)

    def _named(self, line: bytes) -> Columns | None:
        """Read a line as names of columns."""
        separator = separator_of(line)
        names = [name.strip(" \"'").lower() for name in split_fields(line, separator)]
        places: dict[str, int] = {}
        us_per_t = 1.0
        for at, name in enumerate(names):
            stem, _, unit = name.replace("(", "_").replace("[", "_").rstrip(")]").replace(" ", "").rpartition("_")
            if name in T_NAMES or (stem.strip("_") in T_NAMES and unit in PER_US):
                if "t" in places:
                    continue
                places["t"], us_per_t = at, PER_US.get(unit, 1.0) if stem else 1.0
            elif name in P_NAMES:
                places.setdefault("p", at)
            elif name in {"x", "y"}:
                places.setdefault(name, at)
        if len(places) < 4:
            return None
        return Columns((places["t"], places["x"], places["y"], places["p"]), us_per_t, named=True)

    def _by_content(self, lines: Sequence[bytes], *, metavision: bool) -> Columns | None:
        """Tell the order of unnamed columns by where the polarities are."""
        rows = []
        for line in lines[:1000]:
            if not line.strip() or line.lstrip()[:1] in {b"#", b"%"}:
                continue
            fields = split_fields(line, self.separator)
            try:
                rows.append([float(TRUTHS.get(field.lower().encode(), field)) for field in fields])
            except ValueError:
                return None
            if len(fields) != 4:
                return None
        if not rows:
            return None
        plain, metavision_order = Columns((0, 1, 2, 3), 1.0, named=False), Columns((3, 0, 1, 2), 1.0, named=False)
        last, third = ({row[k] for row in rows} <= POLARITIES for k in (3, 2))
        if metavision or (third and not last):
            if not metavision:
                self.warnings.append("its columns have no names; taken as x, y, p, t, because the third are polarities")
            return metavision_order
        return plain if last else None


def separator_of(line: bytes) -> str | None:
    """Return what separates the fields of a line; ``None`` for blanks."""
    return next((mark for mark in (",", ";", "\t") if mark.encode() in line), None)


def split_fields(line: bytes, separator: str | None) -> list[str]:
    """Return the fields of a line, without blanks around them; none of an empty line."""
    text = line.decode("utf-8", "replace").strip()
    return [field.strip() for field in text.split(separator)] if text else []
