"""How late a photoreceptor is, and what that does to the place of focus.

A photoreceptor follows its light with a time constant in inverse proportion to it, so dark pixels see focus later than
bright ones, by the lens's speed times that constant: micrometres in a dim room. The mirror pairs of dark and of bright
pixels tell: their midpoints are put in classes of equal weight by slowness, a class's midpoint is its robust mean, and
a line through the classes has the lag for its slope. Whatever else makes one part of a picture differ from another
(aberration, motion) shows in how the classes scatter about that line, so the error is taken from there and not from the
thousands of pairs. A scene of one brightness tells nothing; then what is known of photoreceptors in general has the
say: a lag is never negative, and longer ones are rarer, so the expectation before any measurement is an exponential.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erfc, exp, inf, pi, sqrt
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

UNMEASURED_LAG_US = 1_000.0
"""What a typical pixel's lag is expected to be when nothing tells: a tenth of it in sunlight, tenfold in the dark."""

CLASSES = 10
FEWEST_CLASSES = 5
FEWEST_IN_CLASS = 10
NEIGHBOURS = 2.0
"""Classes next to each other share parts of the scene: so many count as one."""


@dataclass(frozen=True, slots=True)
class Lag:
    """How far the lens went while the brightest photoreceptors answered, and one standard error.

    A pixel ``s`` times slower than the brightest is late by ``s`` times this. Where no brightness is known, all pixels
    count as equally slow.
    """

    at: float = 0.0
    sigma: float = 0.0


def slope_of_classes(
    middle: NDArray[np.float64],
    weights: NDArray[np.float64],
    slowness: NDArray[np.float64],
    mode: float,
    width: float,
) -> tuple[float, float] | None:
    """Return the slope of pairs' midpoints against slowness and its standard error; ``None`` if there is no slope.

    *width* is the kernel of the *mode*: pairs further than three of it from their class's middle have no say.
    """
    order = np.argsort(slowness, kind="stable")
    order = order[np.abs(middle[order] - mode) <= 3.0 * width]
    summed = np.cumsum(weights[order])
    if order.size < FEWEST_IN_CLASS * FEWEST_CLASSES or summed[-1] <= 0.0:
        return None
    cuts = np.searchsorted(summed, summed[-1] * np.arange(1, CLASSES) / CLASSES)
    slow, late = [], []
    for part in np.split(order, cuts):
        if part.size >= FEWEST_IN_CLASS:
            slow.append(float(np.average(slowness[part], weights=weights[part])))
            late.append(_robust_mean(middle[part], weights[part], 3.0 * width))
    if len(slow) < FEWEST_CLASSES or np.ptp(slow) <= 1e-9 * max(slow):
        return None
    x, y = np.array(slow) - np.mean(slow), np.array(late) - np.mean(late)
    slope = float(x @ y / (x @ x))
    variance = float(np.square(y - slope * x).sum()) / (x.size - 2)
    return slope, sqrt(max(NEIGHBOURS * variance / float(x @ x), 1e-24))


def expected_lag(measured: tuple[float, float] | None, mean: float) -> Lag:
    """Return the mean and standard deviation of what is known after a measurement (value, standard error).

    Before it, the lag has the exponential distribution of mean *mean*; a normal error on top leaves a normal
    distribution cut off at zero.
    """
    if mean <= 0.0:
        return Lag()
    if measured is None or measured[1] > 1e3 * mean:
        return Lag(mean, mean)
    value, sigma = measured
    shifted = value - sigma * sigma / mean
    cut = -shifted / sigma
    # Mills' ratio; far out, where the normal's tail underflows, its own expansion.
    hazard = cut + 1.0 / cut - 2.0 / cut**3 if cut > 20.0 else sqrt(2.0 / pi) * exp(-0.5 * cut * cut) / erfc(cut / sqrt(2.0))
    at = shifted + sigma * hazard
    variance = sigma * sigma * (1.0 + cut * hazard - hazard * hazard)
    return Lag(max(at, 0.0), sqrt(variance) if variance > 0.0 else max(at, 0.0))


def _robust_mean(values: NDArray[np.float64], weights: NDArray[np.float64], reach: float) -> float:
    """Return the weighted mean under Tukey's biweight."""
    at, before = float(np.average(values, weights=weights)), inf
    for _ in range(30):
        if abs(at - before) <= 1e-6 * reach:
            break
        kept = weights * np.square(np.maximum(0.0, 1.0 - np.square((values - at) / reach)))
        if kept.sum() <= 0.0:
            break
        at, before = float(np.average(values, weights=kept)), at
    return at
