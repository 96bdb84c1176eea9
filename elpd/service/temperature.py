"""Temperature and focus: a table, and how far the lens should go for a reading. Pure.

The table tells how far focus moves, not where it is: what counts is the difference to the temperature at which focus
was last found. Beyond its ends the table is held, not continued.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from elpd.service.kept import Thermometer


def table_um(table: Sequence[tuple[float, float]], celsius: float) -> float:
    """Return the table's value at a temperature: straight lines between rows, held beyond the ends."""
    after = bisect_right(table, celsius, key=lambda row: row[0])
    if after == 0:
        return table[0][1]
    if after == len(table):
        return table[-1][1]
    (c0, um0), (c1, um1) = table[after - 1], table[after]
    return um0 + (celsius - c0) * (um1 - um0) / (c1 - c0)


def offset_um(table: Sequence[tuple[float, float]], then: Thermometer, celsius: float) -> float:
    """Return how far focus has moved since it was found."""
    return table_um(table, celsius) - table_um(table, then.celsius)


def target_um(
    wanted_um: float, here_um: float, limits_um: tuple[float, float], *, step_um: float, max_step_um: float
) -> float | None:
    """Return where to go, ``None`` where it is not worth a move: inside the limits, and no further than one step."""
    low_um, high_um = limits_um
    wanted_um = min(max(wanted_um, low_um), high_um)
    way_um = min(max(wanted_um - here_um, -max_step_um), max_step_um)
    return None if abs(way_um) < step_um else here_um + way_um
