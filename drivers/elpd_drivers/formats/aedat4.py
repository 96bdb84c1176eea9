"""AEDAT4 files (iniVation's DV): events, frames, trigger edges and IMU samples in packets, each of one stream.

A line ``#!AER-DAT4.0``, a header that says the compression and where the table of contents is, a description of the
streams in XML, then packets ``{i32 stream, i32 size, FlatBuffer}``, then the table. The packets are read one after
another, without the table: a recording that was not finished has none.

Read here and not by a library, because a file may be damaged: the ``aedat`` package (2.3.0) ends the process on a
flipped byte, where this must say what is lost. A packet that makes no sense is counted and passed over.

Trigger edges get the channels of ``CHANNELS``: 0 the signal input, 1 the generator, 2 a frame's beginning and end,
3 its exposure's. Frames in colour become grey.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError
from elpd.records import CameraPacket, Encoding, Frame, Geometry, ImuSample, Trigger
from elpd.units import HostNs, SensorUs
from elpd_drivers.formats import aedat4_write, flat
from elpd_drivers.formats.aedat4_header import MAGIC, MAX_PACKET_BYTES, decompressor, read_header
from elpd_drivers.inertia import acceleration_m_s2, rotation_rad_s

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

EVENT = np.dtype({"names": ["t", "x", "y", "on"], "formats": ["<i8", "<u2", "<u2", "u1"], "offsets": [0, 8, 10, 12],
                  "itemsize": 16})  # fmt: skip
CHANNELS = {1: (0, True), 2: (0, False), 3: (0, True), 4: (1, True), 5: (1, False),
            6: (2, True), 7: (2, False), 8: (3, True), 9: (3, False)}  # fmt: skip
"""A trigger's type, as the channel and whether it rises."""
CLOCK_RESET = 0
GREY = {0: 1, 16: 3, 24: 4}
"""A frame's format, as the number of its colours."""
SAMPLE_BYTES = 500
"""What an inertial sample takes in memory, roughly."""


class Aedat4Format:
    """AEDAT4 files."""

    name = "AEDAT4"

    def recognises(self, path: Path) -> bool:
        """Say whether the file begins with the version's own line."""
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC

    def open(self, path: Path) -> Aedat4Reader:
        """Open for reading. Raises ``FormatError`` for a damaged header, or if a package is missing."""
        return Aedat4Reader(path)

    @property
    def writes(self) -> Mapping[str, str]:
        """``aedat4``, without compression."""
        return {"aedat4": ".aedat4"}

    def can_write(self, word: str) -> None:
        """Nothing beyond numpy is needed."""
        del word

    def appends(self, word: str) -> bool:
        """Say yes: packets follow packets."""
        del word
        return True

    def create(self, path: Path, word: str, geometry: Geometry, facts: Mapping[str, str]) -> aedat4_write.Aedat4Writer:
        """Begin a file."""
        del word
        return aedat4_write.Aedat4Writer(path, geometry, facts)


FORMAT = Aedat4Format()


@dataclass
class _Pending:
    """What was read and not handed on yet."""

    events: list[NDArray[Any]] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    edges: list[Trigger] = field(default_factory=list)
    imu: list[ImuSample] = field(default_factory=list)
    held_bytes: int = 0

    def taken(self) -> CameraPacket:
        """Return it as one packet and begin anew."""
        data = np.concatenate(self.events) if self.events else np.empty(0, EVENT)
        packet = CameraPacket(
            data,
            Encoding.ARRAY,
            HostNs(0),
            frames=tuple(self.frames),
            triggers=tuple(self.edges),
            imu=tuple(self.imu),
        )
        self.__init__()  # type: ignore[misc]
        return packet


class Aedat4Reader:
    """An open AEDAT4 file. ``notes``: format, header, warnings, lost, lost_reason."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("rb")
        try:
            self._header = read_header(path, self._file)
            self._unpacked = decompressor(path, self._header.compression)
        except FormatError:
            self._file.close()
            raise
        self._size = path.stat().st_size
        streams = self._header.streams
        self._events_id = next((k for k, (kind, _) in streams.items() if kind == "EVTS"), None)
        self._frames_id = next((k for k, (kind, _) in streams.items() if kind == "FRME"), None)
        self._imu_id = next((k for k, (kind, _) in streams.items() if kind == "IMUS"), None)
        self._geometry = next((size for _, size in streams.values() if size is not None), None)
        if self._events_id is not None and streams[self._events_id][1] is not None:
            self._geometry = streams[self._events_id][1]
        self._notes: dict[str, Any] = {"format": "AEDAT4", "header": {"source": self._header.source}}
        self._begin_notes()

    @property
    def geometry(self) -> Geometry | None:
        """The sensor's size, as the stream of events says it."""
        return self._geometry

    @property
    def notes(self) -> Mapping[str, Any]:
        """``format``, ``header``, ``warnings``, ``lost`` (packets), ``lost_reason``."""
        return self._notes

    def packets(self, max_bytes: int = 1 << 20) -> Iterator[CameraPacket]:
        """Yield the file's packets, several at a time up to *max_bytes*; one alone may be larger."""
        self._begin_notes()
        self._odd_frames: dict[str, int] = {}
        self._damaged = self._resets = 0
        pending = _Pending()
        try:
            for stream, data in self._raw_packets():
                try:
                    self._take(stream, self._unpacked(data), pending)
                except FormatError:
                    self._damaged += 1
                if pending.held_bytes >= max_bytes:
                    yield pending.taken()
        except OSError as error:
            raise FormatError(f"{self._path} cannot be read: {error.strerror}") from error
        if pending.events or pending.frames or pending.edges or pending.imu:
            yield pending.taken()
        self._end_notes()

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def _raw_packets(self) -> Iterator[tuple[int, bytes]]:
        """Yield the packets' streams and contents, up to the table or where they stop making sense."""
        at = self._header.size
        end = self._header.table_at if at <= self._header.table_at <= self._size else self._size
        while at + 8 <= end:
            self._file.seek(at)
            stream, size = struct.unpack("<ii", self._file.read(8))
            if not 0 <= size <= min(end - at - 8, MAX_PACKET_BYTES) or stream not in self._header.streams:
                break
            yield stream, self._file.read(size)
            at += 8 + size
        if at < end:
            self._notes["lost"] += 1
            self._notes["lost_reason"].append(f"the file ends in the middle of a packet, or is damaged, at byte {at}")

    def _take(self, stream: int, data: bytes, pending: _Pending) -> None:
        """Read one packet. Raises ``FormatError`` if it makes no sense."""
        kind, geometry = self._header.streams[stream]
        if kind == "EVTS" and stream == self._events_id:
            at, count = flat.root(data, b"EVTS").vector(0, EVENT.itemsize)
            pending.events.append(np.frombuffer(data, EVENT, count, at))
            pending.held_bytes += len(data)
        elif kind == "FRME" and stream == self._frames_id:
            frame = self._frame(flat.root(data, b"FRME"), geometry or self._geometry)
            if frame is not None:
                pending.frames.append(frame)
                pending.held_bytes += frame.pixels.nbytes
        elif kind == "TRIG":
            for edge in flat.root(data, b"TRIG").tables(0):
                t, code = edge.scalar(0, "q", 0), edge.scalar(1, "b", 0)
                self._resets += code == CLOCK_RESET
                if code in CHANNELS:
                    pending.edges.append(Trigger(SensorUs(t), *CHANNELS[code]))
            pending.held_bytes += len(data)
        elif kind == "IMUS" and stream == self._imu_id:
            samples = [_sample(one) for one in flat.root(data, b"IMUS").tables(0)]
            pending.imu += samples
            pending.held_bytes += SAMPLE_BYTES * len(samples)

    def _frame(self, table: flat.Table, geometry: Geometry | None) -> Frame | None:
        """Return a frame of the whole sensor, else ``None``, counted."""
        t, end, begin_exposure, end_exposure = (table.scalar(k, "q", 0) for k in (0, 2, 3, 4))
        colours = GREY.get(table.scalar(5, "b", 0))
        width, height = table.scalar(6, "h", 0), table.scalar(7, "h", 0)
        at, count = table.vector(10, 1)
        if colours is None or width <= 0 or height <= 0 or count != width * height * colours:
            raise FormatError(f"a frame of {width}x{height} pixels holds {count} bytes")
        if geometry is not None and (width, height) != (geometry.width, geometry.height):
            self._note_frame("frames of a part of the sensor were passed over")
            return None
        pixels = np.frombuffer(table.data, np.uint8, count, at).reshape(height, width, colours)
        if colours == 1:
            pixels = pixels[..., 0]
        else:
            self._note_frame("frames in colour were made grey")
            # BGR to luma, Rec. 601, as a grey camera behind the same filters would roughly see it
            pixels = np.rint(pixels[..., :3] @ np.array([0.114, 0.587, 0.299])).astype(np.uint8)
        if not 0 < begin_exposure <= end_exposure:
            begin_exposure = t
            end_exposure = t + max(table.scalar(11, "q", 0), 0)
        return Frame(
            t_us=SensorUs((begin_exposure + end_exposure) // 2),
            available_us=SensorUs(max(end, end_exposure)),
            exposure_us=end_exposure - begin_exposure,
            pixels=pixels,
        )

    def _note_frame(self, text: str) -> None:
        self._odd_frames[text] = self._odd_frames.get(text, 0) + 1

    def _begin_notes(self) -> None:
        self._notes |= {"lost": 0, "lost_reason": [], "warnings": []}
        kinds = [kind for kind, _ in self._header.streams.values()]
        for kind, what in (("EVTS", "events"), ("FRME", "frames"), ("IMUS", "IMU samples")):
            if kinds.count(kind) > 1:
                self._notes["warnings"].append(f"{kinds.count(kind)} streams of {what}; the first is read")
        if self._header.table_at < 0:
            self._notes["warnings"].append(
                "the recording was not finished: its disk was full, its camera lost, or its program stopped"
            )

    def _end_notes(self) -> None:
        self._notes["warnings"] += [f"{count} {text}" for text, count in self._odd_frames.items()]
        if self._resets:
            self._notes["warnings"].append(f"the camera's clock was reset {self._resets} times")
        if self._damaged:
            self._notes["lost"] += self._damaged
            self._notes["lost_reason"].append(f"{self._damaged} packets are damaged")


def _sample(table: flat.Table) -> ImuSample:
    """Return an inertial sample: stored are the time, the temperature, three of gravity, three of degrees a second."""
    ax, ay, az, gx, gy, gz = (table.real(field) for field in range(2, 8))
    return ImuSample(
        SensorUs(table.scalar(0, "q", 0)),
        acceleration_m_s2((ax, ay, az)),
        rotation_rad_s((gx, gy, gz)),
        table.real(1),
    )
