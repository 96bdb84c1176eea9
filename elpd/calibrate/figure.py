"""What the pictures of all calibrations have in common: the sheet, the head of a panel, the file.

Drawn with matplotlib, which nothing else needs: it is imported here, when a picture is asked for.
"""

from __future__ import annotations

import importlib
import textwrap
from typing import TYPE_CHECKING, Any

from elpd.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

INK, BLUE, RED, GREY = "#222222", "#1f5fa8", "#b23a2e", "#9a9a9a"
LETTERS_A_LINE = 60


def sheet(title: str, width_in: float = 11.0, height_in: float = 7.6) -> Any:
    """Return an empty figure. Raises ``UsageError`` without matplotlib."""
    try:
        figures = importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise UsageError(
            f"a picture takes matplotlib ({error}); pip install 'elpd[plots]', or leave --plot out"
        ) from None
    figure = figures.Figure(figsize=(width_in, height_in), layout="constrained")
    figure.patch.set_facecolor("white")
    figure.suptitle(title, color=INK, fontsize=11)
    return figure


def head(axes: Any, title: str, text: str) -> None:
    """Title a panel, and say in it what it shows."""
    _title(axes, title)
    words = "\n".join(textwrap.fill(line, LETTERS_A_LINE) for line in text.splitlines())
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    axes.text(0.03, 0.97, words, transform=axes.transAxes, va="top", fontsize=8.5, color=INK, bbox=box)


def nothing(axes: Any, title: str, why: str) -> None:
    """Title a panel that stays empty, and say why it does."""
    _title(axes, title)
    axes.set_axis_off()
    words = textwrap.fill(why, LETTERS_A_LINE)
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center", fontsize=8.5, color=INK)


def both_ways(axes: Any, points: Iterable[tuple[float, float, float]]) -> None:
    """Draw points (speed with its sign, value, error) over how fast, each direction in a colour of its own."""
    of_all = list(points)
    for sign, colour, word in ((1, BLUE, "up"), (-1, RED, "down")):
        rows = [(abs(speed), value, error) for speed, value, error in of_all if speed * sign > 0]
        speeds, values, errors = ([row[k] for row in rows] for k in range(3))
        axes.errorbar(speeds, values, errors, fmt="o", color=colour, capsize=3, ms=4, label=word)


def write(figure: Any, path: Path) -> None:
    """Write the picture as a PNG. Raises ``UsageError`` where the file cannot be written."""
    try:
        figure.savefig(path, dpi=120, format="png")
    except OSError as error:
        raise UsageError(f"{path}: the picture cannot be written ({error.strerror or error})") from None


def _title(axes: Any, title: str) -> None:
    axes.set_title(title, color=INK, fontsize=10, loc="left", fontweight="bold")
    axes.tick_params(colors=INK, labelsize=8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
