"""What was commanded: a velocity, a target, a halt; and the pieces of constant acceleration that this makes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from elpd.motion.kinematics import Piece, approach, in_segments, ramp


@dataclass(frozen=True, slots=True)
class Motion:
    """What was commanded: a velocity, an absolute target, or a halt (``velocity_sps`` 0, infinite acceleration).

    ``speed_sps`` bounds the way to ``target_steps`` and is unused otherwise. ``segment_s`` is the length of the
    firmware's constant-speed segments, 0 for none. ``rounding_steps`` is one standard deviation of what the firmware
    adds by itself (a stop goes on to the next whole step).
    """

    acceleration_sps2: float
    velocity_sps: float = 0.0
    target_steps: float | None = None
    speed_sps: float = 0.0
    segment_s: float = 0.0
    rounding_steps: float = 0.0

    def pieces(self, steps: float, velocity_sps: float) -> tuple[Piece, ...]:
        """Plan the motion from a state."""
        if self.target_steps is None:
            pieces = ramp(velocity_sps, self.velocity_sps, self.acceleration_sps2)
        else:
            pieces = approach(steps, velocity_sps, self.target_steps, self.speed_sps, self.acceleration_sps2)
        return in_segments(pieces, self.segment_s) if self.segment_s else pieces

    def changing_speed(self, velocity_sps: float) -> bool:
        """Say whether *velocity_sps* is on the way from or to what was commanded."""
        cruise = abs(self.velocity_sps) if self.target_steps is None else self.speed_sps
        return velocity_sps != 0.0 and abs(abs(velocity_sps) - cruise) > 1e-6 * max(cruise, 1.0)


REST = Motion(acceleration_sps2=math.inf, rounding_steps=0.3)
"""A halt without a ramp."""
