"""Plots as SVG text: axes with round numbers, lines, dots, uprights. Styled by classes, so that a page's colours rule.

A plot knows its data's range when it is made; whatever is drawn outside is cut by the frame.
"""

from __future__ import annotations

import math
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

LEFT, RIGHT, TOP, BOTTOM = 62.0, 18.0, 22.0, 34.0
"""Room around the frame, in SVG units."""


class SvgPlot:
    """One frame with two linear axes.

    Parameters
    ----------
    title
        What a reader who does not see it is told.
    x_range, y_range
        What the frame spans; made a little wider, and never empty.
    labels
        Of the two axes.
    size
        Width and height in SVG units.

    """

    def __init__(
        self,
        title: str,
        x_range: tuple[float, float],
        y_range: tuple[float, float],
        labels: tuple[str, str],
        size: tuple[float, float] = (900.0, 300.0),
    ) -> None:
        self._title = title
        self._x, self._y = _wider(x_range), _wider(y_range)
        self._labels = labels
        self._size = size
        self._parts: list[str] = []
        self._above: list[str] = []

    def line(self, points: Iterable[tuple[float, float]], name: str) -> None:
        """Draw a line through *points*, with a class."""
        text = " ".join(f"{self._at_x(x):.1f},{self._at_y(y):.1f}" for x, y in points)
        self._parts.append(f'<polyline class="{name}" points="{text}"/>')

    def dots(self, points: Iterable[tuple[float, float]], name: str) -> None:
        """Draw dots: one path of lines without length, whose round ends are what is seen."""
        text = "".join(f"M{self._at_x(x):.1f} {self._at_y(y):.1f}h0" for x, y in points)
        self._parts.append(f'<path class="{name}" d="{text}"/>')

    def bars(self, spans: Iterable[tuple[float, float, float]], name: str) -> None:
        """Draw (from, to, height) from zero upwards."""
        zero = self._at_y(0.0)
        text = "".join(
            f"M{self._at_x(a):.1f} {zero:.1f}V{self._at_y(height):.1f}H{self._at_x(b):.1f}V{zero:.1f}Z"
            for a, b, height in spans
        )
        self._parts.append(f'<path class="{name}" d="{text}"/>')

    def upright(self, x: float, name: str, label: str = "", *, low: bool = False) -> None:
        """Draw a vertical line, with words above the frame, or (*low*) at its foot."""
        if not self._x[0] <= x <= self._x[1]:
            return
        at = self._at_x(x)
        bottom = self._size[1] - BOTTOM
        self._parts.append(f'<line class="{name}" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{bottom}"/>')
        if label:
            anchor = "end" if at > 0.8 * self._size[0] else "start" if low or at < 0.2 * self._size[0] else "middle"
            x, y = (at - 6 if anchor == "end" else at + 6, bottom - 8) if low else (at, 14)
            words = escape(label)
            self._above.append(f'<text class="{name}" x="{x:.1f}" y="{y:g}" text-anchor="{anchor}">{words}</text>')

    def band(self, begin: float, end: float, name: str) -> None:
        """Shade a range of x."""
        a, b = (min(max(self._at_x(x), LEFT), self._size[0] - RIGHT) for x in (begin, end))
        height = self._size[1] - TOP - BOTTOM
        self._parts.append(
            f'<rect class="{name}" x="{a:.1f}" y="{TOP}" width="{max(b - a, 0):.1f}" height="{height}"/>'
        )

    def text(self) -> str:
        """Return the SVG element."""
        width, height = self._size
        inner = f'x="{LEFT}" y="{TOP}" width="{width - LEFT - RIGHT}" height="{height - TOP - BOTTOM}"'
        return (
            f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(self._title)}">'
            f'<rect class="frame" {inner}/>{"".join(self._axes())}{"".join(self._parts)}{"".join(self._above)}</svg>'
        )

    def _axes(self) -> Iterable[str]:
        width, height = self._size
        bottom, right = height - BOTTOM, width - RIGHT
        for x in ticks(*self._x):
            at = self._at_x(x)
            yield f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{bottom}"/>'
            yield f'<text x="{at:.1f}" y="{bottom + 15:.1f}" text-anchor="middle">{short(x)}</text>'
        for y in ticks(*self._y, count=5):
            at = self._at_y(y)
            name = "zero" if y == 0 else "grid"
            yield f'<line class="{name}" x1="{LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>'
            yield f'<text x="{LEFT - 7}" y="{at + 4:.1f}" text-anchor="end">{short(y)}</text>'
        x_label, y_label = (escape(label) for label in self._labels)
        yield f'<text class="label" x="{right}" y="{height - 4}" text-anchor="end">{x_label}</text>'
        yield f'<text class="label" x="6" y="14">{y_label}</text>'

    def _at_x(self, x: float) -> float:
        low, high = self._x
        return LEFT + (x - low) / (high - low) * (self._size[0] - LEFT - RIGHT)

    def _at_y(self, y: float) -> float:
        low, high = self._y
        return self._size[1] - BOTTOM - (y - low) / (high - low) * (self._size[1] - TOP - BOTTOM)


def ticks(low: float, high: float, count: int = 8) -> list[float]:
    """Return about *count* round numbers between *low* and *high*: steps of 1, 2 or 5 times a power of ten."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw)
    first = math.ceil(low / step)
    return [nth * step for nth in range(first, math.floor(high / step) + 1)]


def short(value: float) -> str:
    """Write a tick's number."""
    size = abs(value)
    for scale, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if size >= scale:
            unit = 1e3 if letter == "k" else scale
            return f"{value / unit:.3g}{letter}".replace("-", "−")
    return f"{round(value, 6):g}".replace("-", "−")


def span(values: Sequence[float], *also: float) -> tuple[float, float]:
    """Return the range of *values* and some others."""
    every = [*values, *also]
    return min(every), max(every)


def _wider(given: tuple[float, float]) -> tuple[float, float]:
    low, high = given
    room = 0.04 * (high - low) or 1.0
    return low - room, high + room
