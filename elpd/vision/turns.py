"""What the mirror pairs of dark and of bright pixels tell of the photoreceptors' lag: a robust line, and its error.

Midpoints are regressed on how late each pixel can be. Two other things make midpoints of dark pixels differ from those
of bright ones, and would be taken for lag:

*Local contrast.* In log intensity the dark sides of edges turn sharply, and a lens whose blur before focus is another
than behind it moves the midpoints of what turns gently: a wall of gravel without any lag has 3 um between its dark and
its bright pixels. That goes with how dark a pixel is *beside its neighbours*, while lag goes with how dark it is at
all. So the logarithm of slowness over that of the neighbourhood is a regressor of its own. But lag itself goes with
local contrast too: out of focus a dark pixel has light of its neighbours and is not as slow as the picture in focus
says. One pass cannot tell which it is, so the line is drawn both ways; the mean is taken, and half of the difference is
in its error.

*What is smooth in brightness* and none of both (surfaces, aberrations): it lies along the line, where no scatter shows
it. But what makes midpoints scatter *about* the line is of the same kind, so it is taken for a share of that
(``ALONG``).

Pairs of one object share what is wrong with them. So the error is a jackknife over blocks of the picture, not the
scatter of thousands of pairs over the root of their number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.pairs import weighted_mode

if TYPE_CHECKING:
    from numpy.typing import NDArray

NEIGHBOURHOOD_PX = 4.0
"""Standard deviation of what counts as a pixel's neighbourhood: about the blur where pairs of low contrast end."""

BLOCKS = 4
"""Along each side of the picture: sixteen blocks for the jackknife."""

FEWEST_BLOCKS = 5
FEWEST_PAIRS = 50

MOST_PAIRS = 1 << 13
"""More of them are thinned out: the jackknife's error is that of blocks, not of pairs."""

LEAST_ORDER = 0.25
"""Scatter about the line, over that of midpoints at random, above which motion makes pairs and focus does not: still
scenes have 0.02 to 0.12, scenes in a hand 0.4 to 0.6."""

ALONG = 0.2
"""What bright and dark parts differ by without a lag, as a standard deviation over the scatter about the line: 26 still
sweeps through the axis and the corner of a traced F/2 lens, two thresholds and two speeds, have 0.2. Their scatter is 1
to 15 um."""

_RANDOM = 0.74
"""Scatter of midpoints at random, by the median of their absolute values, over how far they are asked."""

BIWEIGHT = 4.685
"""Tukey's constant: 95 % as efficient as least squares where errors are normal."""

LEAST_CUT = 1e-3
"""Where the biweight ends at the least, over how far pairs are asked: no midpoint is known better."""

MOST = 0.95
"""Share of the pairs that counts as most of them."""

_BENDS = 4
_ROUNDS = 12
_AGAIN = 4
_NEWTON = 4
_STEEP = 30.0


@dataclass(frozen=True, slots=True)
class Slowness:
    """How many times slower than the brightest each pixel is, (height, width) or (n,).

    ``beyond`` is the logarithm of that over what the pixel's neighbourhood is on the average.
    """

    times: NDArray[np.float64]
    beyond: NDArray[np.float64]

    @classmethod
    def of(cls, times: NDArray[np.float64]) -> Slowness:
        """Return a picture's slowness, (height, width), with what is local in it."""
        around = cv2.GaussianBlur((1.0 / times).astype(np.float32), (0, 0), NEIGHBOURHOOD_PX)
        return cls(times, np.log(times * around.astype(np.float64)))

    def at(self, y: NDArray[np.uint16], x: NDArray[np.uint16]) -> Slowness:
        """Return that of some pixels."""
        return Slowness(self.times[y, x], self.beyond[y, x])


@dataclass(frozen=True, slots=True)
class Line:
    """A slope and its standard error, the pairs' scatter about the line, and how many count as independent."""

    slope: float
    sigma: float
    scatter: float
    points: float


def lateness(slowness: NDArray[np.float64], gap: NDArray[np.float64], lag: float) -> NDArray[np.float64]:
    """Return how late a pair is, in lags of the brightest, (n,).

    A receptor of time constant tau that sees a level fall and rise again evenly is late by ``tau·(1 - exp(-t/tau))`` a
    time t after the turn: a slow one has not caught up with the rise when its pair is complete. The later half of a
    pair comes half a *gap* after its midpoint, which itself is late: with ``x`` the lateness over tau and ``g`` half a
    gap over tau, ``x = 1 - exp(-g - x)``.
    """
    if lag <= 0.0:
        return slowness
    half = np.exp(-np.minimum(0.5 * gap / (lag * slowness), _STEEP))
    share = 1.0 - 0.5 * half
    for _ in range(_NEWTON):
        left = half * np.exp(-share)
        share = share - (share - 1.0 + left) / (1.0 - left)
    return np.asarray(slowness * np.clip(share, 0.0, 1.0), dtype=np.float64)


def blocks_of(x: NDArray[np.uint16], y: NDArray[np.uint16], shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return in which block of a picture of (height, width) each pixel lies, (n,)."""
    height, width = shape
    return (y.astype(np.int64) * BLOCKS // height) * BLOCKS + x.astype(np.int64) * BLOCKS // width


@dataclass(frozen=True, slots=True)
class Turns:
    """Mirror pairs that are believed, (n,) each: midpoints, gaps between the halves, weights, blocks of the picture.

    ``mode`` and ``width`` are the midpoints' mode and its kernel. Pairs further than ``reach`` from the mode have no
    say. ``along`` is the share of the scatter about the line that lies along it too.
    """

    middle: NDArray[np.float64]
    gap: NDArray[np.float64]
    weights: NDArray[np.float64]
    block: NDArray[np.int64]
    mode: float
    width: float
    reach: float
    along: float = ALONG

    @property
    def near(self) -> NDArray[np.float64]:
        """The weights of those about the mode."""
        return np.asarray(self.weights * (np.abs(self.middle - self.mode) <= 2.0 * self.width), dtype=np.float64)

    @property
    def mean_square_gap(self) -> float:
        """How long the pairs about the mode are: the weighted mean of their gaps' squares, 0 without any."""
        weights = self.near
        total = float(weights.sum())
        return float(weights @ np.square(self.gap)) / total if total > 0.0 else 0.0

    @property
    def begin(self) -> float:
        """How far before the mode most pairs about it begin: with their first event."""
        weights = self.near
        before = self.mode - (self.middle - 0.5 * self.gap)
        order = np.argsort(before)
        summed = np.cumsum(weights[order])
        if not summed.size or summed[-1] <= 0.0:
            return 0.0
        return float(before[order[int(np.searchsorted(summed, MOST * summed[-1]))]])

    def line(self, slowness: Slowness) -> tuple[Line | None, NDArray[np.float64]]:
        """Return the line of midpoints against how late pixels can be, ``None`` if there is none; and how late, (n,).

        How late depends on the lag that the line is to tell, so it is drawn again.
        """
        use = np.flatnonzero((np.abs(self.middle - self.mode) <= self.reach) & (self.weights > 0.0))
        use = use[:: -(-use.size // MOST_PAIRS) or 1]
        times, beyond = slowness.times[use], slowness.beyond[use]
        blocks = np.unique(self.block[use])
        if use.size < FEWEST_PAIRS or blocks.size < FEWEST_BLOCKS or np.ptp(times) <= 1e-9 * float(times.max()):
            return None, slowness.times
        thinned = replace(
            self, middle=self.middle[use], gap=self.gap[use], weights=self.weights[use], block=self.block[use]
        )
        all_lag, apart = (thinned.drawn(times, one, blocks) for one in (np.zeros_like(beyond), beyond))
        if all_lag is None or apart is None:
            return None, slowness.times
        slope, doubt = 0.5 * (all_lag.slope + apart.slope), 0.5 * (all_lag.slope - apart.slope)
        sigma = float(np.hypot(max(all_lag.sigma, apart.sigma), doubt))
        return replace(apart, slope=slope, sigma=sigma), lateness(slowness.times, self.gap, slope)

    def drawn(self, times: NDArray[np.float64], beyond: NDArray[np.float64], blocks: NDArray[np.int64]) -> Line | None:
        """Draw the line with what goes with local contrast (n,) put to lag, where *beyond* is zero, or taken apart."""
        one = _Regression(self.middle, self.weights, times, beyond, LEAST_CUT * self.reach)
        found = one.fit(times, np.array([self.mode, 0.0, 0.0]), self.reach, _ROUNDS)
        late = times
        for _ in range(_BENDS):
            late = lateness(times, self.gap, float(found.at[1]))
            found = one.fit(late, found.at, found.cut, _AGAIN)
        if found.scatter > LEAST_ORDER * _RANDOM * self.reach or not found.weights.any():
            return None  # pairs anywhere, or in heaps that no line goes through
        variance = one.jackknife(late, found, self.block, blocks)
        kept = found.weights
        x = late - float(np.average(late, weights=kept))
        spread = float(np.average(x * x, weights=kept))
        sigma = sqrt(variance + (self.along * found.scatter) ** 2 / max(spread, 1e-24))
        many = float(kept.sum() ** 2 / np.square(kept).sum())
        alike = max(1.0, variance * spread * many / max(found.scatter**2, 1e-24))
        return Line(float(found.at[1]), max(sigma, 1e-12), found.scatter, many / alike)

    def share(self, line: Line | None, late: NDArray[np.float64]) -> float:
        """Return the part of all weight about the mode, as ``Mode.share``, but for how a line spreads the midpoints."""
        if line is None:
            return 0.0
        freed = weighted_mode(self.middle - line.slope * late, self.weights, self.width)
        return 0.0 if freed is None else freed.share


@dataclass(frozen=True, slots=True)
class _Fit:
    """Coefficients (3,), where the biweight ends, the weights that it left (n,), and the residuals' scatter."""

    at: NDArray[np.float64]
    cut: float
    weights: NDArray[np.float64]
    scatter: float


class _Regression:
    """Midpoints (n,) on a constant, on lateness, and on local contrast; the biweight ends no closer than *least*."""

    def __init__(
        self,
        middle: NDArray[np.float64],
        weights: NDArray[np.float64],
        times: NDArray[np.float64],
        beyond: NDArray[np.float64],
        least: float,
    ) -> None:
        self._middle, self._weights, self._least = middle, weights, least
        centred = beyond - float(np.average(beyond, weights=weights))
        # What hardly differs tells nothing, and would only be a second constant.
        self._beyond = centred if np.ptp(centred) > 1e-6 else np.zeros_like(times)

    def _design(self, late: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([np.ones_like(late), late, self._beyond], axis=1)

    def fit(self, late: NDArray[np.float64], start: NDArray[np.float64], cut: float, rounds: int) -> _Fit:
        """Return the fit under Tukey's biweight; where it ends follows the scatter of what it holds."""
        design = self._design(late)
        at, scatter = start, cut / BIWEIGHT
        kept = self._weights
        for _ in range(rounds):
            at, kept, residual = _step(design, self._middle, self._weights, at, cut)
            if not kept.any():
                break
            inside = np.abs(residual) <= cut
            scatter = weighted_median(np.abs(residual[inside]), self._weights[inside]) / 0.6745
            cut = min(cut, max(BIWEIGHT * scatter, self._least))
        return _Fit(at, cut, kept, scatter)

    def jackknife(
        self, late: NDArray[np.float64], full: _Fit, block: NDArray[np.int64], blocks: NDArray[np.int64]
    ) -> float:
        """Return the variance of the slope, by leaving out each block in turn."""
        design = self._design(late)
        slopes = []
        for one in blocks:
            left = block != one
            of_left = design[left], self._middle[left], self._weights[left]
            at = full.at
            for _ in range(_AGAIN):
                at, _, _ = _step(*of_left, at, full.cut)
            slopes.append(float(at[1]))
        return float((len(slopes) - 1) * np.var(slopes))


def _step(
    design: NDArray[np.float64],
    values: NDArray[np.float64],
    weights: NDArray[np.float64],
    at: NDArray[np.float64],
    cut: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Do one step of iteratively reweighted least squares; return coefficients, weights and residuals."""
    residual = values - design @ at
    kept = weights * np.square(np.maximum(0.0, 1.0 - np.square(residual / cut)))
    weighted = design * kept[:, None]
    normal = design.T @ weighted
    # A regressor that is nothing, or the same as another, gets nothing.
    normal += 1e-9 * np.trace(normal) * np.eye(normal.shape[0]) + 1e-300 * np.eye(normal.shape[0])
    solved = np.asarray(np.linalg.solve(normal, weighted.T @ values), dtype=np.float64)
    return solved, kept, values - design @ solved


def weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Return the value that half of the weights lie up to; 0 without any."""
    order = np.argsort(values)
    summed = np.cumsum(weights[order])
    if not summed.size or summed[-1] <= 0.0:
        return 0.0
    return float(values[order[int(np.searchsorted(summed, 0.5 * summed[-1]))]])
