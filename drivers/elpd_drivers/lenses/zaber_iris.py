"""A stepper iris on another axis of a Zaber device, which homes that axis by itself and knows whether it has.

The first closing since power-up is the homing of its axis, to its closed end.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from elpd.errors import ConfigError
from elpd_drivers.lenses import zaber_wire as wire
from elpd_drivers.lenses.iris_axis import IrisPlace

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd_drivers.lenses.iris_axis import IrisAxis
    from elpd_drivers.lenses.line import Sent


class ZaberIris:
    """One axis of a device.

    Parameters
    ----------
    axis
        Which, and where it goes.
    exchange
        Sends words to an axis and returns the reply.
    order
        Sends words to an axis; its reply is looked at later.
    """

    def __init__(
        self, axis: IrisAxis[int], exchange: Callable[[str, int], wire.Reply], order: Callable[[int, str], Sent]
    ) -> None:
        self._place = IrisPlace(axis)
        self._exchange, self._order = exchange, order

    @property
    def axis(self) -> int:
        """Which axis it is."""
        number: int = self._place.axis.axis
        return number

    def meet(self) -> None:
        """See that the axis is there, can reach both places, and whether it knows where it is."""
        axis = self._place.axis
        low, high = (self._number(f"limit.{end}") for end in ("min", "max"))
        for name, steps in (("iris_closed", axis.closed_steps), ("iris_open", axis.open_steps)):
            if not low <= steps <= high:
                raise ConfigError(
                    f"lens.{name} is {steps}, axis {axis.axis} of the device goes from {low:g} to {high:g}; "
                    "change one of them"
                )
        fastest_sps = self._number("maxspeed") / wire.SPEED_PER_SPS
        if axis.speed_sps > fastest_sps * (1 + 1e-6):
            raise ConfigError(
                f"lens.iris_speed_sps is {axis.speed_sps:g}, axis {axis.axis} of the device makes {fastest_sps:.0f} "
                "at the most (its maxspeed); change one of them"
            )
        position = self._exchange("get pos", axis.axis)
        self._place.steps = None if position.flag in wire.NOT_REFERENCED else round(float(position.data))

    def turn(self, *, opened: bool) -> Sent:
        """Open or close it. Raises ``LensError`` for an opening before any closing."""
        axis, first = self._place.axis, self._place.steps is None
        _, target = self._place.way(opened=opened)
        self._place.steps = target
        if first:
            return self._order(axis.axis, "home")
        units = max(1, math.floor(axis.speed_sps * wire.SPEED_PER_SPS + 1e-6))
        return self._order(axis.axis, f"move abs {target} {units}")

    def _number(self, setting: str) -> float:
        return float(self._exchange(f"get {setting}", self._place.axis.axis).data)
