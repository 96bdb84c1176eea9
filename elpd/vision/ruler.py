"""Where the lens was when: the ruler on which focus is measured.

A recorded sweep comes with a path, a speed, or nothing. With nothing, motion is taken as constant and the ruler is
time itself; everything in this room that looks for focus is free of scale, so it works on either.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Ruler:
    """A piecewise linear lens path.

    Attributes
    ----------
    times_us, positions:
        Knots, times strictly rising. Outside them the end velocities go on where ``endless``, else the lens rests.
    in_um:
        Whether positions are micrometres; otherwise they are microseconds of a motion that is taken as constant.
    """

    times_us: NDArray[np.float64]
    positions: NDArray[np.float64]
    in_um: bool
    endless: bool = False

    @classmethod
    def of_time(cls) -> Ruler:
        """Return the ruler of a sweep of which nothing is known: one unit per microsecond."""
        return cls(np.array([0.0, 1.0]), np.array([0.0, 1.0]), in_um=False, endless=True)

    @classmethod
    def of_speed(cls, um_per_s: float) -> Ruler:
        """Return the ruler of a constant speed. Its sign and origin do not matter."""
        if not np.isfinite(um_per_s) or um_per_s == 0.0:
            raise UsageError(f"the lens speed must be a number other than zero; got {um_per_s} um/s")
        return cls(np.array([0.0, 1e6]), np.array([0.0, abs(um_per_s)]), in_um=True, endless=True)

    @classmethod
    def of_path(cls, times_us: NDArray[np.float64], positions_um: NDArray[np.float64]) -> Ruler:
        """Return the ruler of a measured path."""
        if times_us.size < 2 or not np.isfinite(times_us).all() or not np.isfinite(positions_um).all():
            raise UsageError(f"a lens path needs two finite rows or more; got {times_us.size}")
        if (np.diff(times_us) <= 0).any():
            raise UsageError("the times of a lens path must rise from row to row")
        return cls(times_us.astype(np.float64), positions_um.astype(np.float64), in_um=True)

    def at(self, t_us: NDArray[np.int64] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions at times."""
        t = np.asarray(t_us, dtype=np.float64)
        if self.endless:
            rate = (self.positions[-1] - self.positions[0]) / (self.times_us[-1] - self.times_us[0])
            return np.asarray(self.positions[0] + (t - self.times_us[0]) * rate)
        return np.asarray(np.interp(t, self.times_us, self.positions))

    def position(self, t_us: float) -> float:
        """Return the position at one time."""
        return float(self.at(np.array([t_us], dtype=np.float64))[0])

    def stretch(self, t_us: float) -> tuple[float, float, float]:
        """Return (begin_us, end_us, sign) of the motion in one direction around *t_us*, first move to last.

        Rests on the way do not end it, only a reversal does. The sign is zero where the lens never moved before.
        """
        if self.endless:
            return -np.inf, np.inf, 1.0
        signs = np.sign(np.diff(self.positions))
        k = int(np.clip(np.searchsorted(self.times_us, t_us, side="right") - 1, 0, signs.size - 1))
        # A rest belongs to the motion before it: events still answer to it.
        while signs[k] == 0 and k > 0:
            k -= 1
        if signs[k] == 0:
            return float(self.times_us[0]), float(self.times_us[1]), 0.0
        against = np.flatnonzero(signs == -signs[k])
        turns = np.searchsorted(against, k)
        first = against[turns - 1] + 1 if turns > 0 else 0
        last = against[turns] if turns < against.size else signs.size
        moves = first + np.flatnonzero(signs[first:last])
        return float(self.times_us[moves[0]]), float(self.times_us[moves[-1] + 1]), float(signs[k])

    def time_of(self, position: float, near_us: float) -> float:
        """Return when the lens was at *position*, in the stretch of motion around *near_us*."""
        if self.endless:
            rate = (self.positions[-1] - self.positions[0]) / (self.times_us[-1] - self.times_us[0])
            return float(self.times_us[0] + (position - self.positions[0]) / rate)
        begin, end, sign = self.stretch(near_us)
        inside = (self.times_us >= begin) & (self.times_us <= end)
        return float(np.interp(sign * position, sign * self.positions[inside], self.times_us[inside]))

    def speed_at(self, t_us: float, over_us: float = 1000.0) -> float:
        """Return the magnitude of the velocity around *t_us*, in units per microsecond."""
        return abs(self.position(t_us + over_us) - self.position(t_us - over_us)) / (2.0 * over_us)
