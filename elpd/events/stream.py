"""Recordings as columns of events, whatever their format: what everybody who reads a file wants.

``open_recording`` asks each installed format (entry-point group ``elpd.formats``) whether it knows the file;
``EventStream`` turns a reader's packets into chunks of t, x, y, p with the trigger edges and frames that belong to
them, in bounded memory.
"""

from __future__ import annotations

import stat
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from elpd.errors import FormatError
from elpd.events.decoder import EventArrays
from elpd.events.evt2 import Evt2Decoder, Evt21Decoder
from elpd.events.evt3_fast import evt3_decoder
from elpd.events.layout import event_columns
from elpd.events.registers import MAX_SIDE
from elpd.records import Encoding, Geometry

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from elpd.events.decoder import WordDecoder
    from elpd.ports import RecordingFormat, RecordingReader
    from elpd.records import CameraPacket, Frame, ImuSample, Trigger

FORMATS_GROUP = "elpd.formats"
DECODERS: dict[Encoding, Callable[[Geometry], WordDecoder]] = {
    Encoding.EVT3: evt3_decoder,
    Encoding.EVT2: Evt2Decoder,
    Encoding.EVT21: Evt21Decoder,
}


class EventChunk(NamedTuple):
    """Consecutive events of a recording: views, valid until the next chunk.

    ``t`` int64 us, ``x`` and ``y`` uint16, ``p`` uint8 (1 is ON); ``triggers``, ``frames`` and ``imu`` that came
    with them.
    """

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]
    triggers: tuple[Trigger, ...] = ()
    frames: tuple[Frame, ...] = ()
    imu: tuple[ImuSample, ...] = ()


_WANTED = "an event file is read forth and back; write the stream to a file first, such as `cat >recording.raw`"


def installed_formats() -> dict[str, RecordingFormat]:
    """Load every format of the entry-point group, by its entry point's name."""
    return {entry.name: cast("RecordingFormat", entry.load()) for entry in entry_points(group=FORMATS_GROUP)}


def open_recording(path: Path) -> RecordingReader:
    """Open an event file with the first installed format that recognises it.

    Raises
    ------
    FormatError
        If there is no such file, or no installed format can read it.
    """
    try:
        found = path.stat()
        if stat.S_ISDIR(found.st_mode):
            raise FormatError(f"{path} is a directory, not an event file")
        if not stat.S_ISREG(found.st_mode):
            raise FormatError(f"{path} is a pipe or a device, and {_WANTED}")
        with path.open("rb") as file:
            beginning = file.read(16)
    except FileNotFoundError as error:
        if path == Path("-"):
            raise FormatError(f"standard input is not read: {_WANTED}") from error
        raise FormatError(f"{path} cannot be read: {error.strerror}; check its name and folder") from error
    except PermissionError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}; `ls -l` tells who may") from error
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    size = found.st_size
    if size == 0:
        raise FormatError(f"{path} is empty: 0 bytes; nothing was recorded, or nothing was copied")
    formats = installed_formats()
    for candidate in formats.values():
        if candidate.recognises(path):
            return candidate.open(path)
    names = ", ".join(sorted(candidate.name for candidate in formats.values())) or "none"
    raise FormatError(
        f"{path} ({size} bytes, beginning {beginning!r}) is in no format that is installed here; there are: {names}"
    )


class PacketDecoder:
    """A camera's packets as columns of events, whatever their encoding; state is carried from packet to packet."""

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self._decoder: WordDecoder | None = None

    def feed(self, packet: CameraPacket) -> EventArrays:
        """Decode one packet: views, valid until the next. Events outside the sensor are dropped."""
        if packet.encoding is Encoding.ARRAY:
            t, x, y, p = event_columns(packet.data)
            return EventArrays(t.astype(np.int64, copy=False), x, y, np.asarray(p == 1, np.uint8))
        if self._decoder is None:
            self._decoder = DECODERS[packet.encoding](self._geometry)
        if packet.gap_before:
            self._decoder.forget_addresses()
        self._decoder.enter_epoch(packet)
        return self._decoder.feed(packet.data)


class EventStream:
    """A reader's packets as chunks of columns.

    Parameters
    ----------
    reader : RecordingReader
        Whose ``packets`` are consumed; it remains the caller's to close.
    geometry : Geometry, optional
        Overrides the reader's. Where neither says, nothing is outside the sensor but what 11 bits cannot say.

    Attributes
    ----------
    packet : CameraPacket or None
        What the last chunk was made of; ``None`` before the first.
    """

    def __init__(self, reader: RecordingReader, geometry: Geometry | None = None) -> None:
        self._reader = reader
        self._geometry = geometry or reader.geometry
        self._decoder: WordDecoder | None = None
        self._outside = 0
        self.packet: CameraPacket | None = None

    def chunks(self, max_bytes: int = 1 << 20) -> Iterator[EventChunk]:
        """Yield the recording from its beginning; each chunk is valid until the next."""
        for packet in self._reader.packets(max_bytes):
            self.packet = packet
            if packet.encoding is Encoding.ARRAY:
                t, x, y, p = event_columns(packet.data)
                t, p = t.astype(np.int64, copy=False), np.asarray(p == 1, np.uint8)
                if self._geometry is not None:
                    inside = (x < self._geometry.width) & (y < self._geometry.height)
                    if not inside.all():
                        self._outside += int(inside.size - inside.sum())
                        t, x, y, p = t[inside], x[inside], y[inside], p[inside]
                yield EventChunk(t, x, y, p, packet.triggers, packet.frames, packet.imu)
                continue
            if self._decoder is None:
                self._decoder = DECODERS[packet.encoding](self._geometry or Geometry(MAX_SIDE, MAX_SIDE))
            if packet.gap_before:
                self._decoder.forget_addresses()
            events = self._decoder.feed(packet.data)
            yield EventChunk(*events, packet.triggers + self._decoder.triggers, packet.frames, packet.imu)

    @property
    def counters(self) -> dict[str, int]:
        """How often each odd thing was met so far."""
        if self._decoder is not None:
            return self._decoder.counters
        return {"x_out_of_range": self._outside} if self._outside else {}

    @property
    def rate_controller(self) -> tuple[int, int] | None:
        """Events before and after the camera's rate controller so far; ``None`` if the stream never said."""
        return None if self._decoder is None else self._decoder.rate_controller
