"""Prophesee RAW files: EVT2, EVT2.1 and EVT3 words behind a text header.

The header is lines ``% key value``; newer files close it with ``% end``, older ones just stop, so it ends at the
first line that does not look like one. The encoding and the sensor's size are stated there in several dialects, or
must be inferred from the sensor's name. The payload is handed on as it is: words, for kernels to read; only the
exchanged halves of "legacy" EVT2.1 are put right here.

A file that was cut in the middle of a word is read to the last whole one, and the loss is noted.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError
from elpd.events.evt2 import swap_halves
from elpd.events.registers import MAX_SIDE
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs
from elpd_drivers.formats import raw_write
from elpd_drivers.formats.raw_write import write_raw
from elpd_drivers.formats.text_header import read_header

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["FORMAT", "RawFormat", "RawReader", "write_raw"]

ENCODINGS = {
    "EVT3": Encoding.EVT3,
    "EVT2": Encoding.EVT2,
    "EVT21": Encoding.EVT21,
    "EVT2.1": Encoding.EVT21,
    "3.0": Encoding.EVT3,
    "2.0": Encoding.EVT2,
    "2.1": Encoding.EVT21,
}
NAMES = {Encoding.EVT3: "EVT3", Encoding.EVT2: "EVT2", Encoding.EVT21: "EVT2.1"}
WORDS: dict[Encoding, np.dtype[Any]] = {
    Encoding.EVT3: np.dtype("<u2"),
    Encoding.EVT2: np.dtype("<u4"),
    Encoding.EVT21: np.dtype("<u8"),
}

VGA, HD = Geometry(640, 480), Geometry(1280, 720)
BY_PLUGIN = (
    ("gen41", HD),
    ("gen4", HD),
    ("imx636", HD),
    ("gen31", VGA),
    ("gen3", VGA),
    ("genx320", Geometry(320, 320)),
)
BY_SYSTEM_ID = {"21": VGA, "48": HD, "49": HD}
BY_GENERATION = {"3.0": VGA, "3.1": VGA, "4.0": HD, "4.1": HD, "4.2": HD}


class RawFormat:
    """EVT2, EVT2.1 and EVT3 ``.raw`` files."""

    name = "RAW (EVT2, EVT2.1, EVT3)"

    def recognises(self, path: Path) -> bool:
        """Say whether the file begins with a header that names an EVT encoding."""
        header, _ = read_header(path)
        return "evt" in header or header.get("format", "").upper().startswith("EVT")

    def open(self, path: Path) -> RawReader:
        """Open for reading. Raises ``FormatError`` for an encoding that is not one of the three."""
        return RawReader(path)

    @property
    def writes(self) -> Mapping[str, str]:
        """The encodings, all in ``.raw``."""
        return dict.fromkeys(raw_write.WORDS, ".raw")

    def can_write(self, word: str) -> None:
        """Nothing beyond numpy is needed."""
        del word

    def appends(self, word: str) -> bool:
        """Say yes: words follow words."""
        del word
        return True

    def create(self, path: Path, word: str, geometry: Geometry, facts: Mapping[str, str]) -> raw_write.RawWriter:
        """Begin a file. Raises ``FormatError`` for a sensor whose addresses do not fit 11 bits."""
        return raw_write.RawWriter(path, word, geometry, facts)


FORMAT = RawFormat()


class RawReader:
    """An open RAW file. ``notes``: format, header, warnings, lost, lost_reason."""

    def __init__(self, path: Path) -> None:
        self._path = path
        header, self._offset = read_header(path)
        self._warnings: list[str] = []
        self._notes: dict[str, Any] = {"header": header, "warnings": self._warnings, "lost": 0, "lost_reason": []}
        self.encoding, options = _encoding_of(path, header)
        self._notes["format"] = NAMES[self.encoding]
        self._geometry = _geometry_of(header, options, self._warnings)
        if header.get("complete") == "no":
            self._warnings.append(
                "the recording was not finished: its disk was full, its camera lost, or its program stopped"
            )
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise FormatError(f"{path} cannot be read: {error.strerror}") from error
        self._swap = self.encoding is Encoding.EVT21 and self._halves_are_exchanged(options)

    @property
    def geometry(self) -> Geometry | None:
        """The sensor's size, from the header or the sensor's name; ``None`` where neither says it."""
        return self._geometry

    @property
    def notes(self) -> Mapping[str, Any]:
        """``format`` ("EVT3", "EVT2", "EVT2.1"), ``header``, ``warnings``, ``lost`` (words), ``lost_reason``."""
        return self._notes

    def packets(self, max_bytes: int = 1 << 20) -> Iterator[CameraPacket]:
        """Yield the words from the beginning of the payload, at most *max_bytes* at a time."""
        dtype = WORDS[self.encoding]
        buffer = np.empty(max(max_bytes // dtype.itemsize, 1), dtype)
        room = buffer.data.cast("B")
        self._notes["lost"], self._notes["lost_reason"] = 0, []
        self._file.seek(self._offset)
        held = 0
        while True:
            count = self._file.readinto(room[held:])
            if not count:
                break
            held += count
            whole = held // dtype.itemsize
            if whole:
                words = swap_halves(buffer[:whole]) if self._swap else buffer[:whole]
                yield CameraPacket(words, self.encoding, HostNs(0))
                rest = held - whole * dtype.itemsize
                room[:rest] = room[whole * dtype.itemsize : held]
                held = rest
        if held:
            self._notes["lost"] = 1
            self._notes["lost_reason"] = [
                f"the file ends in the middle of a word ({held} of {dtype.itemsize} bytes): it was cut short"
            ]

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def _halves_are_exchanged(self, options: Mapping[str, str]) -> bool:
        """Say whether EVT2.1 words are in the legacy order: as stated, else by which order makes time run on."""
        if "endianness" in options:
            return options["endianness"] == "legacy"
        self._file.seek(self._offset)
        sample = self._file.read(1 << 16)
        words = np.frombuffer(sample[: len(sample) // 8 * 8], "<u8")
        return _time_steps(swap_halves(words)) > _time_steps(words)


def _time_steps(words: NDArray[np.uint64]) -> int:
    """Count the TIME_HIGH words that follow their predecessor closely, as they do where words are read aright."""
    highs = (words[words >> np.uint64(60) == 0x8] >> np.uint64(32)).astype(np.int64)
    steps = np.diff(highs)
    return int(((steps >= 0) & (steps < 1000)).sum())


def _encoding_of(path: Path, header: Mapping[str, str]) -> tuple[Encoding, dict[str, str]]:
    """Return the encoding and the options behind it, from ``format EVT3;height=720;width=1280`` or ``evt 3.0``."""
    name, *parts = (part.strip() for part in header.get("format", "").split(";"))
    options = dict(part.partition("=")[::2] for part in parts)
    stated = name or header.get("evt", "")
    encoding = ENCODINGS.get(stated.upper())
    if encoding is None:
        raise FormatError(f"{path} is encoded as {stated!r}; this reader knows EVT2, EVT2.1 and EVT3")
    return encoding, {key.strip(): value.strip() for key, value in options.items()}


def _geometry_of(header: Mapping[str, str], options: Mapping[str, str], warnings: list[str]) -> Geometry | None:
    """Return the sensor's size from the most explicit statement there is."""
    stated = header.get("geometry", f"{options.get('width', '')}x{options.get('height', '')}")
    match = re.fullmatch(r"(\d{1,9})x(\d{1,9})", stated)
    if match:
        geometry = Geometry(int(match[1]), int(match[2]))
        if 0 < geometry.width <= MAX_SIDE and 0 < geometry.height <= MAX_SIDE:
            return geometry
        warnings.append(f"the header's geometry {stated} does not fit 11-bit addresses; ignored")
    plugin = header.get("plugin_name", "")
    for part, geometry in BY_PLUGIN:
        if part in plugin:
            return geometry
    return BY_SYSTEM_ID.get(header.get("system_id", "")) or BY_GENERATION.get(
        header.get("sensor_generation", header.get("generation", ""))
    )
