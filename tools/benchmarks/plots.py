"""Line plots as inline SVG: enough for a report that must be one file and needs no plotting library to be made.

A plot is a list of series over linear or logarithmic x. Text is real text, so the page can be searched and read aloud;
colours are distinguishable without seeing colour well (Okabe and Ito 2008), and each line is also dashed in its own
way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
DASHES = ("", "7 3", "2 3", "9 3 2 3", "5 5", "1 2", "12 4", "3 6")
WIDTH, HEIGHT = 560, 300
LEFT, RIGHT, TOP, BOTTOM = 58, 12, 26, 44


@dataclass(frozen=True, slots=True)
class Series:
    """A line: a label for the legend and its points."""

    label: str
    x: Sequence[float]
    y: Sequence[float]


@dataclass(frozen=True, slots=True)
class Plot:
    """What a line plot is made of. ``marks`` are vertical lines: (x, label). Empty ranges are found from the data."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    log_x: bool = False
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    marks: Sequence[tuple[float, str]] = ()


def draw(plot: Plot) -> str:
    """Return the plot as an ``<svg>`` element; a line of text where there is nothing to draw."""
    drawn = [series for series in plot.series if len(series.x)]
    if not drawn:
        return f"<p>{escape(plot.title)}: nothing to draw.</p>"
    x_range = plot.x_range or _extent([value for series in drawn for value in series.x])
    y_range = plot.y_range or _extent([value for series in drawn for value in series.y])
    frame = _Frame(x_range, y_range, plot.log_x)
    legend_rows = -(-len(drawn) // 3)
    height = HEIGHT + 18 * legend_rows
    size = f'viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}"'
    parts = [
        f'<svg {size} role="img" aria-label="{escape(plot.title, quote=True)}">',
        f'<text x="{LEFT}" y="16" class="title">{escape(plot.title)}</text>',
        *_axes(frame, plot),
    ]
    for number, (x, label) in enumerate(plot.marks):
        at = frame.x(x)
        parts.append(f'<line class="mark" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
        parts.append(f'<text class="small" x="{at + 3:.1f}" y="{TOP + 12 + 13 * number}">{escape(label)}</text>')
    for number, series in enumerate(drawn):
        points = " ".join(f"{frame.x(x):.1f},{frame.y(y):.1f}" for x, y in zip(series.x, series.y, strict=True))
        style = f'stroke="{COLOURS[number % 8]}" stroke-dasharray="{DASHES[number % 8]}"'
        parts.append(f'<polyline fill="none" stroke-width="1.5" {style} points="{points}"/>')
        column, row = number % 3, number // 3
        x, y = LEFT + 166 * column, HEIGHT + 8 + 18 * row
        parts.append(f'<line x1="{x}" x2="{x + 26}" y1="{y - 4}" y2="{y - 4}" stroke-width="2" {style}/>')
        parts.append(f'<text class="small" x="{x + 31}" y="{y}">{escape(series.label)}</text>')
    parts.append("</svg>")
    return "".join(parts)


@dataclass(frozen=True, slots=True)
class _Frame:
    """From data to the page."""

    x_range: tuple[float, float]
    y_range: tuple[float, float]
    log_x: bool

    def x(self, value: float) -> float:
        low, high = self.x_range
        value = min(max(value, low), high)
        share = math.log(value / low) / math.log(high / low) if self.log_x else (value - low) / (high - low)
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def y(self, value: float) -> float:
        low, high = self.y_range
        return HEIGHT - BOTTOM - (min(max(value, low), high) - low) / (high - low) * (HEIGHT - BOTTOM - TOP)


def _axes(frame: _Frame, plot: Plot) -> list[str]:
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    parts = [f'<rect class="frame" x="{LEFT}" y="{TOP}" width="{right - LEFT}" height="{bottom - TOP}"/>']
    for tick in _log_ticks(frame.x_range) if frame.log_x else _ticks(frame.x_range):
        at = frame.x(tick)
        parts.append(f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{bottom}"/>')
        parts.append(f'<text class="small" text-anchor="middle" x="{at:.1f}" y="{bottom + 14}">{tick:g}</text>')
    for tick in _ticks(frame.y_range):
        at = frame.y(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text class="small" text-anchor="end" x="{LEFT - 5}" y="{at + 4:.1f}">{tick:g}</text>')
    middle = 0.5 * (TOP + bottom)
    parts.append(f'<text class="small" text-anchor="middle" x="{0.5 * (LEFT + right)}" y="{bottom + 31}">')
    parts.append(f"{escape(plot.x_label)}</text>")
    parts.append(f'<text class="small" text-anchor="middle" transform="translate(13 {middle}) rotate(-90)">')
    parts.append(f"{escape(plot.y_label)}</text>")
    return parts


def _extent(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    return (low, high) if high > low else (low - 1.0, high + 1.0)


def _ticks(extent: tuple[float, float]) -> list[float]:
    """Return about five round numbers inside *extent*."""
    rough = (extent[1] - extent[0]) / 5.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(one * power for one in (1.0, 2.0, 5.0, 10.0) if one * power >= rough)
    first = math.ceil(extent[0] / step)
    return [round(k * step, 12) for k in range(first, math.floor(extent[1] / step) + 1)]


def _log_ticks(extent: tuple[float, float]) -> list[float]:
    """Return the powers of ten inside *extent*, with 2 and 5 between them where there is room."""
    decades = range(math.floor(math.log10(extent[0])), math.ceil(math.log10(extent[1])) + 1)
    return [m * 10.0**k for k in decades for m in (1.0, 2.0, 5.0) if extent[0] <= m * 10.0**k <= extent[1] * 1.0001]
