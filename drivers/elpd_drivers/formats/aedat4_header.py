"""What stands before the packets of an AEDAT4 file, and how packets are unpacked.

A line with the version, a FlatBuffer that says the compression and where the table of contents is, and in it the
streams' description in DV's XML.
"""

from __future__ import annotations

import importlib
import struct
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.etree import ElementTree as ET

from elpd.errors import FormatError
from elpd.records import Geometry
from elpd_drivers.formats import flat

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

MAGIC = b"#!AER-DAT4.0\r\n"
COMPRESSIONS = {0: None, 1: "lz4", 2: "lz4", 3: "zstandard", 4: "zstandard"}
MAX_HEADER_BYTES = 1 << 24
MAX_PACKET_BYTES = 1 << 28
PIECE_BYTES = 1 << 18
MOST = MAX_PACKET_BYTES // PIECE_BYTES


class Header(NamedTuple):
    """What stands before the packets."""

    compression: int
    table_at: int
    streams: dict[int, tuple[str, Geometry | None]]
    source: str
    size: int


def read_header(path: Path, file: Any) -> Header:
    """Read up to the first packet."""
    start = file.read(len(MAGIC) + 4)
    size = struct.unpack("<I", start[-4:])[0] if len(start) == len(MAGIC) + 4 else 0
    if not 8 <= size <= MAX_HEADER_BYTES:
        raise FormatError(f"{path}: its header says that it has {size} bytes; the file is damaged or cut short")
    data = start[-4:] + file.read(size)
    if len(data) < size + 4:
        raise FormatError(f"{path}: the file ends within its header ({len(data)} of {size + 4} bytes)")
    try:
        table = flat.root(data, b"IOHE")
        compression, table_at = table.scalar(0, "i", 0), table.scalar(1, "q", -1)
        at, count = table.vector(2, 1)
        streams, source = _streams(data[at : at + count])
    except FormatError as error:
        raise FormatError(f"{path}: its header is damaged: {error}") from error
    if not streams:
        raise FormatError(f"{path}: its header describes no streams")
    return Header(compression, table_at, streams, source, len(MAGIC) + 4 + size)


def _streams(text: bytes) -> tuple[dict[int, tuple[str, Geometry | None]], str]:
    """Read the description: each stream's kind and size by its number, and the camera's name."""
    try:
        description = ET.fromstring(text.rstrip(b"\0 \r\n"))  # noqa: S314  (expat bounds what entities may blow up to)
    except ET.ParseError as error:
        raise FormatError(f"the description of its streams is not XML: {error}") from error
    streams: dict[int, tuple[str, Geometry | None]] = {}
    source = ""
    for node in description.findall("./node[@name='outInfo']/node"):
        values = {one.get("key"): (one.text or "").strip() for one in node.iter("attr")}
        name = node.get("name", "")
        if not name.isdecimal():
            continue
        width, height = values.get("sizeX", ""), values.get("sizeY", "")
        size = None
        if width.isdecimal() and height.isdecimal() and 0 < int(width) < 1 << 15 and 0 < int(height) < 1 << 15:
            size = Geometry(int(width), int(height))
        streams[int(name)] = (values.get("typeIdentifier", ""), size)
        source = source or values.get("source", "")
    return streams, source


def decompressor(path: Path, compression: int) -> Callable[[bytes], bytes]:
    """Return what undoes a packet's compression. Raises ``FormatError`` if it is not known here."""
    if compression not in COMPRESSIONS:
        raise FormatError(f"{path}: compression {compression} is not known (0 to 4 are)")
    package = COMPRESSIONS[compression]
    if package is None:
        return lambda data: data
    try:
        module = importlib.import_module("lz4.frame" if package == "lz4" else package)
    except ImportError as error:
        raise FormatError(f"{path} is compressed; to read it: pip install {package}") from error

    def unpacked(data: bytes) -> bytes:
        try:
            return b"".join(islice(_lz4_pieces(module, data) if package == "lz4" else _zstd_pieces(module, data), MOST))
        except (RuntimeError, ValueError, EOFError, MemoryError, getattr(module, "ZstdError", RuntimeError)) as error:
            raise FormatError(f"a packet cannot be unpacked: {error}") from error

    return unpacked


def _lz4_pieces(module: Any, data: bytes) -> Iterator[bytes]:
    """Yield a frame's content piece by piece: room is made for as much as is asked for."""
    frame = module.LZ4FrameDecompressor()
    piece = frame.decompress(data, max_length=PIECE_BYTES)
    while piece:
        yield piece
        piece = b"" if frame.eof else frame.decompress(b"", max_length=PIECE_BYTES)


def _zstd_pieces(module: Any, data: bytes) -> Iterator[bytes]:
    with module.ZstdDecompressor().stream_reader(data) as stream:
        yield from iter(lambda: stream.read(PIECE_BYTES), b"")
