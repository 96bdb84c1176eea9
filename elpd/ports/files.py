"""Event files, read and written: entry points of ``elpd.formats``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from elpd.records import CameraPacket, Encoding, Geometry


class RecordingReader(Protocol):
    """An open event file."""

    @property
    def geometry(self) -> Geometry | None:
        """The sensor's size, where the file or its sensor's name says it."""
        ...

    @property
    def notes(self) -> Mapping[str, Any]:
        """What the file says beside events: header fields, counters, warnings, loss; complete once read through."""
        ...

    def packets(self, max_bytes: int = 1 << 20) -> Iterator[CameraPacket]:
        """Yield the file from its beginning, in pieces of bounded memory; ``received_ns`` is zero."""
        ...

    def close(self) -> None:
        """Close the file. Idempotent."""
        ...


class RecordingFormat(Protocol):
    """A file format: what an entry point of the group ``elpd.formats`` names."""

    @property
    def name(self) -> str:
        """The word that `elpd decode` prints, such as ``EVT3``; a family name where one reader serves several."""
        ...

    def recognises(self, path: Path) -> bool:
        """Say from the first bytes (not the suffix) whether this format can read the file."""
        ...

    def open(self, path: Path) -> RecordingReader:
        """Open for reading. Raises ``FormatError`` with what was found and what was expected."""
        ...


@dataclass(frozen=True, slots=True)
class WriterTraits:
    """What a file being written can hold.

    ``encoding`` names the raw words that are taken as they are, beside arrays, ``None`` where there are none;
    ``triggers``, ``frames`` and ``imu`` say what else is kept. ``first_limit_us`` is the largest time that the first
    event may have (``None``: any).
    """

    encoding: Encoding | None = None
    triggers: bool = False
    frames: bool = False
    imu: bool = False
    first_limit_us: int | None = None


class RecordingWriter(Protocol):
    """An event file being written, in bounded memory."""

    @property
    def traits(self) -> WriterTraits:
        """What it can hold."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """Sentences about what could not be written as it was, so far."""
        ...

    def write(self, packet: CameraPacket) -> None:
        """Append a packet: an array of events, or words of ``traits.encoding``, and what came with them.

        Raises ``FormatError`` for what the format cannot say, ``OSError`` when there is no room; what was written
        before stays whole, and ``close`` may follow.
        """
        ...

    def close(self, *, complete: bool = True) -> None:
        """Finish the file. Idempotent. ``complete=False`` leaves it marked as cut short, where that can be said."""
        ...


@runtime_checkable
class WritableFormat(Protocol):
    """A ``RecordingFormat`` that can be written too; asked for once."""

    @property
    def writes(self) -> Mapping[str, str]:
        """The words of ``--format`` that this writes, and each one's usual suffix; first the preferred one."""
        ...

    def can_write(self, word: str) -> str | None:
        """Say what is missing to write *word* here (a package, as a line to type), ``None`` if nothing is."""
        ...

    def appends(self, word: str) -> bool:
        """Say whether what was written is readable at any moment: then a full disk costs only what comes after."""
        ...

    def create(self, path: Path, word: str, geometry: Geometry, facts: Mapping[str, str]) -> RecordingWriter:
        """Begin a file, overwriting *path*. *facts* are what is known of the camera, such as ``serial_number``.

        Raises ``FormatError`` if *word* cannot be written here or the sensor does not fit, ``OSError`` from the disk.
        """
        ...
