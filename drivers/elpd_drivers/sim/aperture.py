"""An iris that takes its time.

The temporal map is made while the aperture opens, so what matters here is light over time: a mechanical delay after
the command, then a diameter that grows linearly. An iris passes light in proportion to its area, T = (t / opening)²;
a curtain or slit in proportion to t. The state is a short list of (instant, diameter) knots, which also makes a close
command during an opening come out right.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from elpd.errors import ConfigError
from elpd.records import CommandStamp
from elpd.units import NS_PER_MS, NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.ports import Clock

PROFILES = ("iris", "linear")
SLOWEST_DELAY_MS = 6.0
SLOW_FACTOR = 4.0
KEPT_KNOTS = 32


class Opening(Protocol):
    """What light has to get through."""

    def transmittance_at(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the true transmittance at host instants."""
        ...

    @property
    def began_ns(self) -> float:
        """The instant at which light last began to come."""
        ...


class SimulatedAperture:
    """``elpd.ports.Aperture`` in virtual time. Closed at first.

    Parameters
    ----------
    opening_ms
        Time of the blades from closed to open.
    profile
        ``iris`` (T = s²) or ``linear`` (T = s), s being the fraction of the travel.
    fault
        ``None``, ``"stuck"`` (commands are ignored) or ``"slow"`` (takes four times as long as it says).
    rng
        Draws the mechanical delay, 2 to 5 ms.
    """

    def __init__(
        self,
        clock: Clock,
        rng: np.random.Generator,
        *,
        opening_ms: float = 20.0,
        profile: str = "iris",
        fault: str | None = None,
    ) -> None:
        if profile not in PROFILES:
            raise ConfigError(f"sim.aperture_profile is {profile!r}; known: {', '.join(PROFILES)}")
        if opening_ms <= 0:
            raise ConfigError(f"sim.aperture_ms is {opening_ms}; the opening takes some time, give more than 0")
        self._clock = clock
        self._opening_ms = opening_ms
        self._exponent = 2.0 if profile == "iris" else 1.0
        self._stuck = fault == "stuck"
        self._travel_ns = opening_ms * NS_PER_MS * (SLOW_FACTOR if fault == "slow" else 1.0)
        self._delay_ns = float(rng.uniform(2.0, 5.0)) * NS_PER_MS
        self._knots: list[tuple[float, float]] = [(0.0, 0.0)]

    def open(self) -> CommandStamp:
        """Start to open, after the mechanical delay."""
        return self._drive_to(1.0, "open")

    def close(self) -> CommandStamp:
        """Start to close, after the mechanical delay."""
        return self._drive_to(0.0, "close")

    @property
    def opening_ms(self) -> float:
        """From command to fully open, at the most, if nothing is wrong with it."""
        return self._opening_ms + SLOWEST_DELAY_MS

    def transmittance(self, since_open_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the nominal transmittance at times after the blades began to open."""
        fraction = np.clip(np.asarray(since_open_us, np.float64) / (self._opening_ms * 1e3), 0.0, 1.0)
        return np.asarray(fraction**self._exponent)

    def transmittance_at(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the true transmittance at host instants."""
        instants = [knot[0] for knot in self._knots]
        diameters = [knot[1] for knot in self._knots]
        return np.asarray(np.interp(times_ns, instants, diameters) ** self._exponent, np.float64)

    @property
    def began_ns(self) -> float:
        """The instant at which the blades last began to move: what a temporal map should find."""
        return self._knots[-2][0] if len(self._knots) > 1 else 0.0

    def _drive_to(self, target: float, command: str) -> CommandStamp:
        now = self._clock.now_ns()
        if not self._stuck:
            begin_ns = now + self._delay_ns
            diameter = float(np.interp(begin_ns, [k[0] for k in self._knots], [k[1] for k in self._knots]))
            kept = [knot for knot in self._knots if knot[0] < begin_ns][-KEPT_KNOTS:]
            end_ns = begin_ns + abs(target - diameter) * self._travel_ns
            self._knots = [*kept, (begin_ns, diameter), (end_ns + 1.0, target)]
        return CommandStamp(command, now, now)


class StepperIris:
    """A P-iris on a stepper: blades that follow a motor, whoever commands that.

    Steps count from the closed stop. Over the first and last ``DEAD_SHARE`` of the way the blades do not change the
    light; between, the diameter of the hole grows evenly with the steps, so light with their square.

    Parameters
    ----------
    steps
        From stop to stop.
    at_steps
        Where it is when its day begins.
    """

    DEAD_SHARE = 0.05

    def __init__(self, steps: float, *, at_steps: float = 0.0) -> None:
        if steps <= 0:
            raise ConfigError(f"sim.iris_steps is {steps:g}; an iris has some way to go, give more than 0")
        self.steps = float(steps)
        self._knots: list[tuple[float, float]] = [(0.0, at_steps)]

    def steps_at(self, times_ns: NDArray[np.int64] | int) -> NDArray[np.float64]:
        """Return where its motor is at instants."""
        return np.asarray(
            np.interp(times_ns, [knot[0] for knot in self._knots], [knot[1] for knot in self._knots]), np.float64
        )

    def turn(self, at_ns: int, target_steps: float, speed_sps: float) -> int:
        """Go to *target_steps* from *at_ns* on, no further than its stops; return when it is there."""
        here = float(self.steps_at(at_ns))
        target = min(max(target_steps, 0.0), self.steps)
        end_ns = at_ns + abs(target - here) / speed_sps * NS_PER_S
        kept = [knot for knot in self._knots if knot[0] < at_ns][-KEPT_KNOTS:]
        self._knots = [*kept, (float(at_ns), here), (end_ns + 1.0, target)]
        return round(end_ns)

    def halt(self, at_ns: int) -> None:
        """Stay where it is."""
        here = float(self.steps_at(at_ns))
        kept = [knot for knot in self._knots if knot[0] < at_ns][-KEPT_KNOTS:]
        self._knots = [*kept, (float(at_ns), here)]

    def transmittance_at(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the true transmittance at host instants."""
        grown = (self.steps_at(times_ns) / self.steps - self.DEAD_SHARE) / (1.0 - 2.0 * self.DEAD_SHARE)
        return np.asarray(np.clip(grown, 0.0, 1.0) ** 2, np.float64)

    @property
    def began_ns(self) -> float:
        """The instant at which light last began to come: past the dead share of an opening."""
        (begin_ns, here), (end_ns, target) = self._knots[-2:] if len(self._knots) > 1 else [self._knots[0]] * 2
        lit = self.DEAD_SHARE * self.steps
        if target <= here or not here <= lit <= target:
            return begin_ns
        return begin_ns + (end_ns - begin_ns) * (lit - here) / (target - here)
