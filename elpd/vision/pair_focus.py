"""Where the mirror pairs say focus was, freed of the photoreceptors' lag, which they tell too."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.astigmatism import directions
from elpd.vision.lag import Lag, average_lag, expected_lag, weights_of_lines
from elpd.vision.pairs import Mode, Pairs, weighted_mode
from elpd.vision.turns import Slowness, Turns, blocks_of
from elpd.vision.witness import stray_share

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.vision.lag import LagPrior
    from elpd.vision.turns import Line

ASTRAY = 0.3
"""Share of stray pairs at which nothing that was measured on pairs is believed any more."""

DOUBT = 3.0
"""Error of a lag that was measured on nothing but stray pairs, in lags that one may guess."""

PAIRS_REACH = 0.8
"""How far, in widths of the curve, a pair may lie from the mode to have a say about the lag: dark pixels have lags of
half a width in a dim room."""

SOONEST = 0.02
"""Share of the pairs whose gaps are so short that they count as the next longer: what turns within microseconds is a
pixel that fires by itself; a few of those outweigh the rest, and no sensor in use has more of them than that."""

PAIRS_KERNEL = 0.15
"""Width of the kernel that finds the pairs' mode, over the way that the lens went past the peak."""


@dataclass(frozen=True, slots=True)
class Lateness:
    """The lag of the brightest under each candidate for slowness, and how well each explains the pairs."""

    candidates: list[Lag]
    weights: NDArray[np.float64]
    typical: Lag
    """What it makes of the pixels that turned, on the average."""
    unasked: Lag
    """The same if no pair had been asked."""
    towards: NDArray[np.float64]
    """Where the edges point whose pairs agree: the means of cos 2θ and sin 2θ, (2,)."""
    turns: Turns | None = None
    """The pairs that were asked."""


def pair_mode(
    pairs: Pairs,
    level: NDArray[np.float32],
    stretch: tuple[float, float, float],
    slownesses: list[Slowness],
    unmeasured_lag: float,
    calibrated: LagPrior | None,
    *,
    focused: bool,
) -> tuple[Mode | None, Lateness]:
    """Return the mode of the mirror pairs, freed of lag, and the lag under each candidate for slowness.

    *stretch* is where the raw peak and the end lie, and how far from the mode pairs tell of the lag.
    """
    peak, end, reach = stretch
    curvature = cv2.Laplacian(cv2.GaussianBlur(level, (0, 0), 1.0), cv2.CV_32F)[pairs.y, pairs.x].astype(np.float64)
    past = end - peak
    # Only dark sides of edges, where slowness is known: in log intensity they turn sharply, in focus, where bright
    # sides turn far and wide, and what a lens does to one side of focus and not to the other shows most. Elsewhere the
    # line wants both, which differ more in brightness.
    sided = (pairs.on > 0) & (curvature > 0.0) if focused else (2.0 * pairs.on - 1.0) * curvature > 0.0
    believed = sided & (pairs.after >= peak - 0.5 * past)
    gap = np.maximum(pairs.after - pairs.before, 1e-3 * past)[believed]
    soonest = float(np.quantile(gap, SOONEST)) if gap.size else 0.0
    weights = np.abs(curvature)[believed] / np.maximum(gap, soonest)
    middle = pairs.middle[believed]
    mode = weighted_mode(middle, weights, PAIRS_KERNEL * past)
    if mode is None:
        unknown = [lag_of(None, unmeasured_lag / float(one.times.mean()), calibrated) for one in slownesses]
        return None, Lateness(unknown, np.ones(len(unknown)), unknown[0], unknown[0], np.zeros(2))
    x, y = pairs.x[believed], pairs.y[believed]
    turns = Turns(middle, gap, weights, blocks_of(x, y, level.shape), mode.at, PAIRS_KERNEL * past, reach)
    slow = [one.at(y, x) for one in slownesses]
    usual = [float(np.average(one.times, weights=turns.near)) for one in slow]
    drawn = [turns.line(one) for one in slow]
    lines = [line for line, _ in drawn]
    typical = [float(np.average(one, weights=turns.near)) for _, one in drawn]
    # A lag that differs from pixel to pixel spreads their midpoints, which is not to go astray.
    mode = replace(mode, share=max(mode.share, *(turns.share(line, one) for line, one in drawn)))
    # Pairs that motion made turn at any time, and what they say of the lag is worth less than the expectation. That is
    # of a receptor's own lag: pairs that came too soon to be late themselves do not make the receptors slower.
    doubt = min(1.0, stray_share(mode) / ASTRAY) * DOUBT * unmeasured_lag
    late = [
        lag_of(
            None if line is None else replace(line, sigma=float(np.hypot(line.sigma, doubt / one))),
            unmeasured_lag / one,
            calibrated,
        )
        for line, one in zip(lines, usual, strict=True)
    ]
    fit = weights_of_lines(lines)
    lags = [Lag(one.at * at, one.sigma * at) for one, at in zip(late, typical, strict=True)]
    lag = as_known(lags) if focused else average_lag(lags, fit)
    nothing = lag_of(None, unmeasured_lag / usual[0], calibrated)
    unasked = Lag(usual[0] * nothing.at, usual[0] * nothing.sigma)
    towards = np.average(directions(level)[y, x], axis=0, weights=turns.near)
    return replace(mode, at=mode.at - lag.at), Lateness(late, fit, lag, unasked, towards, turns)


def as_known(lags: list[Lag]) -> Lag:
    """Return the first of ``slownesses_in_focus``'s lags, with what the others differ by in its error."""
    first, *others = lags
    apart = [0.5 * (high.at - low.at) for low, high in zip(others[::2], others[1::2], strict=True)]
    return Lag(first.at, float(np.linalg.norm([first.sigma, *apart])))


def lag_of(line: Line | None, expected: float, calibrated: LagPrior | None) -> Lag:
    """Return the lag by the pairs and what is known beforehand: a calibration, or photoreceptors at large."""
    return expected_lag(line, expected) if calibrated is None else calibrated.with_line(line)
