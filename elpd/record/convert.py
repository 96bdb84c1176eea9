"""From one event file to another, or to a slice of one: streaming, in bounded memory.

Words that the new file can hold as they are stay as they are; everything else is decoded and encoded anew. What the
new format cannot hold (frames, trigger edges, a camera's own counters) is named, never dropped in silence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import UsageError
from elpd.events.epoch import EPOCH_STEP_US
from elpd.events.layout import packed
from elpd.events.stream import EventChunk, EventStream, open_recording
from elpd.record.files import appearing_whole, format_for, refuse_to_overwrite
from elpd.record.tally import Tally, losses
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs, SensorUs

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.ports import RecordingReader, RecordingWriter, WriterTraits
    from elpd.records import Roi

US_PER_S = 1_000_000


@dataclass(frozen=True, slots=True)
class Slice:
    """Which events to keep: those of a region, and of ``[from_us, to_us)`` of the sensor's clock."""

    roi: Roi | None = None
    from_us: int | None = None
    to_us: int | None = None

    @property
    def whole(self) -> bool:
        """Whether everything is kept."""
        return self.roi is None and self.from_us is None and self.to_us is None

    def past(self, chunk: EventChunk) -> bool:
        """Say whether nothing of this epoch can follow that is kept."""
        return self.to_us is not None and chunk.t.size > 0 and int(chunk.t.min()) >= self.to_us + EPOCH_STEP_US

    def of(self, chunk: EventChunk) -> EventChunk:
        """Return what is kept of a chunk."""
        if self.whole:
            return chunk
        keep = np.ones(chunk.t.size, np.bool_)
        if self.from_us is not None:
            keep &= chunk.t >= self.from_us
        if self.to_us is not None:
            keep &= chunk.t < self.to_us
        if self.roi is not None:
            roi = self.roi
            keep &= (chunk.x >= roi.x) & (chunk.x < roi.x + roi.width)
            keep &= (chunk.y >= roi.y) & (chunk.y < roi.y + roi.height)
        return EventChunk(
            chunk.t[keep],
            chunk.x[keep],
            chunk.y[keep],
            chunk.p[keep],
            tuple(edge for edge in chunk.triggers if self._at(edge.t_us)),
            tuple(frame for frame in chunk.frames if self._at(frame.t_us)),
            tuple(one for one in chunk.imu if self._at(one.t_us)),
        )

    def _at(self, t_us: int) -> bool:
        return (self.from_us is None or t_us >= self.from_us) and (self.to_us is None or t_us < self.to_us)


def convert(
    source: Path,
    out: Path,
    *,
    word: str | None = None,
    part: Slice | None = None,
    geometry: Geometry | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Write *source* anew as *out* and return the fields of ``elpd convert --json``.

    Parameters
    ----------
    source : Path
        Any event file that an installed format reads.
    out : Path
        Appears when it is whole. Its suffix says the format, unless *word* (as of ``--format``) does.
    part : Slice, optional
        What to keep; everything unless given. Events keep their addresses and times.
    geometry : Geometry, optional
        The sensor's size, instead of what the file says or, where it does not, what its events need.

    Raises
    ------
    UsageError
        If *out* exists and *force* is not given, or the slice makes no sense.
    FormatError
        If *source* cannot be read, or *out* cannot hold what is in it.
    """
    part = part or Slice()
    writes, word = format_for(out, word)
    refuse_to_overwrite(out, force=force)
    if out.exists() and source.exists() and out.samefile(source):
        raise UsageError(f"{source} and {out} are the same file; give another name for the new one")
    reader = open_recording(source)
    try:
        warnings = []
        size = geometry or reader.geometry
        if size is None:
            size = _extent(reader)
            warnings.append(f"the size {size.width}x{size.height} is what the events need; --size says the true one")
        _check(part, size)
        with appearing_whole(out, force=force) as partial:
            writer = writes.create(partial, word, size, dict(reader.notes.get("header", {})))
            try:
                answer = Conversion(reader, writer, part, size).run()
            finally:
                writer.close()
    except OSError as error:
        raise UsageError(f"{out} was not written: {error.strerror or error}") from error
    finally:
        reader.close()
    return {
        "out": str(out),
        "format": word,
        "width": size.width,
        "height": size.height,
        **answer,
        "warnings": warnings + answer["warnings"],
    }


class Conversion:
    """One pass from a reader to a writer."""

    def __init__(self, reader: RecordingReader, writer: RecordingWriter, part: Slice, geometry: Geometry) -> None:
        self._reader = reader
        self._writer = writer
        self._part = part
        self._stream = EventStream(reader, geometry)
        self._shift_us: int | None = None

    def run(self) -> dict[str, Any]:
        """Convert; return the counts."""
        read, written = Tally(), Tally()
        traits = self._writer.traits
        as_they_are = self._part.whole
        cut_off = False
        for chunk in self._stream.chunks():
            read.add(chunk)
            packet = self._stream.packet
            assert packet is not None, "a chunk is made of one"
            if self._part.past(chunk):
                cut_off = True
                break
            as_they_are = self._part.whole and packet.encoding is traits.encoding
            kept = chunk if as_they_are else self._shifted(self._part.of(chunk), traits)
            if as_they_are:
                self._writer.write(replace(packet, triggers=(), frames=(), imu=()))
            elif kept.t.size or kept.triggers or kept.frames or kept.imu:
                data = packed(kept.t, kept.x, kept.y, kept.p)
                self._writer.write(
                    CameraPacket(
                        data, Encoding.ARRAY, HostNs(0), triggers=kept.triggers, frames=kept.frames, imu=kept.imu
                    )
                )
            written.add(kept)
        lost, reasons = losses(self._reader.notes, self._stream.counters, self._stream.rate_controller)
        warnings = [] if cut_off else read.warnings(self._reader.notes, self._stream.counters)
        if read.events and not written.events:
            warnings.append("nothing of the recording is in this part")
        warnings += self._left_out(written, traits, as_they_are=as_they_are)
        return {
            "events": written.events,
            "on": written.on,
            "first_us": written.first_us,
            "last_us": written.last_us,
            "triggers": written.triggers if traits.triggers else 0,
            "frames": written.frames if traits.frames else 0,
            "imu": written.imu if traits.imu else 0,
            "shift_us": self._shift_us or 0,
            "lost": lost,
            "lost_reason": reasons,
            "warnings": warnings + list(self._writer.warnings),
        }

    def _left_out(self, written: Tally, traits: WriterTraits, *, as_they_are: bool) -> list[str]:
        """Name what was read and could not be written."""
        left = []
        if written.triggers and not traits.triggers:
            left.append(f"{written.triggers} trigger edges")
        if written.frames and not traits.frames:
            left.append(f"{written.frames} frames")
        if written.imu and not traits.imu:
            left.append(f"{written.imu} IMU samples")
        if not as_they_are and self._stream.rate_controller is not None:
            left.append("the rate controller's counts")
        if not as_they_are and self._stream.counters.get("others"):
            left.append(f"{self._stream.counters['others']} words of the camera about itself")
        found = [f"not carried over: {', '.join(left)}"] if left else []
        if self._shift_us:
            found.append(f"{self._shift_us} us were subtracted from all times, which the format could not hold")
        return found

    def _shifted(self, chunk: EventChunk, traits: WriterTraits) -> EventChunk:
        """Bring times into what the new format can say, by whole seconds, where they are not."""
        if traits.first_limit_us is None:
            return chunk
        if self._shift_us is None:
            times = [int(chunk.t.min())] if chunk.t.size else []
            times += [int(edge.t_us) for edge in chunk.triggers]
            if not times:
                return chunk
            earliest = min(times)
            # A second to spare: trigger edges of a file need not come in step with its events.
            beyond = not 0 <= earliest <= traits.first_limit_us
            self._shift_us = (earliest // US_PER_S - 1) * US_PER_S if beyond else 0
        if self._shift_us == 0:
            return chunk
        triggers = tuple(replace(edge, t_us=SensorUs(edge.t_us - self._shift_us)) for edge in chunk.triggers)
        return chunk._replace(t=chunk.t - self._shift_us, triggers=triggers)


def _check(part: Slice, geometry: Geometry) -> None:
    if part.roi is not None and not part.roi.fits(geometry):
        raise UsageError(f"--roi {part.roi} does not fit the sensor of {geometry.width}x{geometry.height} pixels")
    if part.from_us is not None and part.to_us is not None and part.to_us <= part.from_us:
        raise UsageError(f"--to-us must be later than --from-us; got {part.from_us} and {part.to_us}")


def _extent(reader: RecordingReader) -> Geometry:
    """Return the smallest sensor that holds every event: a pass of its own."""
    width = height = 1
    for chunk in EventStream(reader).chunks():
        width = max(width, int(chunk.x.max(initial=0)) + 1)
        height = max(height, int(chunk.y.max(initial=0)) + 1)
    return Geometry(width, height)
