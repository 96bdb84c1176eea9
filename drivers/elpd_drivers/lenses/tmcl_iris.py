"""A stepper iris on another motor of a TMCL module: met when connecting, turned at a command.

It has no switch and the module no memory of it, so its first closing in a session drives it against its closed stop:
its position is called further open than it can be, and it is sent to where it is closed. The motor stands still there
for the rest of the way, which a P-iris's does not mind.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.errors import ConfigError, LensError
from elpd_drivers.lenses import tmcl_wire as wire
from elpd_drivers.lenses.iris_axis import IrisPlace, iris_axis
from elpd_drivers.lenses.line import Trouble
from elpd_drivers.lenses.tmcl_talk import learn_units

if TYPE_CHECKING:
    from elpd_drivers.lenses.iris_axis import IrisAxis
    from elpd_drivers.lenses.line import Sent
    from elpd_drivers.lenses.tmcl_talk import Talk

MOTORS = range(6)
"""As the largest modules have them."""


class TmclIris:
    """One motor of a module.

    Parameters
    ----------
    talk
        The way to the module.
    axis
        Which motor, and where it goes.
    """

    def __init__(self, talk: Talk, axis: IrisAxis[int]) -> None:
        self._talk, self._place = talk, IrisPlace(axis)

    def meet(self) -> None:
        """See that the motor is there, and set its speed. Raises ``LensError`` or ``ConfigError`` if it cannot be."""
        axis, talk = self._place.axis, self._talk
        reply = talk.attempt(wire.GAP, wire.POSITION, motor=axis.axis)
        if reply.status != wire.OK:
            words = wire.STATUS_WORDS.get(reply.status, "unknown")
            raise LensError(
                f"lens port {talk.line.name}: the module has no motor {axis.axis} (lens.iris_axis; it answers with "
                f"status {reply.status}, {words}); motors count from 0"
            )
        units = learn_units(talk, axis.axis)
        if not units.fits(axis.speed_sps, 0.0):
            raise ConfigError(
                f"lens.iris_speed_sps is {axis.speed_sps:g}, the divisors of motor {axis.axis} allow "
                f"{wire.TMC429_MAX * units.speed_sps:.0f}; change one of them (axis parameter 154)"
            )
        talk.exchange(wire.SAP, wire.MAX_SPEED, units.speed(axis.speed_sps), motor=axis.axis)
        self._place.steps = None

    def turn(self, *, opened: bool) -> Sent:
        """Send it on its way. Nothing else may be in flight. Raises ``LensError`` for an opening before any closing."""
        axis, talk = self._place.axis, self._talk
        flags = talk.exchange(wire.GAP, wire.DRIVER_FLAGS, motor=axis.axis)
        words = ", ".join(word for bit, word in wire.DRIVER_WORDS.items() if flags & bit)
        if words:
            raise Trouble(f"the iris's motor driver stopped: {words} (flags {flags:#04x}); remove the cause")
        here, target = self._place.way(opened=opened)
        if self._place.steps is None:
            talk.exchange(wire.MST, motor=axis.axis)  # a position may be set where none is held
            talk.exchange(wire.SAP, wire.POSITION, here, motor=axis.axis)
        sent = talk.line.send(talk.frame(wire.MVP, wire.ABSOLUTE, target, motor=axis.axis))
        self._place.steps = target
        talk.confirm(wire.MVP)
        return sent


def tmcl_iris(talk: Talk) -> TmclIris | None:
    """Return the iris that the settings describe, if any. Raises ``ConfigError`` for settings that cannot be."""
    axis = iris_axis(talk.settings, talk.settings.motor, MOTORS)
    return None if axis is None else TmclIris(talk, axis)
