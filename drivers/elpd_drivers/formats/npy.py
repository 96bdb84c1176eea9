"""NumPy files of events: structured arrays, plain four-column arrays, and archives of four arrays.

Three habits of the field are read: a structured ``.npy`` with fields t, x, y, p (or their usual synonyms), a
two-dimensional ``.npy`` of rows t, x, y, p, and an ``.npz`` with members t, x, y, p. Times are whole microseconds. None
says how large the sensor was. Files are mapped or read member by member in step, so memory stays bounded; nothing
pickled is ever loaded.
"""

from __future__ import annotations

import zipfile
from contextlib import ExitStack
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError, UsageError
from elpd.events.layout import EVENT, event_columns
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs
from elpd_drivers.formats import npy_write
from elpd_drivers.formats.columns import NAMES, pack

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

NPY_MAGIC = b"\x93NUMPY"
ZIP_MAGIC = b"PK\x03\x04"


class NpyFormat:
    """Structured or four-column ``.npy``, and ``.npz`` of t, x, y, p."""

    name = "NPY, NPZ"

    def recognises(self, path: Path) -> bool:
        """Say whether the file is NumPy's own, or an archive with a member named like a time column."""
        with path.open("rb") as file:
            beginning = file.read(6)
        if beginning == NPY_MAGIC:
            return True
        if not beginning.startswith(ZIP_MAGIC):
            return False
        try:
            with zipfile.ZipFile(path) as archive:
                return any(f"{name}.npy" in archive.namelist() for name in NAMES[0])
        except (zipfile.BadZipFile, OSError):
            return False

    def open(self, path: Path) -> NpyReader | NpzReader:
        """Open for reading. Raises ``FormatError`` for arrays that are not events."""
        with path.open("rb") as file:
            return NpyReader(path) if file.read(6) == NPY_MAGIC else NpzReader(path)

    @property
    def writes(self) -> Mapping[str, str]:
        """``npz``: four arrays; ``npy``: one, structured."""
        return {"npz": ".npz", "npy": ".npy"}

    def can_write(self, word: str) -> None:
        """Nothing beyond numpy is needed."""
        del word

    def appends(self, word: str) -> bool:
        """Say so of ``npy``: an archive is put together at the end."""
        return word == "npy"

    def create(
        self, path: Path, word: str, geometry: Geometry, facts: Mapping[str, str]
    ) -> npy_write.NpyWriter | npy_write.NpzWriter:
        """Begin a file."""
        del facts
        return npy_write.NpyWriter(path, geometry) if word == "npy" else npy_write.NpzWriter(path, geometry)


FORMAT = NpyFormat()


class NpyReader:
    """An open ``.npy`` file, mapped."""

    geometry: Geometry | None = None

    def __init__(self, path: Path) -> None:
        try:
            self._events: NDArray[Any] | None = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise FormatError(f"{path} is damaged or does not hold plain numbers: {error}") from error
        self._path = path
        self._structured = self._events.dtype.fields is not None
        if self._structured and self._events.ndim == 1:
            try:
                event_columns(self._events[:0])
            except UsageError as error:
                raise FormatError(f"{path}: {error}") from error
        elif not (self._events.ndim == 2 and self._events.shape[1] == 4 and self._events.dtype.kind in "iuf"):
            raise FormatError(
                f"{path} holds {self._events.dtype} of shape {self._events.shape}; events are a structured array "
                "with fields t, x, y, p, or rows of t, x, y, p"
            )
        self.notes: Mapping[str, Any] = {"format": "NPY", "warnings": [], "lost": 0, "lost_reason": []}

    def packets(self, max_bytes: int = 1 << 20) -> Iterator[CameraPacket]:
        """Yield the events from the beginning, at most *max_bytes* at a time."""
        events = self._events
        if events is None:
            raise FormatError(f"{self._path} is closed")
        step = max(max_bytes // (events.dtype.itemsize * (1 if self._structured else 4)), 1)
        for begin in range(0, len(events), step):
            piece = events[begin : begin + step]
            if not self._structured:
                piece = pack(self._path, *piece.T)
            yield CameraPacket(np.asarray(piece), Encoding.ARRAY, HostNs(0))

    def close(self) -> None:
        """Unmap the file. Idempotent."""
        self._events = None


class NpzReader:
    """An open ``.npz`` file; its members are read in step."""

    geometry: Geometry | None = None

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._archive = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, OSError) as error:
            raise FormatError(f"{path} is a damaged archive: {error}") from error
        present = self._archive.namelist()
        self._members = [next((f"{n}.npy" for n in names if f"{n}.npy" in present), None) for names in NAMES]
        if None in self._members:
            self._archive.close()
            raise FormatError(f"{path} holds {', '.join(present)}; events are four arrays t, x, y, p")
        self.notes: Mapping[str, Any] = {"format": "NPZ", "warnings": [], "lost": 0, "lost_reason": []}

    def packets(self, max_bytes: int = 1 << 20) -> Iterator[CameraPacket]:
        """Yield the events from the beginning, at most *max_bytes* at a time."""
        step = max(max_bytes // EVENT.itemsize, 1)
        with ExitStack() as stack:
            try:
                files = [stack.enter_context(self._archive.open(str(name))) for name in self._members]
                heads = [
                    _array_head(self._path, str(name), file) for name, file in zip(self._members, files, strict=True)
                ]
                lengths = {length for length, _ in heads}
                if len(lengths) != 1:
                    raise FormatError(f"{self._path}: t, x, y, p must be equally long; got {sorted(lengths)}")
                for begin in range(0, heads[0][0], step):
                    count = min(step, heads[0][0] - begin)
                    parts = [_read_exactly(self._path, f, d, count) for f, (_, d) in zip(files, heads, strict=True)]
                    yield CameraPacket(pack(self._path, *parts), Encoding.ARRAY, HostNs(0))
            except (zipfile.BadZipFile, EOFError, ValueError, OSError, NotImplementedError) as error:
                raise FormatError(f"{self._path} is a damaged archive: {error}") from error

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._archive.close()


def _array_head(path: Path, name: str, file: IO[bytes]) -> tuple[int, np.dtype[Any]]:
    """Read a member's own header; return its length and dtype."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if len(shape) != 1 or dtype.kind not in "biuf":
        raise FormatError(f"{path}: {name} holds {dtype} of shape {shape}; expected one column of numbers")
    return int(shape[0]), dtype


def _read_exactly(path: Path, file: IO[bytes], dtype: np.dtype[Any], count: int) -> NDArray[Any]:
    data = file.read(count * dtype.itemsize)
    if len(data) != count * dtype.itemsize:
        raise FormatError(f"{path} ends early: a column lacks {count - len(data) // dtype.itemsize} events or more")
    return np.frombuffer(data, dtype)
