"""Pictures made of characters: a curve in braille, a lens on a line, a grey image in half blocks.

Pure functions from numbers to lines of text. Escape codes appear only where the caller allows colour, and every line
is as wide as promised, so that whoever owns the terminal can overwrite in place.
"""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

RESET = "\x1b[0m"
DIM = "\x1b[2m"
BOLD = "\x1b[1m"
GREEN = "\x1b[32m"
RED = "\x1b[31m"

_BRAILLE = 0x2800
_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))  # Unicode's dot numbers, by row and column
_RAMP = " .:-=+*#%@"


class Ink(Enum):
    """What a terminal can show."""

    PLAIN = "plain"  # no escape codes at all
    GREY = "grey"  # the 24 greys of the 256-colour palette
    TRUE = "true"  # 24 bit


def curve(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    size: tuple[int, int],
    x_range: tuple[float, float],
    *,
    colour: bool = False,
) -> list[str]:
    """Draw *y* over *x* as one connected line of braille dots, zero marked, the extremes of *y* labelled.

    Parameters
    ----------
    x, y
        Points in the order in which they were measured; those that are not finite are left out.
    size
        Columns (the label's ten among them) and rows.
    x_range
        What the plot spans horizontally.
    colour
        Whether escape codes are allowed.

    """
    columns, rows = size[0] - LABEL, size[1]
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    low, high = (min(float(y.min()), 0.0), max(float(y.max()), 0.0)) if y.size else (0.0, 0.0)
    if high - low <= 0.0:
        low, high = -1.0, 1.0
    pixel_x = _to_pixels(x, *x_range, 2 * columns)
    pixel_y = 4 * rows - 1 - _to_pixels(y, low, high, 4 * rows)
    cells = _cells(_raster(pixel_x, pixel_y, 2 * columns, 4 * rows))
    zero_row = (4 * rows - 1 - int(_to_pixels(np.zeros(1), low, high, 4 * rows)[0])) // 4
    lines = []
    for row in range(rows):
        blank = "─" if row == zero_row else " "
        text = "".join(blank if cell == 0 else chr(_BRAILLE + int(cell)) for cell in cells[row])
        label = {0: _label(high), rows - 1: _label(low)} | {zero_row: "0"}
        if colour:
            text = f"{(DIM if row == zero_row else GREEN if row < zero_row else RED)}{text}{RESET}"
        lines.append(f"{label.get(row, ''):>{LABEL - 2}s} │{text}")
    return lines


LABEL = 10
"""Columns that ``curve`` and ``lens_bar`` use for labels on the left."""


def lens_bar(marks: Mapping[str, float | None], columns: int, x_range: tuple[float, float]) -> list[str]:
    """Draw a line with a one-letter mark for each position, and the names of the marks below.

    *marks* maps a letter to a position, ``None`` where it is not known yet; later ones are drawn over earlier ones.
    """
    width = columns - LABEL
    line = ["─"] * width
    for letter, position in marks.items():
        if position is not None and np.isfinite(position):
            line[int(_to_pixels(np.array([position]), *x_range, width)[0])] = letter
    ends = f"{x_range[0]:.0f}", f"{x_range[1]:.0f} um"
    scale = f"{ends[0]}{ends[1]:>{max(1, width - len(ends[0]))}s}"
    return [f"{'lens':>{LABEL - 2}s} ├{''.join(line)}", f"{'':{LABEL}s}{scale}"[:columns]]


def picture(
    image: NDArray[Any],
    columns: int = 60,
    *,
    ink: Ink = Ink.PLAIN,
    limits: tuple[float, float] | None = None,
) -> str:
    """Draw a grey image: two pixels to a character in half blocks, or a ramp of ASCII characters.

    Parameters
    ----------
    image
        (height, width), any real type; not finite is black.
    columns
        Width in characters; the height follows from the image's shape.
    ink
        What the terminal can show.
    limits
        The values that become black and white; the 1st and 99th percentiles unless given. Pass the same to two
        pictures that are to be compared.

    """
    grey = to_grey(image, limits)
    height, width = grey.shape
    rows = max(1, round(columns * height / width / 2))
    if ink is Ink.PLAIN:
        small = cv2.resize(grey, (columns, rows), interpolation=cv2.INTER_AREA)
        steps = (small.astype(np.int64) * len(_RAMP)) // 256
        return "\n".join("".join(_RAMP[step] for step in line) for line in steps)
    small = cv2.resize(grey, (columns, 2 * rows), interpolation=cv2.INTER_AREA)
    return "\n".join(_half_blocks(small[2 * row], small[2 * row + 1], ink) for row in range(rows))


def side_by_side(left: str, right: str, titles: tuple[str, str], columns: int) -> str:
    """Put two pictures of *columns* characters beside each other, titled."""
    head = f"{titles[0]:{columns}s}  {titles[1]}"
    return "\n".join(
        [head, *(f"{one}  {other}" for one, other in zip(left.split("\n"), right.split("\n"), strict=False))]
    )


def save_png(path: Path, image: NDArray[Any], limits: tuple[float, float] | None = None) -> None:
    """Write a grey image as an 8-bit PNG. Raises ``OSError``."""
    path.write_bytes(cv2.imencode(".png", to_grey(image, limits))[1].tobytes())


def to_grey(image: NDArray[Any], limits: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """Map *limits* (1st and 99th percentile unless given) to 0 and 255."""
    values = np.asarray(image, dtype=np.float64)
    finite = values[np.isfinite(values)]
    if limits is None:
        limits = (float(np.percentile(finite, 1)), float(np.percentile(finite, 99))) if finite.size else (0.0, 1.0)
    span = max(limits[1] - limits[0], np.finfo(np.float64).tiny)
    scaled = np.clip((np.nan_to_num(values, nan=limits[0]) - limits[0]) / span, 0.0, 1.0)
    grey: NDArray[np.uint8] = np.round(scaled * 255.0).astype(np.uint8)
    return grey


def _half_blocks(upper: Sequence[int], lower: Sequence[int], ink: Ink) -> str:
    """Return one line: the upper pixel is the character's ink, the lower its ground."""
    parts = []
    before = (-1, -1)
    for top, bottom in zip(upper, lower, strict=True):
        levels = (
            (int(top), int(bottom)) if ink is Ink.TRUE else (232 + int(top) * 24 // 256, 232 + int(bottom) * 24 // 256)
        )
        if levels != before:
            form = "\x1b[38;2;{0};{0};{0};48;2;{1};{1};{1}m" if ink is Ink.TRUE else "\x1b[38;5;{0};48;5;{1}m"
            parts.append(form.format(*levels))
            before = levels
        parts.append("▀")
    return "".join(parts) + RESET


def _label(value: float) -> str:
    text = f"{value:.3g}"
    return text if len(text) <= LABEL - 2 else f"{value:.1g}"


def _to_pixels(values: NDArray[np.float64], low: float, high: float, count: int) -> NDArray[np.int64]:
    span = high - low if high > low else 1.0
    pixels: NDArray[np.int64] = np.clip(np.floor((values - low) / span * count), 0, count - 1).astype(np.int64)
    return pixels


def _raster(x: NDArray[np.int64], y: NDArray[np.int64], width: int, height: int) -> NDArray[np.bool_]:
    """Set every dot on the straight lines between consecutive points."""
    dots = np.zeros((height, width), dtype=np.bool_)
    dots[y, x] = True
    if x.size > 1:
        dx, dy = np.diff(x), np.diff(y)
        steps = np.maximum(np.abs(dx), np.abs(dy))
        segment = np.repeat(np.arange(steps.size), steps)
        along = (np.arange(segment.size) - np.repeat(np.cumsum(steps) - steps, steps)) / steps[segment]
        dots[
            np.round(y[:-1][segment] + along * dy[segment]).astype(np.int64),
            np.round(x[:-1][segment] + along * dx[segment]).astype(np.int64),
        ] = True
    return dots


def _cells(dots: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Gather 4 x 2 dots into one braille character's number."""
    cells = np.zeros((dots.shape[0] // 4, dots.shape[1] // 2), dtype=np.int64)
    for row, pair in enumerate(_DOTS):
        for column, bit in enumerate(pair):
            cells += dots[row::4, column::2] * bit
    return cells
