"""A stepper iris on motor B or C of a Kurokesu SCF4. Untested on hardware.

It has no switch that could be relied on, so its first closing in a session drives it against its closed stop, as
P-irises are made for: a bounded move, a tenth longer than its whole way. Its motor is turned while the lens rests only,
and while it rests itself: what a move does during another one the board's papers do not say. That it got there is read
in the board's own count; a count that is not where the move led is a fault, and the move is never sent twice.

How fast a code of ``M240`` is, is known from homing motor A, and taken to be alike for all motors of the board.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.errors import LensError
from elpd_drivers.lenses import scf4_wire as wire
from elpd_drivers.lenses.iris_axis import IrisPlace
from elpd_drivers.lenses.line import Trouble

if TYPE_CHECKING:
    from elpd_drivers.lenses.iris_axis import IrisAxis
    from elpd_drivers.lenses.line import Line, Sent


class Scf4Iris:
    """Motor B or C.

    Parameters
    ----------
    line
        The way to the board.
    axis
        Which motor, and where it goes.
    """

    def __init__(self, line: Line, axis: IrisAxis[str]) -> None:
        self._line, self._place = line, IrisPlace(axis)
        self._turned_ns = 0
        self._stands = True

    def forget(self) -> None:
        """Learn that the board counts anew: nobody knows where it is."""
        self._place.steps, self._stands = None, True

    def heed(self, line: str, asked_ns: int) -> None:
        """Learn from a status that was asked for at *asked_ns*. Raises ``Trouble`` if it stands elsewhere."""
        motor, steps = self._place.axis.axis, self._place.steps
        status = wire.parse_status(line, motor)
        if status is None or steps is None or asked_ns <= self._turned_ns:
            return
        self._stands = not status.moving
        count = wire.HOMED_COUNT + steps
        if self._stands and status.count != count:
            raise Trouble(
                f"the iris's motor {motor} stands at {status.count} instead of {count}; see that its way is "
                "free (lens.iris_open, iris_closed), and switch the board off and on"
            )

    def turn(self, code: int, relative: str, *, opened: bool) -> Sent | None:
        """Send it on its way, at *code*; ``None`` if it is there. Raises ``LensError`` if it cannot go now."""
        if not self._stands:
            raise LensError("lens: the iris still turns, and an SCF4 is told nothing before it stands; wait for it")
        motor, (here, target) = self._place.axis.axis, self._place.way(opened=opened)
        orders = [relative, f"M240 {motor}{code}"]
        if self._place.steps is None:
            orders.append(f"G92 {motor}{wire.HOMED_COUNT + here}")
        if here == target:
            return None
        orders.append(f"G0 {motor}{target - here}")
        sent = self._line.send(b"".join(wire.order(order) for order in orders))
        self._place.steps, self._turned_ns, self._stands = target, sent.off_wire_ns, False
        return sent
