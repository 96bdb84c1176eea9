"""The stepper iris of a Theia lens, on motor 3 of its MCR board.

It has no switch, so its first closing in a session drives it against its closed stop, as the maker's library does; its
command 0x66 closes, 0x62 opens. While it turns the board reads nothing, not even for the lens, and while the lens moves
nothing for the iris. Whether the blades got there nobody tells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.errors import ConfigError
from elpd_drivers.lenses import theia_wire as wire
from elpd_drivers.lenses.iris_axis import INTO_STOP, IrisPlace, iris_axis

if TYPE_CHECKING:
    from elpd_drivers.lenses.iris_axis import IrisAxis
    from elpd_drivers.lenses.theia_settings import TheiaSettings

IRIS_MOTOR = 3
SLOWEST_PPS, FASTEST_PPS = 10, 200
"""As the maker's library sets such a motor up."""


@dataclass(frozen=True, slots=True)
class Turn:
    """A message that turns it, and how long that takes."""

    message: bytes
    takes_s: float


class TheiaIris:
    """Motor 3.

    Parameters
    ----------
    axis
        Where it goes.
    """

    motor = IRIS_MOTOR

    def __init__(self, axis: IrisAxis[int]) -> None:
        self._place = IrisPlace(axis)
        self._pace = math.floor(axis.speed_sps + 1e-6)

    def setup(self) -> wire.Setup:
        """Return what the board is to be told of it."""
        axis = self._place.axis
        longest = math.ceil(INTO_STOP * abs(axis.open_steps - axis.closed_steps))
        return wire.Setup(
            high_stop=False, low_stop=False, steps=longest, slowest_pps=SLOWEST_PPS, fastest_pps=FASTEST_PPS
        )

    def turn(self, *, opened: bool) -> Turn | None:
        """Return what sends it on its way, ``None`` if it is there. Raises ``LensError`` before any closing."""
        here, target = self._place.way(opened=opened)
        self._place.steps = target
        way = target - here
        if way == 0:
            return None
        return Turn(wire.move(IRIS_MOTOR, -way, self._pace), abs(way) / self._pace)


def theia_iris(settings: TheiaSettings) -> TheiaIris | None:
    """Return the iris that the settings describe, if any. Raises ``ConfigError`` for settings that cannot be."""
    axis = iris_axis(settings, settings.motor, (IRIS_MOTOR,))
    if axis is None:
        return None
    if not SLOWEST_PPS <= axis.speed_sps <= FASTEST_PPS:
        raise ConfigError(
            f"lens.iris_speed_sps is {axis.speed_sps:g}; a Theia board turns its iris at {SLOWEST_PPS} to {FASTEST_PPS}"
        )
    if axis.open_steps < axis.closed_steps or INTO_STOP * (axis.open_steps - axis.closed_steps) > wire.LONGEST_MOVE:
        raise ConfigError(
            f"lens.iris_open is {axis.open_steps}, iris_closed {axis.closed_steps}: open is above closed on a Theia "
            "board, by some 75 steps; correct them"
        )
    return TheiaIris(axis)
