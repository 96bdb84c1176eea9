"""A motor of a board that turns an iris: it counts its own steps, and at the iris's stops it makes them in vain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.units import NS_PER_S

if TYPE_CHECKING:
    from elpd_drivers.sim.aperture import StepperIris


class IrisMotor:
    """A motor without a switch, at a constant speed.

    Parameters
    ----------
    iris
        What it turns.
    """

    def __init__(self, iris: StepperIris) -> None:
        self.iris = iris
        self._begin, self._end = (0, 0.0), (1, 0.0)

    def count_at(self, at_ns: int) -> int:
        """Return how far it has counted."""
        (begin_ns, begin), (end_ns, end) = self._begin, self._end
        return round(float(np.interp(at_ns, [begin_ns, end_ns], [begin, end])))

    def moving_at(self, at_ns: int) -> bool:
        """Say whether it makes steps."""
        return self._begin[1] != self._end[1] and at_ns < self._end[0]

    def set_count(self, at_ns: int, count: int) -> None:
        """Call where it is *count*; it stays there."""
        self.iris.halt(at_ns)
        self._begin, self._end = (at_ns, float(count)), (at_ns + 1, float(count))

    def halt(self, at_ns: int) -> None:
        """Stay where it is."""
        self.set_count(at_ns, self.count_at(at_ns))

    def move_to(self, at_ns: int, count: int, speed_sps: float) -> None:
        """Count to *count*, and turn the iris as far as that goes."""
        here = self.count_at(at_ns)
        self.iris.turn(at_ns, float(self.iris.steps_at(at_ns)) + count - here, speed_sps)
        ends_ns = at_ns + max(1, round(abs(count - here) / speed_sps * NS_PER_S))
        self._begin, self._end = (at_ns, float(here)), (ends_ns, float(count))
