"""How long a pixel is deaf after an event, measured from the events themselves.

After an event a pixel is held in reset for its refractory period, and what the light does in that time is lost: the
next threshold is counted from the brightness at *release*, not at the event. So the level that an event stands for is
that of its release, and every position read off event times is early by the refractory period times the lens speed:
half a millisecond at 4 mm/s is 2 um, a third of a depth of focus. Dating events to their release removes it, on both
sides of focus alike (a pair's halves then lie at equal levels again).

Nobody knows the period of a given sensor and bias; but no two events of one pixel are closer than it, and noise sees to
it that some nearly are. Just above the period the intervals are evenly spread, so the shortest ones, less what their
number leaves to expect, are the period, and their scatter its error. Where the shortest interval is set by the steepest
edge in view instead, the intervals above it crowd; but such an edge makes intervals between events of one sign. To send
one of the other sign, brightness has to turn and come back by a threshold, so intervals between *opposite* events that
are shorter still are noise. There are few of them, and how densely they lie says how far below the first the period may
be: ``exp(density · period)`` is its probability, up to the first. Without any it is anything below the shortest
interval, evenly. So it is where stamps lie on a grid: intervals are as long as the grid makes them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, expm1, sqrt
from typing import TYPE_CHECKING

import numpy as np

from elpd.events.jit import kernel
from elpd.vision.flicker import stamp_grid_us

if TYPE_CHECKING:
    from numpy.typing import NDArray

ORDER = 5
"""Which of the shortest intervals is believed: a glitch in the time stamps may make one or two."""

KEPT = 512
MIN_INTERVALS = 5_000
GRID_COUNT = 250
"""So many intervals exactly alike and shortest, and the time stamps are on a grid too, whatever most of them do."""

FEWEST_ABOVE = 8
EVEN_SIGMAS = 2.0
"""So many intervals must lie above the shortest, up to half as long again, and not crowd towards their end by so many
standard deviations. One steep edge makes several alike at the start, so all that are kept are looked at."""

TOGETHER_US = 16.0
"""Closer together than this all of them are at the period, and whole microseconds say nothing of how they lie."""

KEPT_OPPOSITE = 64
GLITCH = 0.5
"""Opposite events closer than this share of the shortest intervals are a slip of the time stamps: what is deaf for so
short a time shows so in many intervals."""

LEAST_WINDOW = 0.25
"""Share of the first of them over which they are counted at the least, to see how densely they lie: the same number
within less may be an edge's."""

MOST_STEEP = 500.0
"""So many of them expected below the first that the exponential need not be worked out."""

MOST_US = 1_000.0
"""So long a period nobody sets for focusing: shortest intervals above it are those of the scene."""

_FOREVER = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True)
class Refractory:
    """A refractory period and one standard error, us; both zero where nothing need be said."""

    period_us: float = 0.0
    sigma_us: float = 0.0


NOT_DEAF = Refractory()


@kernel("int64(int64[::1], uint16[::1], uint16[::1], uint8[::1], int64[:, ::1], int64[::1], int64[::1])")
def shortest_intervals(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    last: NDArray[np.int64],
    shortest_us: NDArray[np.int64],
    opposite_us: NDArray[np.int64],
) -> int:
    """Keep the shortest intervals between events of one pixel, ascending; return how many there were.

    *shortest_us* keeps those of all, *opposite_us* those between events of opposite sign; both begin full of large
    values. *last*, (height, width), holds twice each pixel's last time, and one more if that was an ON event; negative
    before the first. Intervals of zero (one time stamp for two events) are passed over.
    """
    count = 0
    for i in range(t_us.size):
        before = last[y[i], x[i]]
        last[y[i], x[i]] = 2 * t_us[i] + (1 if on[i] else 0)
        interval = t_us[i] - before // 2
        if before < 0 or interval <= 0:
            continue
        count += 1
        for which in range(2):
            kept = shortest_us if which == 0 else opposite_us
            if which == 1 and (before % 2 == 1) == (on[i] != 0):
                continue
            j = kept.size - 1
            if interval >= kept[j]:
                continue
            while j > 0 and kept[j - 1] > interval:
                kept[j] = kept[j - 1]
                j -= 1
            kept[j] = interval
    return count


class Deafness:
    """Learns the refractory period of a sensor's pixels from whatever they send, bit by bit.

    Parameters
    ----------
    shape:
        (height, width) of the pixels.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._last = np.full(shape, -1, np.int64)
        self._shortest_us = np.full(KEPT, _FOREVER)
        self._opposite_us = np.full(KEPT_OPPOSITE, _FOREVER)
        self._count = 0
        self._step_us = int(_FOREVER)

    def add(self, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], on: NDArray[np.uint8]) -> None:
        """Take events in time order; they need not follow the last ones at once."""
        self._count += shortest_intervals(t_us, x, y, on, self._last, self._shortest_us, self._opposite_us)
        self._step_us = min(self._step_us, stamp_grid_us(t_us))

    def period(self) -> Refractory:
        """Return the refractory period, as far as the events told it."""
        shortest_us = self._shortest_us
        least_us = float(shortest_us[ORDER - 1])
        bound_us = min(least_us, MOST_US)
        anything = Refractory(0.5 * bound_us, bound_us / sqrt(12.0))
        if self._count < MIN_INTERVALS or self._on_a_grid() or shortest_us[0] == shortest_us[GRID_COUNT]:
            return anything
        bounded = self._below(bound_us)
        if least_us > MOST_US:
            return bounded
        top_us = min(1.5 * least_us, float(shortest_us[-1]))
        above = (shortest_us[ORDER:] - least_us) / (top_us - least_us) if top_us > least_us else np.empty(0)
        above = above[: max(FEWEST_ABOVE, int(np.searchsorted(above, 1.0, side="right")))]
        if above.size < FEWEST_ABOVE:
            return bounded
        # Evenly spread, they lie at half their range on average; what is set by edges in view crowds towards its end.
        reach = max(float(above.max()), 1.0 / (top_us - least_us))
        lie = float(above.mean()) / reach
        if reach * (top_us - least_us) > TOGETHER_US and lie > 0.5 + EVEN_SIGMAS / np.sqrt(12.0 * above.size):
            return bounded
        per_us = float(above.size / (reach * (top_us - least_us)))
        return Refractory(max(0.0, least_us - ORDER / per_us), min(anything.sigma_us, sqrt(ORDER) / per_us))

    def _on_a_grid(self) -> bool:
        """Whether a grid of time stamps, not the pixels, sets intervals: most are alike, and most stamps far apart."""
        return np.unique(self._shortest_us).size < KEPT // 2 and self._step_us > TOGETHER_US

    def _below(self, bound_us: float) -> Refractory:
        """Return the period that is below a bound and below the shortest interval between opposite events."""
        noise_us = self._opposite_us[self._opposite_us > GLITCH * bound_us]
        if not noise_us.size or noise_us[0] > bound_us:
            return Refractory(0.5 * bound_us, bound_us / sqrt(12.0))
        first_us, edges_us = float(noise_us[0]), self._shortest_between_alike()
        # Beyond what edges can do there are edges that follow noise.
        within_us = max(edges_us - first_us, LEAST_WINDOW * first_us)
        return _grown_towards(first_us, (int(np.searchsorted(noise_us, edges_us)) - 0.5) / within_us)

    def _shortest_between_alike(self) -> float:
        """Return the shortest interval between events of one sign that is to be believed."""
        all_us, opposite_us = self._shortest_us, self._opposite_us
        opposite_us = opposite_us[opposite_us <= all_us[-1]]
        equal = np.arange(opposite_us.size) - np.searchsorted(opposite_us, opposite_us)
        alike_us = np.delete(all_us, np.searchsorted(all_us, opposite_us) + equal)
        return float(alike_us[min(ORDER, alike_us.size) - 1])


def refractory_period(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    shape: tuple[int, int],
) -> Refractory:
    """Return the refractory period, as far as the events tell it.

    Parameters
    ----------
    t_us, x, y, on
        Events in time order, inside *shape* (height, width).

    """
    deafness = Deafness(shape)
    deafness.add(t_us, x, y, on)
    return deafness.period()


def _grown_towards(top_us: float, per_us: float) -> Refractory:
    """Return mean and standard deviation of a density ``exp(per_us · period)`` between zero and *top_us*."""
    steep = per_us * top_us
    if steep < 1e-3:
        return Refractory(0.5 * top_us, top_us / sqrt(12.0))
    if steep > MOST_STEEP:
        return Refractory(top_us - 1.0 / per_us, 1.0 / per_us)
    mean_us = top_us - 1.0 / per_us + top_us / expm1(steep)
    variance = 1.0 / per_us**2 - top_us**2 * exp(steep) / expm1(steep) ** 2
    return Refractory(mean_us, sqrt(variance))
