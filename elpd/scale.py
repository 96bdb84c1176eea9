"""The lens's ruler: motor steps to micrometres of focus travel, and back.

A lens that moves its sensor-side group on a screw has one number, micrometres per step. A lens with a cam, or one that
focuses by an inner group, has a table: the same step moves the image further at one end than at the other. Everything
between the driver and the vision speaks micrometres through a ``LensScale``; everything on the wire is steps.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise

from elpd.errors import ConfigError
from elpd.units import Steps


@dataclass(frozen=True, slots=True)
class LensScale:
    """How far the focus moves for how many steps.

    Parameters
    ----------
    um_per_step
        Micrometres per step where there is no table, and the nominal size of a step where there is.
    table
        Pairs ``(steps, um)``, at least two, both ascending: straight lines between them, and the first and last line go
        on beyond the ends. Empty for a lens that is one straight line through zero.

    Raises
    ------
    ConfigError
        If a step has no size or the table does not ascend, with the rows that are wrong.

    """

    um_per_step: float
    table: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        """Refuse what is no ruler."""
        if not self.um_per_step > 0:
            raise ConfigError(f"lens.um_per_step is {self.um_per_step:g}; a step must be more than 0 um long")
        if len(self.table) == 1:
            raise ConfigError("lens.steps_to_um has one row; a ruler needs two or more, or no table")
        for (steps, um), (next_steps, next_um) in pairwise(self.table):
            if not (next_steps > steps and next_um > um):
                raise ConfigError(
                    f"lens.steps_to_um must ascend in both columns; ({next_steps:g}, {next_um:g}) follows "
                    f"({steps:g}, {um:g}): sort it, and turn the sign of the motor rather than of the table"
                )

    def to_um(self, steps: float) -> float:
        """Convert steps to um."""
        if not self.table:
            return steps * self.um_per_step
        (s0, z0), (s1, z1) = self._row(steps, 0)
        return z0 + (steps - s0) * (z1 - z0) / (s1 - s0)

    def to_steps(self, um: float) -> Steps:
        """Convert um to the nearest step."""
        if not self.table:
            return Steps(round(um / self.um_per_step))
        (s0, z0), (s1, z1) = self._row(um, 1)
        return Steps(round(s0 + (um - z0) * (s1 - s0) / (z1 - z0)))

    def um_per_step_at(self, um: float) -> float:
        """Return how long a step is at a place."""
        if not self.table:
            return self.um_per_step
        (s0, z0), (s1, z1) = self._row(um, 1)
        return (z1 - z0) / (s1 - s0)

    def _row(self, value: float, column: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the two rows that *value* lies between, or the nearest two."""
        after = bisect_right(self.table, value, key=lambda row: row[column])
        after = min(max(after, 1), len(self.table) - 1)
        return self.table[after - 1], self.table[after]
