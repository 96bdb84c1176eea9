"""When, between a question and its answer, a controller looked where it was: what is supposed, and what replies teach.

How late a controller looks is known beforehand as one number with its standard deviation, that of a single reply. Part
of it is chance, reply by reply, and averages away; the rest (an adapter's own delay, a firmware's) is the same for all
of them and for commands too, and no number of replies shows it. But replies show the first part, by how they scatter
round the motion; what it leaves of the whole is the second. Before there are any, half of the variance goes to each.

And no reply was sampled after it had come: where answers come sooner than was supposed, the shared delay cannot be as
long either. It is what was supposed, cut off between nothing and what the quickest replies took.
"""

from __future__ import annotations

import math

from elpd.motion.truncated import truncated
from elpd.units import NS_PER_S

SUPPOSED = 4.0
"""What is supposed of the scatter counts as much as so many replies that show nothing else."""

FAR = 9.0
"""A surprise of three standard deviations; further ones are accidents, and count as this."""

QUICKEST = 3
"""So many replies must have been as quick: one may have been taken for the answer to a later question."""

MOVED = 0.1
"""By which share of its standard deviation the usual delay must change to be used: old reports are gone through."""


class ReplyTime:
    """The delay from the earliest possible instant of sampling to the actual one.

    Parameters
    ----------
    usual_ns, sigma_ns
        What is supposed of it, and the standard deviation of that for one reply.
    """

    def __init__(self, usual_ns: float, sigma_ns: float) -> None:
        self._supposed_s = usual_ns / NS_PER_S
        self._whole = (sigma_ns / NS_PER_S) ** 2
        self._chance = self._whole / 2
        self._weight = SUPPOSED / (2 * self._chance**2) if self._chance else math.inf
        self._quickest_s = [math.inf] * QUICKEST
        self._told: tuple[float, float] | None = None
        """What is shared, until something is learnt; it is asked for with each position."""
        self.usual_ns = round(usual_ns)
        """The delay that replies are dated with."""

    @property
    def chance_s(self) -> float:
        """Standard deviation from one reply to the next, seconds."""
        return math.sqrt(self._chance)

    @property
    def common_s(self) -> float:
        """Standard deviation of what all of them share, seconds."""
        return self._shared()[1]

    def scattered(self, surprise_steps: float, velocity_sps: float, other_variance: float) -> None:
        """Learn from a reply that was so far from what was expected, where all but its time has that variance."""
        if self._weight == math.inf or not velocity_sps:
            return
        v2 = velocity_sps * velocity_sps
        expected = other_variance + v2 * self._chance
        seen = (min(surprise_steps**2, FAR * expected) - other_variance) / v2
        weight = v2 * v2 / (2 * expected * expected)
        self._weight += weight
        self._chance += (seen - self._chance) * weight / self._weight
        self._chance = min(max(self._chance, 0.0), self._whole)
        self._told = None

    def took(self, width_ns: float) -> bool:
        """Learn how long a reply took at the most; say whether replies are dated otherwise from now on."""
        width_s = width_ns / NS_PER_S
        if self._weight == math.inf or width_s >= self._quickest_s[-1]:
            return False
        self._quickest_s = sorted([*self._quickest_s[:-1], width_s])
        self._told = None
        usual_s, sigma_s = self._shared()
        if abs(usual_s * NS_PER_S - self.usual_ns) < MOVED * sigma_s * NS_PER_S:
            return False
        self.usual_ns = round(usual_s * NS_PER_S)
        return True

    def _shared(self) -> tuple[float, float]:
        if self._told is None:
            self._told = self._cut_off()
        return self._told

    def _cut_off(self) -> tuple[float, float]:
        """Return the shared delay and its standard deviation: a normal distribution, cut off at both ends."""
        if self._weight == math.inf:
            return self._supposed_s, 0.0
        # more of the whole may be shared, by one standard deviation of what is known of the split
        variance = min(self._whole - self._chance + self._weight**-0.5, self._whole)
        # a scatter of that standard deviation, evenly spread, reaches sqrt(3) of it below its mean
        longest_s = self._quickest_s[-1] + math.sqrt(3 * self._chance)
        return truncated(self._supposed_s, math.sqrt(variance), 0.0, longest_s)
