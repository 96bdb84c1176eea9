"""Writing NumPy files of events: a structured ``.npy``, or an ``.npz`` of t, x, y, p.

The length of an array stands in front of it. A ``.npy`` has its header brought up to date with every piece, so it can
be read whenever its writer stops; the four arrays of an archive must be gathered first, in files without a name.
"""

from __future__ import annotations

import io
import shutil
import tempfile
import zipfile
from contextlib import ExitStack
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from elpd.events.layout import EVENT, packed
from elpd.ports import WriterTraits
from elpd_drivers.formats.output import Output, columns_inside

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.records import CameraPacket, Geometry

COLUMNS = {"t": "<i8", "x": "<u2", "y": "<u2", "p": "u1"}


class NpyWriter:
    """A structured ``.npy`` being written."""

    def __init__(self, path: Path, geometry: Geometry) -> None:
        self._geometry = geometry
        self._count = 0
        self._output = Output(path)
        self._output.append(_head(EVENT, 0))

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
        events = packed(*columns_inside(packet, self._geometry))
        self._output.append(events)
        self._count += events.size
        self._output.patch(0, _head(EVENT, self._count))

    def close(self, *, complete: bool = True) -> None:
        """Finish. Idempotent. An array cannot say that it was cut short."""
        del complete
        self._output.close()


class NpzWriter:
    """An ``.npz`` of four arrays being written."""

    def __init__(self, path: Path, geometry: Geometry) -> None:
        self._path = path
        self._geometry = geometry
        self._count = 0
        self._file: zipfile.ZipFile | None = zipfile.ZipFile(path, "w", zipfile.ZIP_STORED)
        self._stack = ExitStack()
        self._parts: dict[str, IO[bytes]] = {}
        for name in COLUMNS:
            part = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115  (closed by the stack)
            self._parts[name] = self._stack.enter_context(part)

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
        for (name, kind), column in zip(COLUMNS.items(), columns, strict=True):
            self._parts[name].write(np.ascontiguousarray(column, kind).tobytes())
        self._count += columns[0].size

    def close(self, *, complete: bool = True) -> None:
        """Put the archive together. Idempotent."""
        del complete
        archive, self._file = self._file, None
        if archive is None:
            return
        with self._stack, archive:
            for name, part in self._parts.items():
                part.seek(0)
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    member.write(_head(np.dtype(COLUMNS[name]), self._count))
                    shutil.copyfileobj(part, member, 1 << 20)


def _head(dtype: np.dtype[Any], count: int) -> bytes:
    """Return an array's header. It is of one length for every count: NumPy leaves room to grow."""
    text = io.BytesIO()
    description = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": (count,)}
    np.lib.format.write_array_header_1_0(text, description)
    return text.getvalue()
