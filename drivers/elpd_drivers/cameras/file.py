"""Any recording as a live camera.

The recording is cut into packets of ``packet_us`` of sensor time, as a camera's USB batching would, and each appears
when its time has come on the clock that is passed in: real or virtual, at the recorded pace or another. Nothing is
decoded: raw words stay raw, so the same kernels run as with hardware.

A packet that ends at a known time says so (``complete_until_us``); one that ends because the reader's buffer did
makes no promise and is followed at once by its rest. Quiet times give empty packets, as they would with a camera
whose time words keep coming. Where a recording ends, ``read`` raises ``CameraError``: to a controller, a camera that
will never send again is a camera that is gone. Before that, an empty packet says that the recording is complete,
which closes its last windows.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from elpd.errors import CameraError, ConfigError, FormatError
from elpd.events.epoch import EPOCH_STEP_US
from elpd.events.evt2 import HIGH_BITS, LOW_BITS
from elpd.events.layout import event_columns
from elpd.events.registers import HIGH, new_state, new_triggers, take_triggers, time_of
from elpd.events.split import SPLITTERS
from elpd.events.stream import EventStream, open_recording
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import NS_PER_S, NS_PER_US, HostNs, SensorUs

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from elpd.ports import Clock, EventCamera, RecordingReader
    from elpd.records import Frame, ImuSample, Trigger

PIECE_BYTES = 1 << 20
PEEK_BYTES = 1 << 12
DEFAULT_PACKET_US = 1000
FOREVER_US = 1 << 62


def encodings(settings: Mapping[str, Any]) -> frozenset[Encoding]:
    """Return how packets may be encoded: as the recording's first is; any, where there is none to see."""
    try:
        reader = open_recording(Path(settings["path"]))
    except (KeyError, FormatError):
        return frozenset(Encoding)
    try:
        return frozenset(packet.encoding for packet in islice(reader.packets(PEEK_BYTES), 1)) or frozenset(Encoding)
    except FormatError:
        return frozenset(Encoding)
    finally:
        reader.close()


def open_camera(settings: Mapping[str, Any], clock: Clock) -> EventCamera:
    """Open a recording as a camera.

    Parameters
    ----------
    settings : mapping
        ``path``: the recording, in any installed format. ``pace``: 1.0 as recorded (default), 2.0 twice as fast, 0
        without waiting. ``packet_us``: how much sensor time a packet holds, 1000 by default. ``width``, ``height``: the
        sensor's size, where the file does not say it (else it is taken from the events).
    clock : Clock
        Whose time paces the packets.

    Raises
    ------
    ConfigError
        For a missing path or a setting out of range.
    FormatError
        For a file that cannot be read.
    """
    if "path" not in settings:
        raise ConfigError("the file camera needs a path: --set camera.path=RECORDING")
    pace = float(settings.get("pace", 1.0))
    packet_us = int(settings.get("packet_us", DEFAULT_PACKET_US))
    if not 0 <= pace < float("inf") or packet_us < 1:
        raise ConfigError(f"pace must be 0 or more and packet_us 1 or more; got {pace} and {packet_us}")
    geometry = None
    if settings.get("width") is not None and settings.get("height") is not None:
        geometry = Geometry(int(settings["width"]), int(settings["height"]))
    return FileCamera(Path(settings["path"]), clock, pace=pace, packet_us=packet_us, geometry=geometry)


class FileCamera:
    """A recording that behaves like a camera. See ``open_camera``."""

    def __init__(
        self, path: Path, clock: Clock, *, pace: float, packet_us: int, geometry: Geometry | None = None
    ) -> None:
        self._path = path
        self._clock = clock
        self._pace = pace
        self._packet_us = packet_us
        reader = open_recording(path)
        try:
            self._geometry = geometry or reader.geometry or _extent(reader)
        finally:
            reader.close()
        self._reader: RecordingReader | None = None
        self._packets: Iterator[dict[str, Any]] = iter(())

    @property
    def geometry(self) -> Geometry:
        """The sensor's size."""
        return self._geometry

    def start(self) -> None:
        """Play from the beginning, from now on."""
        self.stop()
        self._reader = open_recording(self._path)
        self._packets = self._cut(self._reader)
        self._started_ns = self._clock.now_ns()
        self._origin_us: int | None = None
        self._next: dict[str, Any] | None = None

    def read(self, timeout_s: float) -> CameraPacket | None:
        """Wait up to *timeout_s* for the next packet's time; see ``EventCamera.read``."""
        if self._reader is None:
            raise CameraError(f"{self._path.name} is not playing; call start first")
        if self._next is None:
            self._next = next(self._packets, None)
            if self._next is None:
                raise CameraError(f"the recording {self._path.name} has ended")
        due_ns, now_ns = self._due_ns(self._ends_us), self._clock.now_ns()
        if due_ns > now_ns:
            give_up_ns = HostNs(now_ns + round(timeout_s * NS_PER_S))
            self._clock.sleep_until(min(due_ns, give_up_ns))
            if due_ns > give_up_ns:
                return None
            now_ns = self._clock.now_ns()
        fields, self._next = self._next, None
        return CameraPacket(received_ns=now_ns, **fields)

    def stop(self) -> None:
        """Stop playing and close the file. Idempotent."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _due_ns(self, t_us: int) -> HostNs:
        """Return when a packet that ends at *t_us* of the recording is due."""
        if self._pace == 0:
            return self._started_ns
        assert self._origin_us is not None, "the first packet set it"
        return HostNs(self._started_ns + round((t_us - self._origin_us) * NS_PER_US / self._pace))

    def _cut(self, reader: RecordingReader) -> Iterator[dict[str, Any]]:
        """Yield the recording packet by packet, as its fields, setting ``_ends_us`` to when each ends."""
        splitter = _Splitter()
        self._ends_us = 0
        frames: list[Frame] = []
        edges: list[Trigger] = []
        samples: list[ImuSample] = []
        gap, lost = False, 0
        for piece in reader.packets(PIECE_BYTES):
            frames += piece.frames
            edges += piece.triggers
            samples += piece.imu
            gap, lost = gap or piece.gap_before, lost + piece.lost_events
            position, size = 0, piece.data.shape[0]
            if self._origin_us is None:
                first_us = splitter.first_us(piece)
                if first_us is None:
                    continue
                self._origin_us = first_us
                self._ends_us = first_us // self._packet_us * self._packet_us + self._packet_us
            while True:
                begin, position = position, splitter.split(piece, position, self._ends_us)
                whole = position < size
                fields: dict[str, Any] = {
                    "data": piece.data[begin:position],
                    "encoding": piece.encoding,
                    "complete_until_us": SensorUs(self._ends_us) if whole else None,
                    "triggers": splitter.take_triggers(),
                }
                if gap or lost:
                    fields |= {"gap_before": gap, "lost_events": lost}
                    gap, lost = False, 0
                if frames or edges or samples:
                    fields |= {
                        "frames": _take(frames, [frame.available_us for frame in frames], self._ends_us),
                        "triggers": _take(edges, [edge.t_us for edge in edges], self._ends_us) + fields["triggers"],
                        "imu": _take(samples, [one.t_us for one in samples], self._ends_us),
                    }
                yield fields
                if not whole:
                    break
                self._ends_us += self._packet_us
        if self._origin_us is not None:
            self._ends_us = max([self._ends_us, *(frame.available_us for frame in frames)])
            yield {
                "data": piece.data[:0],
                "encoding": piece.encoding,
                "complete_until_us": SensorUs(self._ends_us),
                "frames": tuple(frames),
                "triggers": tuple(edges),
                "imu": tuple(samples),
            }


class _Splitter:
    """Finds where in a piece of recording a time lies."""

    def __init__(self) -> None:
        self._state = new_state()
        self._held = new_triggers()
        self._latest_us = -FOREVER_US
        self._piece: CameraPacket | None = None
        self._rising = np.empty(0, np.int64)

    def split(self, piece: CameraPacket, position: int, until_us: int) -> int:
        """Return the index of the first item at or after *position* that is not before *until_us*."""
        if piece.encoding is Encoding.ARRAY:
            if piece is not self._piece:
                self._take_times(piece)
            return position + int(self._rising[position:].searchsorted(until_us))
        position = SPLITTERS[piece.encoding](piece.data, position, self._state, until_us, self._held)
        if self._state[HIGH] >= 0:
            self._check(time_of(self._state, *_bits(piece.encoding)))
        return position

    def _take_times(self, piece: CameraPacket) -> None:
        """Look through a piece's times: late events are found behind the first that is not before a time."""
        t = event_columns(piece.data)[0].astype(np.int64, copy=False)
        self._piece, self._rising = piece, np.maximum.accumulate(t)
        if t.size:
            back = self._rising - t > EPOCH_STEP_US
            self._check(int(t[np.argmax(back)] if back.any() else t[0]), int(self._rising[np.argmax(back)]))
            self._latest_us = max(self._latest_us, int(self._rising[-1]))

    def _check(self, t_us: int, latest_us: int = -FOREVER_US) -> None:
        """Raise ``CameraError`` if the clock was set back; else remember the time."""
        self._latest_us = max(self._latest_us, latest_us)
        if self._latest_us - t_us > EPOCH_STEP_US:
            raise CameraError(
                f"the recording's clock jumps back from {self._latest_us} to {t_us} us: the camera was reset there; "
                "cut off what comes after with `elpd convert --to-us`"
            )
        self._latest_us = max(self._latest_us, t_us)

    def first_us(self, piece: CameraPacket) -> int | None:
        """Return the first time that *piece* says, or ``None``."""
        if piece.encoding is Encoding.ARRAY:
            return int(event_columns(piece.data)[0][0]) if piece.data.shape[0] else None
        split = SPLITTERS[piece.encoding]
        state = new_state()
        begin = split(piece.data, 0, state, -FOREVER_US, self._held)
        if begin == piece.data.shape[0]:
            return None
        split(piece.data[begin : begin + 1], 0, state, FOREVER_US, new_triggers())
        return time_of(state, *_bits(piece.encoding))

    def take_triggers(self) -> tuple[Trigger, ...]:
        """Return the edges passed since the last call."""
        return take_triggers(self._state, self._held)


def _bits(encoding: Encoding) -> tuple[int, int]:
    """Return how many bits of time lie below a TIME_HIGH word and how many it has."""
    return (12, 12) if encoding is Encoding.EVT3 else (LOW_BITS, HIGH_BITS)


T = TypeVar("T")


def _take(waiting: list[T], times_us: Sequence[int], until_us: int) -> tuple[T, ...]:
    """Remove from *waiting*, and return, what belongs before *until_us*."""
    if not waiting:
        return ()
    ready = sum(t_us < until_us for t_us in times_us)
    taken = tuple(waiting[:ready])
    del waiting[:ready]
    return taken


def _extent(reader: RecordingReader) -> Geometry:
    """Return the smallest sensor that holds every event."""
    width = height = 1
    for chunk in EventStream(reader).chunks():
        width = max(width, int(chunk.x.max(initial=0)) + 1)
        height = max(height, int(chunk.y.max(initial=0)) + 1)
    return Geometry(width, height)
