"""Which way is focus, and has it just been passed? Sequential tests on samples of the Event Laplacian Product.

The scene sets the size of ELP, so no fixed threshold can judge it. Here every verdict is a *score*: a sum of samples
over the root of the variance it would have if events had no common sign, ``sqrt(φ·Σw²)``. The overdispersion φ (scene
motion, flicker, correlated noise) is measured from how successive windows differ. The score needs six standard
deviations, whatever the region, the contrast, the window or the sensor.

The running sum C of samples rises while focus is ahead and falls once it is behind. A verdict is a rally from its
running minimum or a drawdown from its running maximum that is six deviations long: the first such is the direction,
a drawdown after a rally is the sign mutation that the paper looks for, and a rally after a drawdown says that the
scene has moved focus ahead again. The change itself is dated to the maximum of C, where ELP crosses zero. That is
*late* by the sensor's hysteresis; ``crossing`` says where focus was.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

from elpd.records import Direction

if TYPE_CHECKING:
    from elpd.records import ElpSample

SIGMAS = 6.0
"""Length of a verdict in standard deviations. Four is not safe, six made no early stop in 48 static sweeps."""

RELATIVE_DRAWDOWN = 0.1
"""A sign mutation also undoes a tenth of the approach: a shiver of a strong signal is not focus."""

_DISPERSION_WINDOWS = 64
_MIN_EVENTS_FOR_VERDICT = 30
_MIN_DIFFERENCES = 3


@dataclass(frozen=True, slots=True)
class Verdict:
    """A direction, when it was reached, and how sure."""

    direction: Direction
    decided_us: int
    score: float


@dataclass(frozen=True, slots=True)
class RestingRate:
    """What the region says while nothing moves: mean of ELP and events per microsecond, and how it scatters."""

    elp_per_us: float = 0.0
    events_per_us: float = 0.0
    overdispersion: float = 1.0


class Detector:
    """Judges direction and sign mutation from samples, causally.

    Parameters
    ----------
    rest:
        What the region says at rest; its mean is subtracted.
    arm_after_us:
        Samples that begin earlier are settling, and are not judged.
    recede_sigmas:
        How certain a first verdict of receding must be: more after a reversal, because a false one costs the most.
    """

    def __init__(self, rest: RestingRate | None = None, arm_after_us: int = 0, recede_sigmas: float = SIGMAS) -> None:
        self.rest = rest or RestingRate()
        self.recede_sigmas = recede_sigmas
        self.arm_after_us = arm_after_us
        self.direction = Direction.UNKNOWN
        self.first: Verdict | None = None
        self.mutation: Verdict | None = None
        self.crossing_us: int | None = None
        self.events = 0
        self.samples = 0
        self._total = 0.0
        self._high = self._low = 0.0
        self._high_us = 0
        self._energy_since_high = self._energy_since_low = 0.0
        self._events_since_high = self._events_since_low = 0
        self._at_high = (0.0, 0.0)
        self._foot = 0.0
        self._previous: tuple[float, float] | None = None
        self._differences: deque[tuple[float, float]] = deque(maxlen=_DISPERSION_WINDOWS)

    @property
    def overdispersion(self) -> float:
        """How much larger the scatter of successive windows is than that of independent events; at least one.

        A standard error is added: a few windows that happen to agree prove little.
        """
        variance = sum(energy for _, energy in self._differences)
        if variance <= 0.0:
            return self.rest.overdispersion
        doubt = 1.0 + sqrt(2.0 / len(self._differences))
        measured = doubt * sum(square for square, _ in self._differences) / variance
        return max(1.0, self.rest.overdispersion, measured)

    @property
    def likely_crossing_us(self) -> int | None:
        """When ELP crossed zero: at the mutation, or what is likely before one is certain; ``None`` if it has not."""
        if self.direction is Direction.APPROACHING and self._total < self._high:
            return self._high_us
        return self.crossing_us

    @property
    def approach_score(self) -> float:
        """Length of the present rally in standard deviations."""
        return _score(self._total - self._low, self.overdispersion * self._energy_since_low)

    @property
    def recede_score(self) -> float:
        """Length of the present drawdown in standard deviations."""
        return _score(self._high - self._total, self.overdispersion * self._energy_since_high)

    def feed(self, sample: ElpSample) -> Direction:
        """Take one sample and return the present direction."""
        self.samples += 1
        self.events += sample.n_on + sample.n_off
        if sample.begin_us < self.arm_after_us:
            return self.direction
        value = sample.elp - self.rest.elp_per_us * (sample.end_us - sample.begin_us)
        self._measure_dispersion(value, float(sample.energy))
        self._total += value
        self._follow(sample)
        self._judge(sample)
        return self.direction

    def _measure_dispersion(self, value: float, energy: float) -> None:
        if self._previous is not None:
            before, energy_before = self._previous
            self._differences.append(((value - before) ** 2, energy + energy_before))
        self._previous = (value, energy)

    def _follow(self, sample: ElpSample) -> None:
        count = sample.n_on + sample.n_off
        centre_us = 0.5 * (sample.begin_us + sample.end_us)
        rate = sample.elp / max(1, sample.end_us - sample.begin_us)
        if self._total >= self._high or self._high_us == 0:
            self._high, self._high_us = max(self._total, self._high), sample.end_us
            self._at_high = (centre_us, rate)
            self._energy_since_high, self._events_since_high = 0.0, 0
        else:
            if self._events_since_high == 0 and rate < 0.0:
                self._high_us = self._zero_between((centre_us, rate))
            self._energy_since_high += sample.energy
            self._events_since_high += count
        if self._total <= self._low:
            self._low = self._total
            self._energy_since_low, self._events_since_low = 0.0, 0
        else:
            self._energy_since_low += sample.energy
            self._events_since_low += count

    def _zero_between(self, after: tuple[float, float]) -> int:
        """Return where the line through the rates of the last positive and the first negative window is zero."""
        (t0, rate0), (t1, rate1) = self._at_high, after
        return round(t0 + (t1 - t0) * rate0 / (rate0 - rate1)) if rate0 > 0.0 else self._high_us

    def _judge(self, sample: ElpSample) -> None:
        if len(self._differences) < _MIN_DIFFERENCES:
            return
        rally = self._total - self._low
        drawdown = self._high - self._total
        recede_sigmas = self.recede_sigmas if self.direction is Direction.UNKNOWN else SIGMAS
        if (
            self.direction is not Direction.APPROACHING
            and self._events_since_low >= _MIN_EVENTS_FOR_VERDICT
            and self._may_exceed(SIGMAS, rally, self._energy_since_low)
            and self.approach_score > SIGMAS
            and (self.direction is Direction.UNKNOWN or rally > RELATIVE_DRAWDOWN * (self._foot - self._low))
        ):
            self._turn(Direction.APPROACHING, sample, self.approach_score)
            self._foot = self._low
            self._high, self._high_us = self._total, sample.end_us
            self._at_high = (
                0.5 * (sample.begin_us + sample.end_us),
                sample.elp / max(1, sample.end_us - sample.begin_us),
            )
            self._energy_since_high, self._events_since_high = 0.0, 0
        elif (
            self.direction is not Direction.RECEDING
            and self._events_since_high >= _MIN_EVENTS_FOR_VERDICT
            and self._may_exceed(recede_sigmas, drawdown, self._energy_since_high)
            and self.recede_score > recede_sigmas
            and (self.direction is Direction.UNKNOWN or drawdown > RELATIVE_DRAWDOWN * (self._high - self._foot))
        ):
            score = self.recede_score
            if self.direction is Direction.APPROACHING:
                self.crossing_us = self._high_us
                self.mutation = Verdict(Direction.RECEDING, sample.end_us, score)
            self._turn(Direction.RECEDING, sample, score)
            self._foot = self._high
            self._low = self._total
            self._energy_since_low, self._events_since_low = 0.0, 0

    def _may_exceed(self, sigmas: float, length: float, energy: float) -> bool:
        """Say whether a score could be so large, without measuring the overdispersion, which takes long."""
        return _score(length, max(1.0, self.rest.overdispersion) * energy) > sigmas

    def _turn(self, direction: Direction, sample: ElpSample, score: float) -> None:
        self.direction = direction
        if self.first is None:
            self.first = Verdict(direction, sample.end_us, score)


def _score(length: float, variance: float) -> float:
    return length / sqrt(variance) if variance > 0.0 else 0.0
