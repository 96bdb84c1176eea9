"""From a camera to a file, until time is up, somebody interrupts, or there is no more room.

A camera's own words are written as they come, so nothing is decoded while it sends; its arrays go to a format that can
be read at any moment of its writing. A full disk is foreseen (some room is left for everybody else) and survived:
what was written before is whole. At the end the file is read back, which gives the counts and shows that it can be.
"""

from __future__ import annotations

import errno
import shutil
from enum import Enum
from typing import TYPE_CHECKING, Any

from elpd.errors import CameraError, UsageError
from elpd.events.stream import EventStream, open_recording
from elpd.record.convert import Conversion, Slice
from elpd.record.files import format_for, refuse_to_overwrite
from elpd.record.tally import Tally, losses
from elpd.records import Encoding
from elpd.units import NS_PER_S, HostNs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from elpd.ports import Clock, EventCamera, RecordingWriter
    from elpd.records import CameraPacket, Geometry

RESERVE_BYTES = 64 << 20
"""Room that a recording leaves on the disk: a run's journal and the calibration profiles must still fit."""

LOOK_EVERY_BYTES = 4 << 20
"""How much may be written between two looks at the disk; a small part of the reserve."""

READ_TIMEOUT_S = 0.1
NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
WORDS = {Encoding.EVT3: "evt3", Encoding.EVT2: "evt2", Encoding.EVT21: "evt2.1", Encoding.ARRAY: "aedat4"}
SUFFIXES = {Encoding.ARRAY: ".aedat4"}


class Ended(Enum):
    """Why a recording ended."""

    TIME = "time"
    INTERRUPTED = "interrupted"
    DISK_FULL = "disk_full"
    CAMERA_LOST = "camera_lost"


def record(
    camera: EventCamera,
    clock: Clock,
    out: Path,
    *,
    word: str | None = None,
    seconds: float | None = None,
    cancelled: Callable[[], bool] = lambda: False,
    facts: Mapping[str, str] | None = None,
    force: bool = False,
    reserve_bytes: int = RESERVE_BYTES,
) -> dict[str, Any]:
    """Record and return the fields of ``elpd record --json``.

    Parameters
    ----------
    camera : EventCamera
        Started here and stopped again.
    out : Path
        Where to write. Without a suffix (and *word*) it gets the one of the camera's own format.
    word : str, optional
        The format, as of ``--format``; else that of the suffix.
    seconds : float, optional
        For how long, on *clock*; else until *cancelled*.
    facts : mapping, optional
        What is known of the camera, for the header.
    reserve_bytes : int
        How much room to leave on the disk.

    Raises
    ------
    UsageError
        If *out* exists and *force* is not given, if the format cannot be cut short, or if there is no room to begin.
    CameraError
        If the camera cannot be started or sends nothing at all.
    """
    refuse_to_overwrite(out, force=force)
    _check_room(out, reserve_bytes)
    if word is not None or out.suffix:
        _check_format(out, word)  # a wrong one is told before the camera starts
    live = _Live(camera, clock, seconds, cancelled)
    began_ns = clock.now_ns()
    try:
        camera.start()
        first = live.first()
        if not out.suffix and word is None:
            out = out.with_suffix(SUFFIXES.get(first.encoding, ".raw"))
            word = WORDS[first.encoding]
            refuse_to_overwrite(out, force=force)
        elif word is None and out.suffix.lower() == ".raw":
            word = WORDS[first.encoding] if first.encoding is not Encoding.ARRAY else "evt3"
        writes, word = format_for(out, word)
        writer = writes.create(out, word, camera.geometry, facts or {})
        live.watch = _Room(out, reserve_bytes)
        error = _write_all(live, writer)
    finally:
        camera.stop()
    ended = live.ended if error is None else Ended.DISK_FULL
    took_s = (clock.now_ns() - began_ns) / NS_PER_S
    return {"out": str(out), "format": word, "seconds": round(took_s, 3)} | _answer(out, ended, live, writer.warnings)


class _Room:
    """Watches the disk while it fills."""

    def __init__(self, path: Path, reserve_bytes: int) -> None:
        self._folder = path.parent
        self._reserve_bytes = reserve_bytes
        self._unseen_bytes = 0

    def left(self, more_bytes: int) -> bool:
        """Say whether there is room beyond the reserve, after *more_bytes* were written."""
        self._unseen_bytes += more_bytes
        if self._unseen_bytes < LOOK_EVERY_BYTES:
            return True
        self._unseen_bytes = 0
        return shutil.disk_usage(self._folder).free >= self._reserve_bytes


class _Live:
    """A camera's packets as a reader's, until the recording is over.

    Attributes
    ----------
    ended : Ended
        Why there are no more.
    reason : str
        What the camera said, if it was lost.
    gaps, lost_events : int
        How many packets came after a gap, and how many events are known to be missing.
    """

    def __init__(self, camera: EventCamera, clock: Clock, seconds: float | None, cancelled: Callable[[], bool]) -> None:
        self._camera = camera
        self._clock = clock
        self._seconds = seconds
        self._cancelled = cancelled
        self._until_ns: HostNs | None = None
        self._first: CameraPacket | None = None
        self.watch: _Room | None = None
        self.ended = Ended.TIME
        self.reason = ""
        self.gaps = self.lost_events = 0
        self.notes: Mapping[str, Any] = {}

    @property
    def geometry(self) -> Geometry:
        """The sensor's size."""
        return self._camera.geometry

    @property
    def encoding(self) -> Encoding:
        """Of the camera's packets."""
        assert self._first is not None, "the first packet has come"
        return self._first.encoding

    def first(self) -> CameraPacket:
        """Return the first packet. Raises ``CameraError`` if there is none."""
        began_ns = self._clock.now_ns()
        if self._seconds is not None:
            self._until_ns = HostNs(began_ns + round(self._seconds * NS_PER_S))
        self._first = self._next()
        if self._first is None:
            if self.ended is Ended.CAMERA_LOST:
                raise CameraError(self.reason)
            waited_s = (self._clock.now_ns() - began_ns) / NS_PER_S
            raise CameraError(f"the camera sent nothing in {waited_s:.1f} s; nothing was written; see `elpd check`")
        return self._first

    def packets(self, max_bytes: int = 0) -> Iterator[CameraPacket]:
        """Yield the first packet and all that follow."""
        del max_bytes
        packet = self._first
        while packet is not None:
            self.gaps += packet.gap_before
            self.lost_events += packet.lost_events
            yield packet
            if self.watch is not None and not self.watch.left(_size(packet)):
                self.ended = Ended.DISK_FULL
                return
            packet = self._next()

    def close(self) -> None:
        """Leave the camera to whoever started it."""

    def _next(self) -> CameraPacket | None:
        """Return the next packet, ``None`` when the recording is over."""
        while True:
            if self._cancelled():
                self.ended = Ended.INTERRUPTED
                return None
            timeout_s = READ_TIMEOUT_S
            if self._until_ns is not None:
                left_s = (self._until_ns - self._clock.now_ns()) / NS_PER_S
                if left_s <= 0:
                    self.ended = Ended.TIME
                    return None
                timeout_s = min(timeout_s, left_s)
            try:
                packet = self._camera.read(timeout_s)
            except CameraError as error:
                self.ended, self.reason = Ended.CAMERA_LOST, str(error)
                return None
            if packet is not None:
                return packet


def _write_all(live: _Live, writer: RecordingWriter) -> OSError | None:
    """Write what comes until it ends; return the disk's error if it was full."""
    error: OSError | None = None
    try:
        if live.encoding is writer.traits.encoding:
            for packet in live.packets():
                writer.write(packet)
        else:
            Conversion(live, writer, Slice(), live.geometry).run()
    except OSError as full:
        if full.errno not in NO_ROOM:
            raise
        error = full
    finally:
        try:
            writer.close(complete=error is None and live.ended in {Ended.TIME, Ended.INTERRUPTED})
        except OSError as full:
            if full.errno not in NO_ROOM:
                raise
            error = full
    return error


def _check_format(out: Path, word: str | None) -> None:
    """Raise what ``format_for`` raises, and ``UsageError`` for a format that a full disk would leave unreadable."""
    writes, word = format_for(out, word)
    if not writes.appends(word):
        raise UsageError(
            f"{out.name}: {word} is only readable when it is finished, which a full disk would prevent; record to "
            ".raw, .aedat4, .npy or .csv, and `elpd convert` it"
        )


def _check_room(out: Path, reserve_bytes: int) -> None:
    free = shutil.disk_usage(out.parent).free
    if free < reserve_bytes + LOOK_EVERY_BYTES:
        raise UsageError(
            f"{out.parent}: {free >> 20} MiB are free, of which a recording leaves {reserve_bytes >> 20}; make room, "
            "or record to another disk with --out"
        )


def _size(packet: CameraPacket) -> int:
    """Return roughly how many bytes a packet takes in a file."""
    return int(packet.data.nbytes) + sum(frame.pixels.nbytes for frame in packet.frames)


def _answer(out: Path, ended: Ended, live: _Live, told: Sequence[str]) -> dict[str, Any]:
    """Read the file back and say what is in it, and how the recording went."""
    tally = Tally()
    reader = open_recording(out)
    try:
        stream = EventStream(reader)
        for chunk in stream.chunks():
            tally.add(chunk)
        lost, reasons = losses(reader.notes, stream.counters, stream.rate_controller)
        warnings = [*told, *tally.warnings(reader.notes, stream.counters)]
    finally:
        reader.close()
    if live.lost_events:
        reasons.append(f"the camera's driver lost {live.lost_events} events")
    if live.gaps:
        warnings.append(f"{live.gaps} gaps: the host did not keep up with the camera, or the line lost something")
    reason = {
        Ended.TIME: "",
        Ended.INTERRUPTED: "interrupted",
        Ended.DISK_FULL: f"the disk of {out.parent} is full, but for the reserve; make room",
        Ended.CAMERA_LOST: live.reason,
    }[ended]
    return {
        "width": live.geometry.width,
        "height": live.geometry.height,
        "ended": ended.value,
        "truncated": ended in {Ended.DISK_FULL, Ended.CAMERA_LOST},
        "reason": reason,
        "events": tally.events,
        "on": tally.on,
        "first_us": tally.first_us,
        "last_us": tally.last_us,
        "triggers": tally.triggers,
        "frames": tally.frames,
        "imu": tally.imu,
        "lost": lost + live.lost_events,
        "lost_reason": reasons,
        "warnings": warnings,
    }
