"""Is a claimed standard error true? Errors of our own answers in units of the sigma that was claimed for them.

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

from benchmarks.methods import OURS
from benchmarks.plots import Plot, Series, draw
from benchmarks.sets import SETS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from benchmarks.rows import Row

BEYOND_TWO_SIGMA = math.erfc(2.0 / math.sqrt(2.0))
_DRAWN = 8.0


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
    """Return the calibration over all sets, and of each set and frame rate, where there are answers."""
    groups: dict[str, list[Row]] = {"all sets": []}
    for row in rows:
        if row.method == OURS and row.sigma_um and row.error_um is not None and not SETS[row.set_name].nothing_there:
            groups["all sets"].append(row)
            groups.setdefault(f"{row.set_name} {row.motion}, {row.rate}", []).append(row)
    return [_calibration(name, group) for name, group in groups.items() if group]


def ratios(rows: Iterable[Row]) -> np.ndarray:
    """Return sorted |error|/sigma of our own answers (n,)."""
    found = [
        abs(row.error_um) / row.sigma_um
        for row in rows
        if row.method == OURS and row.sigma_um and row.error_um is not None and not SETS[row.set_name].nothing_there
    ]
    return np.sort(np.array(found, dtype=np.float64))


def half_normal_quantiles(count: int) -> np.ndarray:
    """Return where *count* sorted magnitudes of normal errors lie (Hazen's plotting positions)."""
    normal = NormalDist()
    return np.array([normal.inv_cdf(0.5 + 0.5 * (k + 0.5) / count) for k in range(count)])


def draw_calibration(rows: Sequence[Row], title: str) -> str:
    """Draw the quantiles of |error|/sigma against those of a half-normal distribution, a line per frame rate."""
    series = [Series("as claimed", [0.0, 3.5], [0.0, 3.5])]
    for rate in dict.fromkeys(row.rate for row in rows if row.method == OURS):
        found = ratios(row for row in rows if row.rate == rate)
        if found.size:
            x = half_normal_quantiles(found.size)
            series.append(Series(f"elpd, {rate} (rms {_rms(found):.2f})", x.tolist(), found.tolist()))
    every = ratios(rows)
    if every.size:
        title += f": rms {_rms(every):.2f}, {(every > 2.0).mean():.1%} beyond 2"
    x_label = "what a normal error would be, in sigma"
    return draw(Plot(title, x_label, "|error| / claimed sigma", series, x_range=(0.0, 3.5), y_range=(0.0, _DRAWN)))


def _calibration(name: str, rows: Sequence[Row]) -> Calibration:
    found = ratios(rows)
    return Calibration(name, found.size, round(_rms(found), 3), round(float((found > 2.0).mean()), 4))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
