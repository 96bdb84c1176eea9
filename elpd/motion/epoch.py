"""One command in force: how it was laid out, what its reports have taught, and what can be asked of it."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from elpd.motion.kinematics import Knot, state_at
from elpd.motion.lessons import Lessons, Sensitivity
from elpd.motion.truncated import truncated
from elpd.units import NS_PER_S

if TYPE_CHECKING:
    from elpd.motion.commanded import Motion
    from elpd.records import LensReport

FURTHER_STEPS = 1.0
LOOK_STEP_NS = 1_000_000


@dataclass(slots=True)
class Epoch:
    """One command in force: its three layouts, what was learnt about it, and the reports that taught it.

    ``anchor`` is the state that it goes on from where that is not its predecessor's: steps, steps/s. ``nominal_ns``
    is when the command was expected to take effect and ``start_ns`` the value that the layouts are made around;
    ``delay`` is counted from there. Before ``not_before_ns`` it was seen not to have begun. ``alike`` is which share of
    a rounding error's variance its reports have in common: all of it where each was rounded at the same place between
    two positions, and one over their number where they were rounded anywhere (the square of the mean of the places,
    taken as directions).
    """

    nominal_ns: int
    start_ns: int
    motion: Motion
    delay_sigma_s: float
    number: int = 0
    anchor: tuple[float, float] | None = None
    not_before_ns: int = 0
    marked: bool = False
    steps: float = 0.0
    variance: float = 0.0
    path: list[Knot] = field(default_factory=list)
    later: list[Knot] = field(default_factory=list)
    further: list[Knot] = field(default_factory=list)
    later_s: float = 0.0
    lessons: Lessons = field(default_factory=Lessons)
    reports: list[LensReport] = field(default_factory=list)
    alike: float = 1.0

    def forget_lessons(self, pace_sigma: float) -> None:
        """Go back to what was supposed before any report."""
        begin_s, sigma_s = self.begins()
        delay = begin_s + (self.nominal_ns - self.start_ns) / NS_PER_S
        self.lessons = Lessons.supposed(self.variance, delay, sigma_s, pace_sigma)

    def begins(self) -> tuple[float, float]:
        """Return how much later than expected it takes effect and the standard deviation of that, before any report."""
        if not self.not_before_ns or not self.delay_sigma_s:
            return 0.0, self.delay_sigma_s
        return truncated(0.0, self.delay_sigma_s, (self.not_before_ns - self.nominal_ns) / NS_PER_S)

    def note_places(self, times_ns: list[int], quantum_steps: float) -> None:
        """Note where between two positions that can be told the motor was at those times, by what is known now."""
        places = [self.depends(when)[0] % quantum_steps / quantum_steps for when in times_ns]
        mean = sum(cmath.exp(2j * math.pi * place) for place in places) / len(places) if places else 1.0
        self.alike = abs(mean) ** 2

    def depends(self, when_ns: int) -> tuple[float, float, Sensitivity]:
        """Return position, velocity, and how the position depends on what is learnt."""
        steps, velocity = state_at(self.path, when_ns)
        h = Sensitivity(
            (state_at(self.further, when_ns)[0] - steps) / FURTHER_STEPS,
            (state_at(self.later, when_ns)[0] - steps) / self.later_s if self.later_s else 0.0,
            velocity * max(when_ns - self.start_ns, 0) / NS_PER_S,
        )
        return steps + self.lessons.shift(h), velocity, h

    def passed(self, steps: float, until_ns: int, while_ns: int) -> float | None:
        """Return the velocity at which it passed *steps* in the *while_ns* before *until_ns*; None: it did not."""
        when = until_ns
        after, velocity = state_at(self.path, when)
        while when > max(self.start_ns, until_ns - while_ns):
            when -= LOOK_STEP_NS
            before, velocity = state_at(self.path, max(when, self.start_ns))
            if min(before, after) <= steps <= max(before, after):
                return velocity
            after = before
        return None

    def hears_nothing_new(self, report: LensReport, when_ns: int) -> bool:
        """Say whether it has heard that before: at rest the same number again is the same rounding error again."""
        if not self.reports:
            return False
        last = self.reports[-1]
        vaguer = last.latest_ns - last.earliest_ns > 2 * (report.latest_ns - report.earliest_ns)
        again = report.steps == last.steps and not report.moving and not last.moving and not vaguer
        return again and state_at(self.path, when_ns)[1] == 0.0

    def strays_if_begun_early(self, when_ns: int, velocity_sps: float) -> float:
        """Return by how many steps (one sigma) it may have changed the motion already, at *when_ns* before its start.

        Until it begins the motor runs at *velocity_sps*. Taken from a beginning two standard deviations early.
        """
        early_s = 2.0 * math.sqrt(max(self.lessons.c_dd, 0.0))
        if self.not_before_ns:
            early_s = min(early_s, max(0.0, (self.start_ns - self.not_before_ns) / NS_PER_S))
        since_s = (when_ns - self.start_ns) / NS_PER_S + early_s
        if since_s <= 0.0:
            return 0.0
        began, _ = state_at(self.path, self.start_ns)
        now, _ = state_at(self.path, self.start_ns + round(since_s * NS_PER_S))
        return (now - began - velocity_sps * since_s) / 2.0
