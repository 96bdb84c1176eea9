"""How much the camera itself turned during a cycle, by its own gyroscope.

It tells a shaking rig from a moving scene: a value for a person and no verdict, for what a rotation does to a picture
depends on the focal length, which nobody tells. The mean is taken off, because a gyroscope at rest says up to some
degrees a second of its own.
"""

from __future__ import annotations

from math import fsum, isnan, sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from elpd.records import ImuSample


class Shake:
    """The root mean square of the rotation about its mean, over everything that was heard."""

    def __init__(self) -> None:
        self._count = 0
        self._sums = [0.0, 0.0, 0.0]
        self._squares = 0.0

    def hear(self, samples: tuple[ImuSample, ...]) -> None:
        """Take a packet's samples."""
        for one in samples:
            rotation = one.rotation_rad_s
            squares = fsum(axis * axis for axis in rotation)
            if not isnan(squares):  # a sensor without a gyroscope says nan
                self._count += 1
                self._squares += squares
                self._sums = [total + axis for total, axis in zip(self._sums, rotation, strict=True)]

    @property
    def rms_rad_s(self) -> float | None:
        """Rad/s over all three axes, ``None`` without two samples."""
        if self._count < 2:
            return None
        mean = fsum((total / self._count) ** 2 for total in self._sums)
        return sqrt(max(0.0, self._squares / self._count - mean))
