"""A file that grows by whole pieces: what every writer of ours stands on.

A disk may fill up in the middle of a write. What was appended before must stay readable, so a piece that did not get
in whole is cut off again before the error goes on. Bytes that exist can be overwritten even on a full disk, which is
how headers are brought up to date at the end.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError, UsageError
from elpd.events.layout import event_columns

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.records import CameraPacket, Geometry


class Output:
    """A new file at *path*, overwritten if it exists.

    Attributes
    ----------
    size : int
        Bytes appended so far.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self.size = 0

    def append(self, *pieces: bytes | NDArray[Any]) -> None:
        """Append all of the *pieces* or, if there is no room, none of them. Raises ``OSError``."""
        end = self.size
        try:
            for piece in pieces:
                data = memoryview(piece if isinstance(piece, bytes) else piece.tobytes())
                while data:
                    data = data[self._file.write(data) :]
                    # a short write says nothing of why; the next one does
            self.size = self._file.tell()
        except OSError:
            self._file.truncate(end)
            self._file.seek(end)
            raise

    def patch(self, offset: int, data: bytes) -> None:
        """Overwrite bytes that were appended before."""
        assert offset + len(data) <= self.size, "only what is there can be overwritten"
        self._file.seek(offset)
        self._file.write(data)
        self._file.seek(self.size)

    @property
    def closed(self) -> bool:
        """Whether ``close`` was called."""
        return self._file.closed

    def close(self) -> None:
        """Bring the file to the disk and close it. Idempotent."""
        if not self._file.closed:
            try:
                os.fsync(self._file.fileno())
            except OSError:  # a pipe or /dev/full has nothing to bring anywhere
                self._file.close()
                raise
            self._file.close()


def columns_inside(
    packet: CameraPacket, geometry: Geometry
) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
    """Return an array packet's t, x, y, p (1 is ON).

    Raises
    ------
    FormatError
        If an event lies outside the sensor, or the array is not of events.
    """
    try:
        t, x, y, p = event_columns(packet.data)
    except UsageError as error:
        raise FormatError(f"these are not events: {error}") from error
    outside = int(((x >= geometry.width) | (y >= geometry.height)).sum())
    if outside:
        raise FormatError(
            f"{outside} events lie outside the sensor of {geometry.width}x{geometry.height} pixels; give its true size"
        )
    return t.astype(np.int64, copy=False), x, y, np.asarray(p == 1, np.uint8)
