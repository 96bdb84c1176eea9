"""How far a lens goes on after it was told to stop, and how well that is known.

From the stop's byte a controller keeps its speed for a while (GRBL: 45 ms) and then brakes: ``v·onset + v²/2a``. Both
numbers come with the lens's capabilities: its driver's own, or what `elpd calibrate lens` measured. The uncertainty is
that of the onset from one stop to the next, and that of the deceleration where it was measured; it is kept in time
(the error of the way, divided by the speed), because that is what it is made of.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from elpd.records import LensCapabilities, LensLimits

SURELY_SIGMAS = 2.0
"""A limit is kept by the way that a stop takes at the most; one in forty is longer, and ends in the driver's limit."""

AFFORDABLE_DOF = 5.0
"""A lens that goes on for more than so many depths of focus sweeps past and returns; a shorter way needs no plan."""


@dataclass(frozen=True, slots=True)
class Braking:
    """A stop from a speed: the way to rest, um; its parts; ``sigma_um`` is one standard deviation."""

    speed_um_s: float
    onset_ms: float
    onset_sigma_ms: float
    ramp_um: float

    @property
    def um(self) -> float:
        """The way from the stop's byte to rest, as expected."""
        return self.speed_um_s * self.onset_ms / 1000.0 + self.ramp_um

    @property
    def sigma_um(self) -> float:
        """One standard deviation of the way."""
        return self.speed_um_s * self.onset_sigma_ms / 1000.0

    @property
    def longest_um(self) -> float:
        """The way from the stop's byte to rest, at the most."""
        return self.speed_um_s * (self.onset_ms + SURELY_SIGMAS * self.onset_sigma_ms) / 1000.0 + self.ramp_um

    def stops_on_detect(self, depth_of_focus_um: float) -> bool:
        """Say whether a stop ends near enough to focus to be worth calling one: else sweep past, and return."""
        return self.longest_um <= AFFORDABLE_DOF * depth_of_focus_um


def braking_from(speed_um_s: float, capabilities: LensCapabilities, limits: LensLimits, um_per_step: float) -> Braking:
    """Predict a stop from *speed_um_s* in the mode that a cycle uses: abrupt where the controller can."""
    deceleration_sps2 = capabilities.stop_deceleration_sps2
    if deceleration_sps2 is None and not capabilities.abrupt_stop:
        deceleration_sps2 = limits.acceleration_sps2
    ramp_um, ramp_sigma_ms = 0.0, 0.0
    if deceleration_sps2 is not None:
        ramp_um = speed_um_s**2 / (2 * deceleration_sps2 * um_per_step)
        doubt = capabilities.stop_deceleration_sigma_sps2 / deceleration_sps2
        ramp_sigma_ms = 1000.0 * doubt * ramp_um / speed_um_s
    sigma_ms = math.hypot(capabilities.stop_onset_sigma_ms, ramp_sigma_ms)
    return Braking(speed_um_s, capabilities.stop_onset_ms, sigma_ms, ramp_um)
