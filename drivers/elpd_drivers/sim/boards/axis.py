"""A stepper axis as controllers have it: a count of steps, two end switches, and the search for one of them.

The lens counts pulses from where it was made; a controller counts from where it was switched on, told, or homed, and
``offset`` is the difference. Motion itself is the lens's. Switches stop motion towards them and let go of the other
direction. A search runs fast onto a switch, then slowly off it; where it lets go is zero.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from elpd_drivers.sim.lens import SimulatedLens


class Search(Enum):
    """Where a search for a switch is."""

    NO = "no"
    TOWARDS = "towards"
    AWAY = "away"


class Happened(Enum):
    """What became of running into a switch, or off it."""

    LIMIT = "limit"
    TURNED = "turned"
    HOMED = "homed"
    NOTHING = "nothing"


class Axis:
    """One motor of a board.

    Parameters
    ----------
    lens
        What it turns.
    switches
        Whether the switches at the ends of the travel are wired.
    """

    def __init__(self, lens: SimulatedLens, *, switches: bool = True) -> None:
        self.lens = lens
        self.offset = 0
        self.search = Search.NO
        self.switch_ns: int | None = None
        self._switches = switches
        self._upwards, self._away_sps, self._acceleration_sps2 = False, 0.0, 1.0

    # --- what is read ----------------------------------------------------------------------------------------------

    def count_at(self, at_ns: int) -> int:
        """Return the last step that was made: the whole number just behind a moving motor."""
        return last_step(self.lens.pulses_at(at_ns), self.velocity_at(at_ns)) + self.offset

    def velocity_at(self, at_ns: int) -> float:
        """Return the speed of the pulses, steps/s."""
        return self.lens.velocity_at(at_ns)

    def at_switches(self, at_ns: int) -> tuple[bool, bool]:
        """Say whether the lower and the upper switch are pressed."""
        rotor = self.lens.rotor_at(at_ns)
        return rotor < -0.5, rotor > self.lens.travel_steps + 0.5

    # --- what is set -----------------------------------------------------------------------------------------------

    def power_up(self, at_ns: int, *, referenced: bool) -> None:
        """Begin with a count that is zero here, or (*referenced*) the one of an earlier homing."""
        pulses = self.lens.pulses_at(at_ns)
        self.offset = round(self.lens.rotor_at(at_ns) - pulses) if referenced else -round(pulses)
        self.search, self.switch_ns = Search.NO, None

    def set_count(self, at_ns: int, count: int) -> None:
        """Call where the motor is (or comes to rest) *count*."""
        rest_ns = self.lens.rest_from_ns()
        self.offset = count - round(self.lens.pulses_at(max(rest_ns or at_ns, at_ns)))

    # --- motion ----------------------------------------------------------------------------------------------------

    def move_to(self, at_ns: int, target: int, speed_sps: float, acceleration_sps2: float) -> None:
        """Move to a count and rest there."""
        self.search = Search.NO
        self.lens.move_to(at_ns, target - self.offset, speed_sps, acceleration_sps2)
        self._watch(at_ns, target - self.offset - self.lens.pulses_at(at_ns))

    def ramp(self, at_ns: int, velocity_sps: float, acceleration_sps2: float) -> None:
        """Ramp to a velocity and keep it; to none, and rest on a whole step."""
        self.search = Search.NO
        self._ramp(at_ns, velocity_sps, acceleration_sps2)
        self._watch(at_ns, velocity_sps or self.velocity_at(at_ns))

    def halt(self, at_ns: int) -> None:
        """Stop on the next whole step, without a ramp."""
        self.search, self.switch_ns = Search.NO, None
        self.lens.halt(at_ns)

    def home(self, at_ns: int, *, upwards: bool, towards_sps: float, away_sps: float, acceleration_sps2: float) -> None:
        """Search for a switch."""
        self.search, self._upwards = Search.TOWARDS, upwards
        self._away_sps, self._acceleration_sps2 = away_sps, acceleration_sps2
        way = 1.0 if upwards else -1.0
        self._ramp(at_ns, way * towards_sps, acceleration_sps2)
        self._watch(at_ns, way)

    def happen(self, at_ns: int) -> Happened:
        """Let the switch act that the motor has reached at *at_ns* (its ``switch_ns``)."""
        self.switch_ns = None
        if self.search is Search.TOWARDS:
            self.lens.halt(at_ns)
            self.search = Search.AWAY
            self._ramp(at_ns, -self._away_sps if self._upwards else self._away_sps, self._acceleration_sps2)
            edge = self.lens.travel_steps + 0.5 if self._upwards else -0.5
            self.switch_ns = self.lens.reaches(edge, at_ns, upwards=not self._upwards)
            return Happened.TURNED
        if self.search is Search.AWAY:
            self.halt(at_ns)
            self.set_count(at_ns, 0)
            return Happened.HOMED
        if self.velocity_at(at_ns) != 0.0:
            self.halt(at_ns)
            return Happened.LIMIT
        return Happened.NOTHING

    def _ramp(self, at_ns: int, velocity_sps: float, acceleration_sps2: float) -> None:
        now_sps = self.velocity_at(at_ns)
        if velocity_sps == 0.0 and now_sps != 0.0:
            # a controller counts whole steps, and rests on one
            end = self.lens.pulses_at(at_ns) + now_sps * abs(now_sps) / (2 * acceleration_sps2)
            rest = math.ceil(end - 1e-6) if now_sps > 0.0 else math.floor(end + 1e-6)
            self.lens.move_to(at_ns, rest, abs(now_sps), acceleration_sps2)
        else:
            self.lens.set_velocity(at_ns, velocity_sps, acceleration_sps2)

    def _watch(self, from_ns: int, heading: float) -> None:
        """Find out when the planned path runs into the switch that it heads for."""
        self.switch_ns = None
        if self._switches:
            upwards = heading > 0
            edge = self.lens.travel_steps + 1.0 if upwards else -1.0
            self.switch_ns = self.lens.reaches(edge, from_ns, upwards=upwards)


def last_step(pulses: float, velocity_sps: float) -> int:
    """Return the last step that was made: the whole number just behind a moving motor."""
    if velocity_sps > 0.0:
        return math.floor(pulses + 1e-6)
    if velocity_sps < 0.0:
        return math.ceil(pulses - 1e-6)
    return round(pulses)
