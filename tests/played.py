"""There-and-backs around focus by a lens with play between motor and glass."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from unittest import mock

import numpy as np
import sensor_evidence
from elpd_drivers.sim.world import BIRTH_NS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.calibrate.evidence import Evidence


class Played(sensor_evidence.Knots):
    """Glass that follows its motor with play."""

    def __init__(self, knots: list[tuple[float, float]], play_um: float) -> None:
        super().__init__(knots)
        self.grid_s = np.arange(0.0, float(self.t_s[-1]), 1e-3)
        glass, half = float(self.um[0]), play_um / 2
        path = []
        for motor in np.interp(self.grid_s, self.t_s, self.um):
            glass = min(max(glass, float(motor) - half), float(motor) + half)
            path.append(glass)
        self.glass_um = np.array(path)

    def carriage_um(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.asarray(np.interp((np.asarray(times_ns) - BIRTH_NS) / 1e9, self.grid_s, self.glass_um))


def there_and_back_with_play(play_um: float, seed: int, scene: str, **options: Any) -> Evidence:
    """Return what a calibration sees; the driver knows of the motor only. *options* as in ``there_and_back``."""
    motor = sensor_evidence.Knots
    made: list[object] = []

    def knots(points: list[tuple[float, float]]) -> Any:
        made.append(points)
        return Played(points, play_um) if len(made) == 1 else motor(points)  # the world's is made first

    with mock.patch.object(sensor_evidence, "Knots", knots):
        return sensor_evidence.there_and_back(seed, scene, **options)[1]
