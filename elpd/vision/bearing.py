"""Which way is focus while the scene moves: the sharpness of the events' own image, away from where it began.

A product with a picture that has gone stale turns negative before focus; sharpness does not mind where the picture
lies. Its change tells the direction within a few depths of focus, in a band of some pixels, where what pixels hold back
(evenly up to a threshold) is next to nothing and a picture that is far out of focus still has structure.

With a start picture the image is what the sensor sees now, and its energy rises toward focus and falls away from it.
Without one the image is the *difference* from the start, whose energy grows as the scene moves off, whichever way the
lens goes. It grows in a fine and in a coarse band alike, so there their ratio is judged, and the fine band's fall.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.records import Direction
from elpd.vision.integral import band_energy

if TYPE_CHECKING:
    from numpy.typing import NDArray

RISE = 0.12
FALL = 0.08
"""Change of log energy that makes a direction: two depths of focus at ten times the blur. A picture's brightness floor
and a threshold that is not known by a quarter make a rise of the same size look real sooner than a fall."""

TILT_RISE = 0.08
TILT_FALL = 0.45
"""The same of the ratio of the two bands, whose fall has a part that has nothing to do with focus: what moves decays
from fine to coarse."""

AFTER_REVERSAL = 1.5
"""A second turn costs the most: it needs this many times the fall of the first."""

SIGMAS = 6.0
"""A change is also this many times the curve's own scatter."""

UNSETTLED = 4
"""Ticks at the beginning that say more of the start of the motor than of focus, where there is no picture."""

FINE_PX = 0.7
MIDDLE_PX = 1.2
COARSE_PX = 2.4
"""Bands, in pixels of the image at half its scale."""


class Bearing:
    """Judges the direction from one look at the image per tick of travel.

    Parameters
    ----------
    pictured:
        Whether the image began as a picture of the scene, not as nothing.
    margin:
        Pixels at each side that are left out.
    again:
        Whether another verdict has turned the lens round: an opposite one must then be more certain.
    """

    def __init__(self, margin: int, *, pictured: bool, again: bool = False) -> None:
        self._margin = margin // 2
        self._doubt = AFTER_REVERSAL if again else 1.0
        self._pictured = pictured
        self._seen = 0
        self._energy = _Swing()
        self._tilt = _Swing()
        self.direction = Direction.UNKNOWN
        """The first verdict; it stands."""

    def look(self, image: NDArray[np.float32]) -> Direction:
        """Take the image, (height, width) in thresholds, at the next tick; return the direction so far."""
        if self.direction is not Direction.UNKNOWN:
            return self.direction
        half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        weight = np.ones_like(half)
        self._seen += 1
        if self._pictured:
            self._energy.add(_log_energy(half, MIDDLE_PX, weight, self._margin))
            self.direction = self._energy.verdict(RISE, self._doubt * FALL)
        elif self._seen > UNSETTLED:
            fine = _log_energy(half, FINE_PX, weight, self._margin)
            self._energy.add(fine)
            self._tilt.add(fine - _log_energy(half, COARSE_PX, weight, self._margin))
            self.direction = self._tilt.verdict(TILT_RISE, self._doubt * TILT_FALL)
            if self._energy.verdict(np.inf, self._doubt * RISE) is Direction.RECEDING:
                self.direction = Direction.RECEDING
        return self.direction


class _Swing:
    """A curve's rally from its lowest and drawdown from its highest point."""

    def __init__(self) -> None:
        self._values: list[float] = []
        self._low, self._high = np.inf, -np.inf

    def add(self, value: float) -> None:
        self._values.append(value)
        self._low, self._high = min(self._low, value), max(self._high, value)

    def verdict(self, rise: float, fall: float) -> Direction:
        now = self._values[-1]
        least = SIGMAS * self._scatter()
        if now - self._low > max(rise, least):
            return Direction.APPROACHING
        if self._high - now > max(fall, least):
            return Direction.RECEDING
        return Direction.UNKNOWN

    def _scatter(self) -> float:
        """One standard deviation of a point about its neighbours."""
        second = np.diff(self._values, 2)
        return float(np.sqrt(np.mean(np.square(second)) / 6.0)) if second.size else 0.0


def _log_energy(image: NDArray[np.float32], scale_px: float, weight: NDArray[np.float32], margin: int) -> float:
    return float(np.log(band_energy(image, scale_px, weight, margin) + 1e-12))
