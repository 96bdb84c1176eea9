"""The truncated normal distribution: what was supposed, when part of it has turned out to be impossible.

Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions, vol. 1, section 13.10.1.
"""

from __future__ import annotations

import math

BEYOND = 6.0
"""So many standard deviations away nothing is left of a normal distribution, and its own bound is where it begins."""


def truncated(mean: float, sigma: float, low: float, high: float = math.inf) -> tuple[float, float]:
    """Return mean and standard deviation of a normal distribution of which only *low* to *high* is possible.

    Where that is further than six standard deviations away, nothing of what was supposed is true: the middle of the two
    bounds then, or a standard deviation from the only one.
    """
    a, b = (low - mean) / sigma, (high - mean) / sigma
    if a > BEYOND or b < -BEYOND:
        if math.isinf(high):
            return low + sigma, sigma
        return (low + high) / 2, (high - low) / math.sqrt(12)
    inside = (math.erf(b / math.sqrt(2)) - math.erf(a / math.sqrt(2))) / 2
    shift = (_density(a) - _density(b)) / inside
    spread = 1.0 + (_times_density(a) - _times_density(b)) / inside - shift * shift
    return mean + sigma * shift, sigma * math.sqrt(max(spread, 0.0))


def _density(x: float) -> float:
    return math.exp(-0.5 * x * x) / math.sqrt(2 * math.pi)


def _times_density(x: float) -> float:
    return 0.0 if math.isinf(x) else x * _density(x)
