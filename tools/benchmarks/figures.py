"""The report's plots of errors and curves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.methods import CYCLE, NO_FRAMES, OURS, all_methods, rate_name
from benchmarks.plots import Plot, Series, draw
from benchmarks.sets import SETS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.rows import Row

WORST_DRAWN_UM = 400.0

PUBLISHED_FOR = {"syn": "elp-syn", "third": "elp-syn", "davis": "elp-davis", "evk4": "elp-evk4"}
"""ELP as published for a set of that kind: what error distributions show beside ours, with the event-only peers."""


def errors(rows: Sequence[Row], motion: str) -> list[str]:
    """Draw the shares of *all* cases with an error below x: ours at all frame rates, and the peers beside the best."""
    pairs = list(dict.fromkeys((row.method, row.rate) for row in rows))
    set_name = rows[0].set_name
    best = SETS[set_name].rates[0]
    ours = [pair for pair in pairs if pair[0] in (OURS, CYCLE)]
    published = PUBLISHED_FOR.get(set_name.split("-", maxsplit=1)[0], "elp-davis")
    peers = [(published, best), ("elp-syn-1fps", "1"), *((name, NO_FRAMES) for name in ("pbf", "egs", "esva"))]
    beside = [pair for pair in ours if pair[1] == best] + [pair for pair in peers if pair in pairs]
    return [_distribution(rows, ours, f"{motion}, ours"), _distribution(rows, beside, f"{motion}, peers beside ours")]


def _distribution(rows: Sequence[Row], pairs: Sequence[tuple[str, str]], title: str) -> str:
    """Draw a line for each of *pairs*; those that do not reach one have misses."""
    series = []
    for method, rate in pairs:
        own = [row for row in rows if (row.method, row.rate) == (method, rate)]
        errors = sorted(max(abs(row.error_um), 0.02) for row in own if row.error_um is not None)
        if errors:
            corners, shares = _staircase(errors, len(own))
            # Drawn on to the right edge at the share that had an answer at all.
            series.append(Series(_label(method, rate), [*corners, WORST_DRAWN_UM], [*shares, shares[-1]]))
    marks = [(SETS[row.set_name].depth_of_focus_um, "depth of focus") for row in rows[:1]]
    return draw(
        Plot(
            f"{title}: share of cases below an error", "|error| um", "share of all cases", series,
            log_x=True, x_range=(0.02, WORST_DRAWN_UM), y_range=(0.0, 1.0), marks=marks,
        )
    )  # fmt: skip


def per_method(rows: Sequence[Row]) -> str:
    """Draw each method's signed errors, a line per motion and frame rate: the share of all its cases below x."""
    plots = []
    for name in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == name]
        series = []
        for motion, rate in dict.fromkeys((row.motion, row.rate) for row in own):
            group = [row for row in own if (row.motion, row.rate) == (motion, rate)]
            errors = sorted(row.error_um for row in group if row.error_um is not None)
            series.append(Series(f"{motion}, {rate}", *_staircase(errors, len(group))))
        limit_um = 4.0 * SETS[own[0].set_name].depth_of_focus_um
        title = f"{all_methods()[name].title}: signed error"
        plots.append(
            draw(
                Plot(
                    title, "error um (late is positive)", "share of cases below", series,
                    x_range=(-limit_um, limit_um), y_range=(0.0, 1.0), marks=[(0.0, "truth")],
                )
            )
        )  # fmt: skip
    told = "Every method's signed errors; what lies further out than four depths of focus is drawn at the edge"
    return f"<details><summary>{told}</summary><div class='plots'>{''.join(plots)}</div></details>"


def curves(rows: Sequence[Row], motions: Sequence[str]) -> list[str]:
    """Draw the published ELP of the first case of each motion, at 50 fps and with the one future frame."""
    plots = []
    for motion in motions:
        first = next(((row.case, row.seed) for row in rows if row.motion == motion and "curve" in row.details), None)
        series, marks = [], [(0.0, "truth")]
        for row in rows:
            if (row.case, row.seed) != first or "curve" not in row.details:
                continue
            curve = row.details["curve"]
            series.append(
                Series(
                    _label(row.method, row.rate),
                    [SETS[row.set_name].position_um(t_us) for t_us in curve["t_us"]],
                    curve["elp"],
                )
            )
            if row.decided_um is not None:
                marks.append((row.decided_um, f"decided, {_label(row.method, row.rate)}"))
        plots.append(
            draw(Plot("" if first is None else first[0], "lens position um", "ELP per event", series, marks=marks))
        )
    return plots


def _staircase(errors: Sequence[float], cases: int) -> tuple[list[float], list[float]]:
    """Return the corners of a distribution of sorted errors, and the share of all cases at each."""
    corners = [corner for error in errors for corner in (error, error)]
    return corners, [step / cases for k in range(len(errors)) for step in (k, k + 1)]


def _label(method: str, rate: str) -> str:
    return method if rate == "-" and method not in (OURS, CYCLE) else f"{method}, {rate_name(rate)}"
