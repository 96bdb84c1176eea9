"""What reports teach about one command: a Kalman filter on three numbers.

*offset*, how far the motor was from where the model had it; *delay*, how much later the command took effect than
supposed; *pace*, by which share the motor runs faster than it was told (a controller rounds its pulses' period). They
are small, so a position depends on them linearly, by the ``Sensitivity`` at its instant.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """How a position depends on the three: steps per step, steps per second, steps per unit share."""

    offset: float
    delay: float
    pace: float


@dataclass(slots=True)
class Lessons:
    """The three numbers as learnt so far, and their covariance (``c_`` and two initials)."""

    offset: float = 0.0
    delay: float = 0.0
    pace: float = 0.0
    c_oo: float = 0.0
    c_od: float = 0.0
    c_op: float = 0.0
    c_dd: float = 0.0
    c_dp: float = 0.0
    c_pp: float = 0.0

    @classmethod
    def supposed(cls, offset_variance: float, delay: float, delay_sigma_s: float, pace_sigma: float) -> Lessons:
        """Return what is supposed before any report."""
        return cls(delay=delay, c_oo=offset_variance, c_dd=delay_sigma_s**2, c_pp=pace_sigma**2)

    def shift(self, h: Sensitivity) -> float:
        """Return by how many steps they move a position."""
        return h.offset * self.offset + h.delay * self.delay + h.pace * self.pace

    def variance(self, h: Sensitivity) -> float:
        """Return the variance that they give a position, steps squared."""
        o, d, p = self._towards(h)
        return h.offset * o + h.delay * d + h.pace * p

    def correct(self, surprise_steps: float, h: Sensitivity, noise: float) -> None:
        """Learn from a position that was *surprise_steps* from the expected one, with a variance of *noise* itself."""
        o, d, p = self._towards(h)
        spread = h.offset * o + h.delay * d + h.pace * p + noise
        gain_o, gain_d, gain_p = o / spread, d / spread, p / spread
        self.offset += gain_o * surprise_steps
        self.delay += gain_d * surprise_steps
        self.pace += gain_p * surprise_steps
        self.c_oo -= gain_o * o
        self.c_od -= gain_o * d
        self.c_op -= gain_o * p
        self.c_dd -= gain_d * d
        self.c_dp -= gain_d * p
        self.c_pp -= gain_p * p

    def _towards(self, h: Sensitivity) -> tuple[float, float, float]:
        """Return the covariance times *h*."""
        return (
            self.c_oo * h.offset + self.c_od * h.delay + self.c_op * h.pace,
            self.c_od * h.offset + self.c_dd * h.delay + self.c_dp * h.pace,
            self.c_op * h.offset + self.c_dp * h.delay + self.c_pp * h.pace,
        )
