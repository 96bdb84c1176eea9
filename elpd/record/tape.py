"""A run as a tape: every question that was put to a device, and its answer, in order.

``tape_rig`` puts a recorder between a cycle and its rig; ``replay_rig`` gives a rig that answers from the tape and
insists on hearing the same questions. Nothing is interpreted: what a device said, or how it failed, is kept as it was,
so a decision that depends on anything else than the tape shows itself as a divergence.

While the lens moves nothing is encoded or written: a call costs a tuple in a list and, for a packet, one copy of its
data. ``flush`` turns what has gathered into text and bytes; its caller chooses when there is time. Memory is bounded:
past the limit the tape ends, says so, and the run goes on without it. The same holds for a disk that is full or gone.

Layout: ``tape.jsonl`` is one JSON object a line (the rig's facts; then calls; then a closing line, whose absence means
a torn tape). Packet data lie beside it as they were received: Prophesee words in a valid ``events.raw``, other
encodings packed in ``events.bin`` with their dtype on the tape. Frames are ``frames/*.png`` (``.npy`` where PNG cannot
hold them), array answers ``arrays.bin``.
"""

from __future__ import annotations

import contextlib
import hashlib
import threading
from dataclasses import replace
from typing import IO, TYPE_CHECKING, Any, NamedTuple, Protocol

import cv2
import numpy as np

from elpd.record.codec import to_json
from elpd.record.seams import build_doubles, facts_of, methods_of
from elpd.records import CameraPacket, Encoding

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.ports import RigParts
    from elpd.record.double import RigFacts
    from elpd.records import Frame, Geometry

TAPE_FORMAT = 1
TAPE_FILE = "tape.jsonl"
ARRAYS_FILE = "arrays.bin"

_EVT_VERSION = {Encoding.EVT2: "2.0", Encoding.EVT21: "2.1", Encoding.EVT3: "3.0"}
_EVT_FORMAT = {Encoding.EVT2: "EVT2", Encoding.EVT21: "EVT21", Encoding.EVT3: "EVT3"}
_ENTRY_BYTES = 400  # what one call occupies while it waits to be written, generously
_SAMPLE_BYTES = 500  # likewise, of an inertial sample
_PNG_TYPES = (np.dtype(np.uint8), np.dtype(np.uint16))


class Opener(Protocol):
    """How files are opened for writing; ``open`` itself, unless a test wants a disk that fails."""

    def __call__(self, path: Path, mode: str, /) -> IO[bytes]:
        """Open *path* in a binary *mode*."""
        ...


def open_file(path: Path, mode: str, /) -> IO[bytes]:
    """Open a file for the journal, its folder made first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.open(mode)


class _Raised(NamedTuple):
    kind: str
    message: str


class _Array(NamedTuple):
    values: NDArray[Any]


class _Entry(NamedTuple):
    call: str
    arguments: Sequence[Any]
    answer: Any
    outside: bool


class TapeWriter:
    """Where calls and answers go; one thread's in order, other threads' (a supervisor's STOP) marked ``outside``.

    Parameters
    ----------
    directory
        The run's folder, or ``None`` for a tape that keeps nothing.
    memory_limit_bytes
        How much may wait between two flushes. Past it the tape is truncated.
    opener
        How files are opened.

    """

    def __init__(
        self, directory: Path | None, *, memory_limit_bytes: int = 256_000_000, opener: Opener = open_file
    ) -> None:
        self.truncated: str | None = None if directory is not None else "no folder to write to"
        self._directory = directory  # None from the moment that nothing can be written any more
        self._memory_limit_bytes = memory_limit_bytes
        self._opener = opener
        self._methods: dict[str, Callable[..., Any]] = {}
        self._geometry: Geometry | None = None
        self._waiting: list[_Entry] = []
        self._waiting_bytes = 0
        self._owner: int | None = None
        self._files: dict[str, IO[bytes]] = {}
        self._streams: dict[tuple[Encoding, str], tuple[int, str]] = {}
        self._calls = 0
        self._frames = 0
        self._closed = False

    @property
    def waiting_bytes(self) -> int:
        """Roughly how much the next ``flush`` will write."""
        return self._waiting_bytes

    def begin(self, facts: RigFacts, methods: dict[str, Callable[..., Any]]) -> None:
        """Start the tape of one rig. Raises ``ValueError`` for a second one."""
        if self._geometry is not None:
            raise ValueError("a tape holds one rig; open a new run for the next")
        self._geometry = facts.geometry
        self._methods = methods
        self._guarded(lambda: self._line(f'{{"tape":{TAPE_FORMAT},"facts":{to_json(facts)}}}'))

    def ask(self, call: str, /, *arguments: Any) -> Any:
        """Ask the true device, keep its answer."""
        try:
            answer = self._methods[call](*arguments)
        except BaseException as error:
            self._keep(call, arguments, _raised(error))
            raise
        self._keep(call, arguments, answer)
        return answer

    def ask_array(self, call: str, argument: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Ask the true device for an array; the argument is kept as a digest."""
        arguments = (digest(argument),)
        try:
            answer: NDArray[np.float64] = self._methods[call](argument)
        except BaseException as error:
            self._keep(call, arguments, _raised(error))
            raise
        self._keep(call, arguments, _Array(np.array(answer)))
        return answer

    def watch(self, cancelled: Callable[[], int]) -> Callable[[], int]:
        """Wrap a question from outside the rig whose answer the decision depends on; its changes go on the tape."""
        polls, last = 0, 0

        def asked() -> int:
            nonlocal polls, last
            polls += 1
            answer = cancelled()
            if answer != last:
                last = answer
                self._keep("cancelled", (polls,), answer)
            return answer

        return asked

    def flush(self) -> None:
        """Encode and write what has gathered. Never raises for the disk: the tape is truncated instead."""
        waiting, self._waiting, self._waiting_bytes = self._waiting, [], 0

        def write() -> None:
            for entry in waiting:
                self._write(entry)
            for file in self._files.values():
                file.flush()

        self._guarded(write)

    def close(self) -> None:
        """Flush, write the closing line, close the files. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self.flush()
        end = to_json({"end": True, "calls": self._calls, "truncated": self.truncated})
        with contextlib.suppress(OSError):
            if self._directory is not None and TAPE_FILE in self._files:
                self._line(end)
        for file in self._files.values():
            with contextlib.suppress(OSError):
                file.close()

    def abandon(self, reason: str) -> None:
        """End the tape at what has been written, and drop what waits."""
        self.truncated = self.truncated or reason
        self._waiting, self._waiting_bytes = [], 0

    # --- while the lens moves ----------------------------------------------------------------------------------

    def _keep(self, call: str, arguments: Sequence[Any], answer: Any) -> None:
        if self.truncated is not None or self._closed:
            return
        thread = threading.get_ident()
        if self._owner is None:
            self._owner = thread
        size = _ENTRY_BYTES
        if type(answer) is CameraPacket:
            size += answer.data.nbytes + sum(frame.pixels.nbytes for frame in answer.frames)
            size += _SAMPLE_BYTES * len(answer.imu)
        elif type(answer) is _Array:
            size += answer.values.nbytes
        if self._waiting_bytes + size > self._memory_limit_bytes:
            self.truncated = (
                f"{(self._waiting_bytes + size) / 1e6:.1f} MB waited to be written "
                f"(limit {self._memory_limit_bytes / 1e6:.1f} MB); raise journal.memory_mb or choose a smaller ROI"
            )
            return
        if type(answer) is CameraPacket:
            answer = _owned(answer)
        self._waiting_bytes += size
        self._waiting.append(_Entry(call, arguments, answer, thread != self._owner))

    # --- while there is time -----------------------------------------------------------------------------------

    def _guarded(self, write: Callable[[], None]) -> None:
        """Write, or on a failing disk end the tape."""
        if self._directory is None:
            return
        try:
            write()
        except OSError as error:
            self.abandon(f"{self._directory}: {error.strerror or error}; free some space or set journal.directory")
            self._directory = None

    def _open(self, name: str) -> IO[bytes]:
        if self._directory is None:
            raise OSError("no folder to write to")
        return self._opener(self._directory / name, "wb")

    def _file(self, name: str) -> IO[bytes]:
        if name not in self._files:
            self._files[name] = self._open(name)
        return self._files[name]

    def _line(self, text: str) -> None:
        self._file(TAPE_FILE).write(text.encode("ascii") + b"\n")

    def _write(self, entry: _Entry) -> None:
        answer = entry.answer
        key, value = "answer", answer
        if type(answer) is CameraPacket:
            value = self._packet(answer)
        elif type(answer) is _Array:
            self._file(ARRAYS_FILE).write(answer.values.tobytes())
            value = {"dtype": answer.values.dtype.str, "shape": answer.values.shape}
        elif type(answer) is _Raised:
            key = "raised"
        self._calls += 1
        outside = ',"outside":true' if entry.outside else ""
        self._line(
            f'{{"n":{self._calls},"call":"{entry.call}","args":{to_json(entry.arguments)},'
            f'"{key}":{to_json(value)}{outside}}}'
        )

    def _packet(self, packet: CameraPacket) -> dict[str, Any]:
        stream, name = self._stream(packet.encoding, packet.data.dtype)
        self._file(name).write(_without_padding_noise(packet.data).tobytes())
        line: dict[str, Any] = {"stream": stream, "count": packet.data.size, "received_ns": packet.received_ns}
        line["complete_until_us"] = packet.complete_until_us
        if packet.frames:
            line["frames"] = [self._frame(frame) for frame in packet.frames]
        if packet.triggers:
            line["triggers"] = [[trigger.t_us, trigger.id, trigger.rising] for trigger in packet.triggers]
        if packet.imu:
            line["imu"] = [
                [one.t_us, *one.acceleration_m_s2, *one.rotation_rad_s, one.temperature_c] for one in packet.imu
            ]
        if packet.gap_before:
            line["gap_before"] = True
        if packet.lost_events:
            line["lost_events"] = packet.lost_events
        if packet.backlog:
            line["backlog"] = packet.backlog
        return line

    def _stream(self, encoding: Encoding, dtype: np.dtype[Any]) -> tuple[int, str]:
        """Return the file that packets of this kind go to, opened and declared on the tape at the first of them."""
        description = to_json(np.lib.format.dtype_to_descr(dtype))
        key = (encoding, description)
        if key not in self._streams:
            suffix = "raw" if encoding in _EVT_VERSION else "bin"
            number = len(self._streams)
            name = f"events.{suffix}" if number == 0 else f"events-{number}.{suffix}"
            self._file(name).write(self._raw_header(encoding))
            self._line(
                f'{{"stream":{number},"file":"{name}","encoding":"{encoding.value}","dtype":{description},'
                f'"begins":{len(self._raw_header(encoding))}}}'
            )
            self._streams[key] = (number, name)
        return self._streams[key]

    def _raw_header(self, encoding: Encoding) -> bytes:
        """Return Prophesee's RAW header: what any of their readers needs, and no date."""
        if encoding not in _EVT_VERSION or self._geometry is None:
            return b""
        width, height = self._geometry.width, self._geometry.height
        lines = (
            f"% evt {_EVT_VERSION[encoding]}",
            f"% format {_EVT_FORMAT[encoding]};height={height};width={width}",
            f"% geometry {width}x{height}",
            "% end",
        )
        return ("\n".join(lines) + "\n").encode("ascii")

    def _frame(self, frame: Frame) -> dict[str, Any]:
        self._frames += 1
        pixels = frame.pixels
        as_png = pixels.dtype in _PNG_TYPES and pixels.ndim == 2 and pixels.size > 0
        name = frame_name(self._frames) if as_png else f"frames/{self._frames:06d}.npy"
        with self._open(name) as file:
            if as_png:
                file.write(cv2.imencode(".png", pixels)[1].tobytes())
            else:
                np.lib.format.write_array(file, pixels, allow_pickle=False)
        return {
            "t_us": frame.t_us,
            "available_us": frame.available_us,
            "exposure_us": frame.exposure_us,
            "file": name,
        }


def tape_rig(parts: RigParts, tape: TapeWriter) -> RigParts:
    """Return *parts* with a recorder in front of every device.

    The answers are those of the true devices, passed on untouched; optional abilities appear exactly where the device
    has them. ``truth`` is handed through: no decision may depend on it, so it is not on the tape.
    """
    facts = facts_of(parts)
    tape.begin(facts, methods_of(parts))
    return replace(build_doubles(facts, tape), truth=parts.truth)


def frame_name(number: int) -> str:
    """Return where the frame that came as the *number*-th lies, in the run's folder."""
    return f"frames/{number:06d}.png"


def _owned(packet: CameraPacket) -> CameraPacket:
    """Copy the views of a packet, which end with the next read."""
    frames = packet.frames
    if frames:
        frames = tuple(replace(frame, pixels=np.ascontiguousarray(frame.pixels).copy()) for frame in frames)
    return replace(packet, data=packet.data.copy(), frames=frames)


def _without_padding_noise(data: NDArray[Any]) -> NDArray[Any]:
    """Return events whose bytes between the fields are zero; what stood there was whatever the memory held before."""
    names = data.dtype.names
    if names is None or data.dtype.itemsize == sum(data.dtype[name].itemsize for name in names):
        return data
    clean = np.zeros(data.shape, data.dtype)
    for name in names:
        clean[name] = data[name]
    return clean


def _raised(error: BaseException) -> _Raised:
    """Name the nearest class that a replay can raise, and what it said."""
    known = next(base for base in type(error).__mro__ if base.__module__ in {"builtins", "elpd.errors"})
    only = error.args[0] if len(error.args) == 1 else None
    return _Raised(known.__name__, only if isinstance(only, str) else str(error))


def digest(array: NDArray[Any]) -> dict[str, Any]:
    """Stand for an array in a question: equal digests are equal arrays."""
    data = np.ascontiguousarray(array)
    return {"sha256": hashlib.sha256(data.tobytes()).hexdigest(), "dtype": data.dtype.str, "shape": data.shape}
