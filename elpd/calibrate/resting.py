"""What a sensor sends while nothing changes: noise rates, their scatter, and the pixels that are hot.

Rates are counts over time and pixels, hot ones left out; their standard error is that of a Poisson count, widened by
the overdispersion that was found in time. A flickering lamp and a scene that moves show there: totals of short slices
then scatter more widely than chance lets them, and no rate of *noise* can be told.

A pixel is hot when it fired more often than good pixels do. Good pixels differ, so their counts follow a negative
binomial (a Poisson count whose rate is gamma distributed over pixels), fitted to the bulk: the first bound comes from
the share of silent pixels or the median, which hot pixels cannot move, and the fit is repeated on what lies below until
the bound stands still. The bound is where a whole sensor of good pixels would be above it once in a hundred
calibrations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.calibrate.quantity import Quantity

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.calibrate.evidence import Rest
    from elpd.records import Geometry

FALSE_ALARMS = 0.01
"""Good pixels that are called hot, expected per calibration of the whole sensor."""

SLICES = 100
"""Parts of a rest whose totals are compared."""

RESTLESS_SIGMAS = 6.0
RESTLESS = 2.0
"""Totals that scatter beyond chance, and with more than twice its variance, are no noise."""

FEWEST_EVENTS = 100
SHORTEST_S = 0.05

_ROUNDS = 30


@dataclass(frozen=True, slots=True)
class Resting:
    """What a rest told. ``hot`` are (x, y, Hz), worst first; ``None`` where hot pixels could not be told."""

    on_hz: Quantity
    off_hz: Quantity
    on_off_ratio: Quantity
    dispersion_pixels: Quantity
    """Variance over mean of the good pixels' counts: 1 for equal pixels."""
    dispersion_time: Quantity
    """Variance over mean of the totals of successive slices: 1 for independent events."""
    hot: tuple[tuple[int, int, float], ...] | None
    hot_reason: str | None
    hot_above_hz: float | None
    """Rate from which on a pixel counts as hot."""
    duration_s: float
    events: int


def measure_rest(rest: Rest, geometry: Geometry) -> Resting:
    """Measure noise and hot pixels on a span in which nothing moved."""
    events, duration_s = rest.events, rest.duration_s
    if duration_s < SHORTEST_S:
        return unmeasured(
            f"the sensor was at rest for {1e3 * duration_s:.0f} ms only (at least {1e3 * SHORTEST_S:.0f} are needed)"
        )
    on, off = events.counts(geometry)
    total = on + off
    limit = hot_limit(total.ravel())
    good = total <= limit
    n_on, n_off, pixels = int(on[good].sum()), int(off[good].sum()), int(good.sum())
    slices, _ = np.histogram(
        events.t_us[good[events.y, events.x]], bins=SLICES, range=(float(rest.begin_us), float(rest.end_us))
    )
    in_time, in_space = _dispersion(slices), _dispersion(total[good])
    rates = _rates(n_on, n_off, pixels, duration_s, slices)
    order = np.argsort(-total[~good], kind="stable")
    rows, columns = np.nonzero(~good)
    hot = tuple((int(columns[k]), int(rows[k]), float(total[rows[k], columns[k]] / duration_s)) for k in order)
    return Resting(*rates, in_space, in_time, hot, None, (limit + 1) / duration_s, duration_s, int(events.t_us.size))


def unmeasured(reason: str) -> Resting:
    """Return what a rest that is not there tells."""
    hertz = Quantity.none(reason, "Hz/px")
    return Resting(
        hertz, hertz, Quantity.none(reason), Quantity.none(reason), Quantity.none(reason), None, reason, None, 0.0, 0
    )


def _rates(
    n_on: int, n_off: int, pixels: int, duration_s: float, slices: NDArray[np.int64]
) -> tuple[Quantity, Quantity, Quantity]:
    count, exposure = n_on + n_off, max(pixels, 1) * duration_s
    excess = float(slices.var(ddof=1) / slices.mean()) if slices.sum() else 1.0
    if excess > max(RESTLESS, 1.0 + RESTLESS_SIGMAS * float(np.sqrt(2.0 / (SLICES - 1)))) and count > FEWEST_EVENTS:
        reason = (
            f"the scene was not at rest: counts of {1e3 * duration_s / SLICES:.0f} ms scatter with {excess:.1f} times "
            "the variance of independent events (limit 2); keep the scene still and use a lamp that does not flicker"
        )
        return Quantity.none(reason, "Hz/px"), Quantity.none(reason, "Hz/px"), Quantity.none(reason)
    wider = float(np.sqrt(max(1.0, excess)))
    # Half a count is what zero events may hide.
    on_hz = Quantity.of(n_on / exposure, wider * np.sqrt(n_on + 0.25) / exposure, "Hz/px")
    off_hz = Quantity.of(n_off / exposure, wider * np.sqrt(n_off + 0.25) / exposure, "Hz/px")
    if min(n_on, n_off) < FEWEST_EVENTS:
        few = f"only {n_on} ON and {n_off} OFF events came at rest (at least {FEWEST_EVENTS} of each); rest longer"
        return on_hz, off_hz, Quantity.none(few)
    ratio = n_on / n_off
    return on_hz, off_hz, Quantity.of(ratio, wider * ratio * np.sqrt(1.0 / n_on + 1.0 / n_off))


def _dispersion(counts: NDArray[np.int64]) -> Quantity:
    """Return variance over mean, its error from the sample's own third and fourth moments (delta method)."""
    n, mean = counts.size, float(counts.mean()) if counts.size else 0.0
    if counts.sum() < FEWEST_EVENTS:
        return Quantity.none(f"only {int(counts.sum())} events came at rest (at least {FEWEST_EVENTS})")
    deviation = counts - mean
    variance = float(deviation @ deviation) / (n - 1)
    influence = (deviation**2 - variance) / mean - variance / mean**2 * deviation
    return Quantity.of(variance / mean, float(np.sqrt(np.mean(influence**2) / n)))


def hot_limit(counts: NDArray[np.int64], false_alarms: float = FALSE_ALARMS) -> int:
    """Return the largest count that good pixels explain.

    Parameters
    ----------
    counts:
        Events of each pixel.
    false_alarms:
        How many good pixels, of all these, may lie above on average.
    """
    tail = false_alarms / max(1, counts.size)
    silent = float((counts == 0).mean())
    mean = -float(np.log(silent)) if silent > 0.05 else float(np.median(counts))
    limit = _tail_from(max(mean, 1.0 / counts.size), 0.0, tail)
    for _ in range(_ROUNDS):
        bulk = counts[counts <= limit]
        mean, variance = float(bulk.mean()), float(bulk.var())
        new = _tail_from(max(mean, 1.0 / counts.size), variance - mean, tail)
        if new == limit:
            break
        limit = new
    return limit


def _tail_from(mean: float, excess: float, tail: float) -> int:
    """Return the smallest k with P(count > k) < *tail* for a negative binomial (Poisson without *excess* variance)."""
    spread = np.sqrt(mean + max(excess, 0.0))
    k = np.arange(int(mean + 60.0 * spread + 60.0))
    if excess > 1e-9 * mean:
        size = mean**2 / excess
        log_first = -size * np.log1p(mean / size)
        log_steps = np.log((k + size) / (k + 1.0)) - np.log1p(size / mean)
    else:
        log_first = -mean
        log_steps = np.log(mean / (k + 1.0))
    log_mass = log_first + np.concatenate([[0.0], np.cumsum(log_steps)])
    above = np.cumsum(np.exp(log_mass)[::-1])[::-1][1:]  # P(count > k)
    return int(np.argmax(above < tail)) if (above < tail).any() else int(k[-1])
