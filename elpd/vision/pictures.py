"""Pictures in and out: 16-bit log pictures that remember their scale, and 8-bit ones for eyes.

A PNG holds integers; an HDR picture is a log intensity. The 16-bit file spans the picture's own range, so it is
monotone in log intensity and never clips, and a PNG text chunk (``elpd-log-intensity``: offset and step) tells how to
get the numbers back. A picture without that chunk is taken for what most pictures are: linear or display grey.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from elpd.errors import FormatError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

KEYWORD = b"elpd-log-intensity"
SIGNATURE = b"\x89PNG\r\n\x1a\n"
IHDR_END = 33
"""Signature (8) and the header chunk (4 length, 4 type, 13 data, 4 check sum)."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture from a file: (height, width), float32 natural log intensity or 8/16-bit grey."""

    pixels: NDArray[Any]
    is_log: bool


def write_log_png(path: Path, log_intensity: NDArray[np.float32]) -> None:
    """Write a 16-bit grey PNG, monotone in log intensity, that ``read_picture`` restores to within half a step.

    Raises
    ------
    UsageError
        If the file cannot be written.
    """
    low, high = float(log_intensity.min()), float(log_intensity.max())
    step = (high - low) / 65535 or 1.0
    grey = np.rint((log_intensity.astype(np.float64) - low) / step).astype(np.uint16)
    encoded = _encode(grey)
    text = KEYWORD + b"\0" + f"{low!r} {step!r}".encode("ascii")
    chunk = struct.pack(">I", len(text)) + b"tEXt" + text + struct.pack(">I", zlib.crc32(b"tEXt" + text))
    _write(path, encoded[:IHDR_END] + chunk + encoded[IHDR_END:])


def write_display_png(path: Path, log_intensity: NDArray[np.float32], valid: NDArray[np.bool_] | None = None) -> None:
    """Write an 8-bit PNG for eyes. Raises ``UsageError`` if the file cannot be written."""
    _write(path, _encode(display(log_intensity, valid)))


def display(log_intensity: NDArray[np.float32], valid: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """Tone-map for eyes: the 1st to the 99th percentile of valid log intensity onto 0..255, clipped beyond."""
    low, high = np.percentile(log_intensity if valid is None else log_intensity[valid], [1, 99])
    scaled = (log_intensity - low) * (255.0 / max(high - low, 1e-6))
    grey: NDArray[np.uint8] = np.rint(np.clip(scaled, 0, 255)).astype(np.uint8)
    return grey


def read_picture(path: Path) -> Picture:
    """Read a grey picture of any common format; colour becomes grey.

    Raises
    ------
    UsageError
        If there is no such file.
    FormatError
        If it is no picture.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror})") from None
    pixels = decode_grey(data, path)
    scale = _log_scale(data)
    if scale is None:
        return Picture(pixels, is_log=False)
    low, step = scale
    return Picture((pixels * step + low).astype(np.float32), is_log=True)


def decode_grey(data: bytes, path: Path) -> NDArray[Any]:
    """Decode an encoded image to grey of 8 or 16 bit. Raises ``FormatError``, naming *path*, if it is none."""
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if pixels is None:
        raise FormatError(f"{path}: {len(data)} bytes that are no image: not a picture of PNG, JPEG, TIFF or PGM")
    return np.asarray(pixels)


def _log_scale(data: bytes) -> tuple[float, float] | None:
    """Find the scale that ``write_log_png`` left behind its header chunk."""
    start = IHDR_END + 8
    if not data.startswith(SIGNATURE) or data[IHDR_END + 4 : start + len(KEYWORD)] != b"tEXt" + KEYWORD:
        return None
    (length,) = struct.unpack(">I", data[IHDR_END : IHDR_END + 4])
    try:
        low, step = (float(word) for word in data[start + len(KEYWORD) + 1 : start + length].split())
    except ValueError:
        return None
    return low, step


def _encode(grey: NDArray[Any]) -> bytes:
    _, encoded = cv2.imencode(".png", grey, [cv2.IMWRITE_PNG_COMPRESSION, 6])
    return encoded.tobytes()


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None
