"""Writing Prophesee RAW files: words as they came from a camera, or events encoded anew.

Words of the file's own encoding are written as they are, so that nothing a camera said is lost (its rate counters,
words that nobody knows). Arrays are encoded, trigger edges at their time among the events.

The header says ``complete no`` until the file is finished, so that a recording which ended with its disk or its
process can be told from a whole one.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError, UsageError
from elpd.events.evt2 import swap_halves
from elpd.events.evt2_encode import Evt2Encoder, Evt21Encoder
from elpd.events.evt3_encode import Evt3Encoder
from elpd.events.registers import check_geometry
from elpd.ports import WriterTraits
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs
from elpd_drivers.formats.output import Output, columns_inside

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

WORDS: dict[str, tuple[Encoding, str, dict[str, str]]] = {
    "evt3": (Encoding.EVT3, "EVT3", {"evt": "3.0"}),
    "evt2": (Encoding.EVT2, "EVT2", {"evt": "2.0"}),
    "evt2.1": (Encoding.EVT21, "EVT21;endianness=little", {"evt": "2.1", "endianness": "little"}),
    "evt2.1-legacy": (Encoding.EVT21, "EVT21;endianness=legacy", {"evt": "2.1", "endianness": "legacy"}),
}
"""What each word of ``--format`` writes: encoding, ``format`` line, and lines for older readers."""

FIRST_LIMIT_US = 43_200_000_000
"""Half a day: a decoder's turns of the clock are bridged for a day at most (``Evt3Encoder``)."""

NOT_OURS = {"evt", "format", "geometry", "endianness", "complete", "end", "width", "height", "data", "version"}
KEY = re.compile(r"[A-Za-z][\w.-]*", re.ASCII)
UNFINISHED, FINISHED = b"no ", b"yes"


def header_text(word: str, geometry: Geometry, facts: Mapping[str, str]) -> str:
    """Return the header of a file in *word*, unfinished, but for its ``% end``."""
    _, format_line, older = WORDS[word]
    lines = {
        **{key: value for key, value in facts.items() if KEY.fullmatch(key) and key.lower() not in NOT_OURS},
        **older,
        "format": f"{format_line};height={geometry.height};width={geometry.width}",
        "geometry": f"{geometry.width}x{geometry.height}",
    }
    # A line feed in a serial number would end the line, and what follows would be read as payload.
    return "".join(f"% {key} {' '.join(str(value).split())}\n" for key, value in lines.items())


class RawWriter:
    """A RAW file being written."""

    def __init__(self, path: Path, word: str, geometry: Geometry, facts: Mapping[str, str]) -> None:
        try:
            check_geometry(geometry)
        except UsageError as error:
            raise FormatError(f"{path}: {error}") from error
        self._geometry = geometry
        self._encoding = WORDS[word][0]
        self._swap = word == "evt2.1-legacy"
        self._encoder: Evt3Encoder | Evt2Encoder | Evt21Encoder
        if self._encoding is Encoding.EVT3:
            self._encoder = Evt3Encoder(geometry.width)
        else:
            self._encoder = Evt2Encoder() if self._encoding is Encoding.EVT2 else Evt21Encoder()
        self._as_they_were: bool | None = None
        self._last_us: int | None = None
        self._output = Output(path)
        header = header_text(word, geometry, facts) + "% complete "
        self._mark_at = len(header.encode())
        self._output.append(header.encode() + UNFINISHED + b"\n% end\n")

    @property
    def traits(self) -> WriterTraits:
        """Words of its own encoding, or arrays; trigger edges."""
        return WriterTraits(encoding=self._encoding, triggers=True, first_limit_us=FIRST_LIMIT_US)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Nothing is written in another way than it came."""
        return ()

    def write(self, packet: CameraPacket) -> None:
        """Append words or events; a file holds one or the other. See ``RecordingWriter.write``."""
        words = packet.encoding is self._encoding
        if not words and packet.encoding is not Encoding.ARRAY:
            raise FormatError(f"this file holds {self._encoding.value} words; got {packet.encoding.value}")
        if self._as_they_were not in {None, words}:
            raise FormatError("a file holds words as they came or events encoded anew, not both")
        self._as_they_were = words
        if words:
            self._append(packet.data)  # its edges are among the words
            return
        try:
            pieces = [piece.copy() for piece in self._encoded(packet)]
        except UsageError as error:
            raise FormatError(str(error)) from error
        self._append(*pieces)

    def close(self, *, complete: bool = True) -> None:
        """Finish. Idempotent."""
        if self._output.closed:
            return
        if complete:
            self._output.patch(self._mark_at, FINISHED)
        self._output.close()

    def _append(self, *pieces: NDArray[Any]) -> None:
        if self._swap:
            pieces = tuple(swap_halves(piece) for piece in pieces)
        self._output.append(*(np.ascontiguousarray(piece, piece.dtype.newbyteorder("<")) for piece in pieces))

    def _encoded(self, packet: CameraPacket) -> Iterator[NDArray[Any]]:
        """Yield words for the events, each edge before the first event that is later."""
        columns = columns_inside(packet, self._geometry)
        t = columns[0]
        begin = 0
        for edge in sorted(packet.triggers, key=lambda edge: edge.t_us):
            after = np.flatnonzero(t[begin:] > edge.t_us)
            until = begin + int(after[0]) if after.size else t.size
            yield self._events(*(column[begin:until] for column in columns))
            self._check_steps(np.array([edge.t_us], np.int64))
            yield self._encoder.encode_trigger(int(edge.t_us), edge.id, rising=edge.rising)
            begin = until
        yield self._events(*(column[begin:] for column in columns))

    def _events(self, *columns: NDArray[Any]) -> NDArray[Any]:
        self._check_steps(columns[0])
        return self._encoder.encode(*columns)

    def _check_steps(self, t: NDArray[np.int64]) -> None:
        """Refuse steps back that an EVT3 decoder would take for a turn of its 24-bit clock."""
        if self._encoding is not Encoding.EVT3 or t.size == 0:
            return
        times = t if self._last_us is None else np.concatenate(([self._last_us], t))
        self._last_us = int(t[-1])
        high = times >> 12
        steps = np.diff(high)
        turned = (steps < 0) & ((steps <= -2048) | (high[1:] >> 12 != high[:-1] >> 12))
        if turned.any():
            at = int(np.argmax(turned))
            raise FormatError(
                f"time steps back from {times[at]} to {times[at + 1]} us, which EVT3 cannot say (its clock turns over "
                "every 16.8 s); write a format with whole times (npz, csv, hdf5)"
            )


def write_raw(path: Path, geometry: Geometry, words: Iterable[NDArray[np.uint16]], header: Mapping[str, str]) -> int:
    """Write EVT3 words to a RAW file that other software reads; return the number of bytes.

    Parameters
    ----------
    path : Path
        Overwritten.
    geometry : Geometry
        The sensor's size.
    words : iterable of uint16 arrays
        The payload, piece by piece.
    header : mapping
        Further lines, such as ``{"serial_number": "00050567"}``.
    """
    writer = RawWriter(path, "evt3", geometry, header)
    for piece in words:
        writer.write(CameraPacket(piece, Encoding.EVT3, HostNs(0)))
    writer.close()
    return path.stat().st_size
