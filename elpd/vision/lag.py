"""How late a photoreceptor is, and what that does to the place of focus.

A photoreceptor follows its light with a time constant in inverse proportion to it, so dark pixels see focus later than
bright ones, by the lens's speed times that constant: micrometres in a dim room. What mirror pairs say of it is a line
(``elpd.vision.turns``). A scene of one brightness tells nothing; then what is known of photoreceptors in general has
the say: a lag is never negative, and which power of ten it has depends on the light, so the expectation before any
measurement is log-normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, expm1, log, sqrt
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.records import SensorProfile
    from elpd.vision.turns import Line

UNMEASURED_LAG_US = 1_000.0
"""What a typical pixel's lag may as well exceed as not when nothing tells."""

DECADES = 0.5
"""One standard deviation of its logarithm to base ten: a tenth of the lag above in sunlight, tenfold in the dark."""

TYPICAL_SLOWNESS, SPREAD = 4.8, 3.4
"""How many times slower than the brightest a pixel is, mean and standard deviation, where no picture tells: evenly
spread over the powers of ten between one and what dark current leaves of the light (``slowness.DARK``)."""

OTHER_LIGHT = 0.5
"""How much of a calibrated lag another light may change: photoreceptors are as fast as their light lets them be."""


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


def expected_lag(line: Line | None, median: float) -> Lag:
    """Return what is known of a lag after a measurement, and its standard error.

    Before it, the lag has the log-normal distribution of that *median* and of ``DECADES``: a mean of twice its median,
    a standard deviation of three times. Its peak is at a quarter of the median, which is an opinion about how bright
    rooms are, so a measurement that is better than the expectation is not drawn there but stands for itself: the most
    likely lag that is not negative. A measurement that is worse adds nothing.
    """
    if median <= 0.0:
        return Lag()
    width = DECADES * log(10.0)
    mean = median * exp(0.5 * width**2)
    usual = Lag(mean, mean * sqrt(expm1(width**2)))
    if line is None or line.sigma >= usual.sigma:
        return usual
    return Lag(max(line.slope, 0.0), line.sigma)


def weights_of_lines(lines: Sequence[Line | None]) -> NDArray[np.float64]:
    """Return how well each of several lines explains the same midpoints, as weights of sum one."""
    known = [one.scatter for one in lines if one is not None]
    if not known:
        return np.full(len(lines), 1.0 / len(lines))
    least = max(min(known), 1e-12)
    likelihood = [0.0 if one is None else (least / max(one.scatter, least)) ** one.points for one in lines]
    return np.array(likelihood) / sum(likelihood)


def average_lag(lags: Sequence[Lag], weights: NDArray[np.float64]) -> Lag:
    """Average lags by *weights*; the error holds how far the largest of them lies, which may be the right one.

    Answers that are too late by a lag that was underrated all err to one side, and nothing else tells of it.
    """
    at, sigma = np.array([one.at for one in lags]), np.array([one.sigma for one in lags])
    share = weights / weights.sum()
    mean = float(share @ at)
    return Lag(mean, float(np.sqrt(share @ sigma**2 + (at.max() - mean) ** 2)))
