"""Is a claimed standard error true? Errors of our own answers in units of the sigma that was claimed for them.

One pass and whole cycles are told apart: the latter have crossed focus again where one pass was not enough.

Sorted |error|/sigma against the quantiles of a half-normal distribution is a straight line of slope one where the
errors are what was claimed, steeper where they are larger. Two numbers say the same: the RMS of error/sigma (one, if
true) and the share beyond two sigma (4.6 %, if normal). Sweeps without anything to focus on have no error and are left
out.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.methods import CYCLE, OURS, rate_name
from benchmarks.plots import Plot, Series, draw
from benchmarks.sets import SETS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from benchmarks.rows import Row

BEYOND_TWO_SIGMA = math.erfc(2.0 / math.sqrt(2.0))
_DRAWN = 8.0
TITLES = {OURS: "one pass", CYCLE: "whole cycles"}
"""Whose standard errors are asked about."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """How true the claimed sigmas of a group of answers are: their number, RMS of error/sigma, share beyond two."""

    name: str
    answers: int
    rms: float
    beyond_two: float

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain data."""
        return asdict(self)


def calibrations(rows: Iterable[Row]) -> list[Calibration]:
    """Return the calibration over all sets, and of each set and frame rate, where there are answers; cycles apart."""
    claimed = _claimed(rows)
    groups: dict[str, list[Row]] = {}
    for method, title in TITLES.items():
        own = [row for row in claimed if row.method == method]
        groups[f"{title}, all sets"] = own
        for row in own:
            groups.setdefault(f"{title}, {row.set_name} {row.motion}, {row.rate}", []).append(row)
    return [_calibration(name, group) for name, group in groups.items() if group]


def _claimed(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of ours that have an error and claim one."""
    return [
        row
        for row in rows
        if row.method in TITLES and row.sigma_um and row.error_um is not None and not SETS[row.set_name].nothing_there
    ]


def ratios(rows: Iterable[Row]) -> np.ndarray:
    """Return sorted |error|/sigma of our own answers (n,)."""
    return np.sort(np.array([abs(row.error_um or 0.0) / (row.sigma_um or 1.0) for row in _claimed(rows)]))


def half_normal_quantiles(count: int) -> np.ndarray:
    """Return where *count* sorted magnitudes of normal errors lie (Hazen's plotting positions)."""
    normal = NormalDist()
    return np.array([normal.inv_cdf(0.5 + 0.5 * (k + 0.5) / count) for k in range(count)])


def draw_calibration(rows: Sequence[Row], title: str, method: str = OURS) -> str:
    """Draw the quantiles of |error|/sigma against those of a half-normal distribution, a line per frame rate."""
    own = [row for row in rows if row.method == method]
    series = [Series("as claimed", [0.0, 3.5], [0.0, 3.5])]
    for rate in dict.fromkeys(row.rate for row in own):
        found = ratios(row for row in own if row.rate == rate)
        if found.size:
            x = half_normal_quantiles(found.size)
            series.append(Series(f"{rate_name(rate)}: {found.size}, rms {_rms(found):.2f}", x.tolist(), found.tolist()))
    every = ratios(own)
    if not every.size:
        return f"<p>{title}, {TITLES[method]}: no answer claims an error.</p>"
    told = f"{every.size} answers, rms {_rms(every):.2f}, {(every > 2.0).mean():.1%} beyond 2"
    title = f"{title}, {TITLES[method]}: {told}"
    x_label = "what a normal error would be, in sigma"
    return draw(Plot(title, x_label, "|error| / claimed sigma", series, x_range=(0.0, 3.5), y_range=(0.0, _DRAWN)))


def _calibration(name: str, rows: Sequence[Row]) -> Calibration:
    found = ratios(rows)
    return Calibration(name, found.size, round(_rms(found), 3), round(float((found > 2.0).mean()), 4))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
