"""How late a photoreceptor is, and what that does to the place of focus.

A photoreceptor follows its light with a time constant in inverse proportion to it, so dark pixels see focus later than
bright ones, by the lens's speed times that constant: micrometres in a dim room. The mirror pairs of dark and of bright
pixels tell: their midpoints are put in classes of equal weight by slowness, a class's midpoint is its robust mean, and
a line through the classes has the lag for its slope. Whatever else makes one part of a picture differ from another
(aberration, motion) shows in how the classes scatter about that line, so the error is taken from there and not from the
thousands of pairs. A scene of one brightness tells nothing; then what is known of photoreceptors in general has the
say: a lag is never negative, and which power of ten it has depends on the light, so the expectation before any
measurement is log-normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, log, sqrt
from typing import TYPE_CHECKING

import numpy as np

from elpd.vision.pairs import weighted_mode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.records import SensorProfile

ROUNDS = 4
"""How often a line is drawn again through midpoints whose lateness it tells itself; two would nearly do."""

LEAST_ANSWERED = 0.5
"""Mean share of its lag that a pixel has when its pair is over, at the least: else the pairs tell of something else."""

UNMEASURED_LAG_US = 1_000.0
"""What a typical pixel's lag may as well exceed as not when nothing tells."""

DECADES = 0.5
"""One standard deviation of its logarithm to base ten: a tenth of the lag above in sunlight, tenfold in the dark."""

TYPICAL_SLOWNESS, SPREAD = 4.8, 3.4
"""How many times slower than the brightest a pixel is, mean and standard deviation, where no picture tells: evenly
spread over the powers of ten between one and what dark current leaves of the light (``crossing.DARK``)."""

OTHER_LIGHT = 0.5
"""How much of a calibrated lag another light may change: photoreceptors are as fast as their light lets them be."""

_FAR, _CELLS = 6.0, 401
"""How many standard deviations the distribution of a lag is drawn to, and how finely."""

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


@dataclass(frozen=True, slots=True)
class LagPrior:
    """What a calibration says of ``Lag.at``, and its standard error."""

    at: float
    sigma: float

    @classmethod
    def of(cls, sensor: SensorProfile | None, speed_um_us: float) -> LagPrior | None:
        """Return how far a lens goes, at a speed, during a calibrated lag; ``None`` without one."""
        if sensor is None or sensor.lag_us is None or sensor.lag_sigma_us is None or speed_um_us <= 0.0:
            return None
        sigma_us = max(1.0, sqrt(sensor.lag_sigma_us**2 + (OTHER_LIGHT * sensor.lag_us) ** 2))
        return cls(sensor.lag_us * speed_um_us, sigma_us * speed_um_us)

    def unseen(self) -> LagPrior:
        """Return the same for a typical pixel of a picture that nobody has seen."""
        return LagPrior(TYPICAL_SLOWNESS * self.at, float(np.hypot(TYPICAL_SLOWNESS * self.sigma, SPREAD * self.at)))

    def with_line(self, measured: Line | None) -> Lag:
        """Average what the pairs' classes say and what the calibration does, by their errors; not below zero."""
        if measured is None or not measured.sigma > 0.0:
            return Lag(self.at, self.sigma)
        precision, prior = measured.sigma**-2, self.sigma**-2
        at = (precision * measured.slope + prior * self.at) / (precision + prior)
        return Lag(max(0.0, at), 1.0 / sqrt(precision + prior))


@dataclass(frozen=True, slots=True)
class Line:
    """A slope and its standard error, the scatter of the points about the line, and how many they are."""

    slope: float
    sigma: float
    scatter: float
    points: int


def line_of_classes(
    middle: NDArray[np.float64],
    weights: NDArray[np.float64],
    slowness: NDArray[np.float64],
    mode: float,
    width: float,
    smooth: float = 0.0,
) -> Line | None:
    """Return the line of pairs' midpoints against slowness; ``None`` if there is none.

    *width* is the kernel of the *mode*: pairs further than three of it from their class's middle have no say. *smooth*
    is the standard deviation of what changes with brightness as smoothly as lag and is none: no scatter shows it.
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

    scattered = max(NEIGHBOURS * variance / float(x @ x), 1e-24)
    return Line(slope, sqrt(scattered + smooth**2 / float(np.mean(x * x))), sqrt(variance), x.size)


@dataclass(frozen=True, slots=True)
class Turns:
    """Mirror pairs that are believed: midpoints, later halves and weights (n,), and the midpoints' mode and kernel."""

    middle: NDArray[np.float64]
    after: NDArray[np.float64]
    weights: NDArray[np.float64]
    mode: float
    width: float
    smooth: float = 0.0
    """As of ``line_of_classes``."""

    @property
    def near(self) -> NDArray[np.float64]:
        """The weights of those about the mode."""
        return np.asarray(self.weights * (np.abs(self.middle - self.mode) <= 2.0 * self.width), dtype=np.float64)

    def line(self, slowness: NDArray[np.float64]) -> tuple[Line | None, NDArray[np.float64]]:
        """Return the line of midpoints against how late pixels of a *slowness* can be, and how late, (n,).

        A receptor of time constant tau that sees a level fall and rise again evenly is late by
        ``tau·(1 - exp(-t/tau))`` a time t after the turn: a slow one has not caught up with the rise when its pair is
        complete, and is less late than its slowness says. How much less depends on the lag that the line is to tell, so
        it is drawn again. It is believed if the classes then lie closer to it; what something else scatters does not.
        Pairs that motion makes may end at any time, so "how late" is how far they lie, and the line explains itself:
        that shows in that most of them would be over before their receptors had answered.
        """
        near = self.near
        plain = line = line_of_classes(self.middle, self.weights, slowness, self.mode, self.width, self.smooth)
        late = slowness
        for _ in range(ROUNDS):
            if line is None or line.slope <= 0.0:
                break
            focus = self.mode - line.slope * float(np.average(late, weights=near))
            late = -slowness * np.expm1(-np.maximum(self.after - focus, 0.0) / (line.slope * slowness))
            line = line_of_classes(self.middle, self.weights, late, self.mode, self.width, self.smooth)
        if plain is None or line is None or line.scatter > plain.scatter:
            return plain, slowness
        if float(np.average(late, weights=near)) < LEAST_ANSWERED * float(np.average(slowness, weights=near)):
            return plain, slowness
        return line, late

    def share(self, line: Line | None, late: NDArray[np.float64]) -> float:
        """Return the part of all weight about the mode, as ``Mode.share``, but for how a line spreads the midpoints."""
        if line is None:
            return 0.0
        freed = weighted_mode(self.middle - line.slope * late, self.weights, self.width)
        return 0.0 if freed is None else freed.share


def expected_lag(line: Line | None, median: float) -> Lag:
    """Return the mean and standard deviation of what is known after a measurement.

    Before it, the lag has the log-normal distribution of that *median* and of ``DECADES``; the measurement's error is
    normal. The mean of an unmeasured lag is twice its median, its standard deviation three times.
    """
    if median <= 0.0:
        return Lag()
    lag = median * np.exp(DECADES * log(10.0) * np.linspace(-_FAR, _FAR, _CELLS))
    if line is not None:
        near = line.slope + line.sigma * np.linspace(-_FAR, _FAR, _CELLS)
        lag = np.union1d(lag, near[near > 0.0])
    logarithm = -0.5 * np.square(np.log(lag / median) / (DECADES * log(10.0))) - np.log(lag)
    if line is not None:
        logarithm -= 0.5 * np.square((lag - line.slope) / line.sigma)
    share = np.exp(logarithm - logarithm.max()) * np.gradient(lag)
    share /= share.sum()
    at = float(share @ lag)
    return Lag(at, sqrt(float(share @ np.square(lag - at))))


def weights_of_lines(lines: Sequence[Line | None]) -> NDArray[np.float64]:
    """Return how well each of several lines explains the same midpoints, as weights of sum one."""
    known = [one.scatter for one in lines if one is not None]
    if not known:
        return np.full(len(lines), 1.0 / len(lines))
    least = max(min(known), 1e-12)
    likelihood = [
        0.0 if one is None else (least / max(one.scatter, least)) ** (one.points / NEIGHBOURS) for one in lines
    ]
    return np.array(likelihood) / sum(likelihood)


def average_lag(lags: Sequence[Lag], weights: NDArray[np.float64]) -> Lag:
    """Average lags by *weights*; the error holds how far the largest of them lies, which may be the right one.

    Answers that are too late by a lag that was underrated all err to one side, and nothing else tells of it.
    """
    at, sigma = np.array([one.at for one in lags]), np.array([one.sigma for one in lags])
    share = weights / weights.sum()
    mean = float(share @ at)
    return Lag(mean, float(np.sqrt(share @ sigma**2 + (at.max() - mean) ** 2)))


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
