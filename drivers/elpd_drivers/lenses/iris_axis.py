"""An iris turned by a stepper on another axis of the lens's controller: a P-iris, or a ring on a motor.

To whoever exposes it is an output called "iris" that takes its time: switched on it goes to where it is open, switched
off to where it is closed. How much light passes on the way, and from when on, no controller knows; that is measured
(`elpd calibrate aperture`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from elpd.errors import ConfigError

IRIS = "iris"


class IrisSettings(Protocol):
    """What the settings of a driver with such an axis have; ``iris_axis`` is 0 where there is none."""

    @property
    def iris_axis(self) -> int:
        """Which of the controller's axes turns it."""
        ...

    @property
    def iris_closed(self) -> int:
        """Where it is closed, steps from its reference."""
        ...

    @property
    def iris_open(self) -> int:
        """Where it is open, steps from its reference."""
        ...

    @property
    def iris_speed_sps(self) -> float:
        """How fast it is turned, steps/s."""
        ...


@dataclass(frozen=True, slots=True)
class IrisAxis:
    """Where an iris is open and closed, in steps of its own axis, and how fast it goes from one to the other."""

    axis: int
    closed_steps: int
    open_steps: int
    speed_sps: float

    def target(self, *, opened: bool) -> int:
        """Return where it is to go."""
        return self.open_steps if opened else self.closed_steps


def iris_axis(settings: IrisSettings, lens_axis: int) -> IrisAxis | None:
    """Return the axis that a table describes, ``None`` where it has none.

    Raises ``ConfigError`` for a table that contradicts itself.
    """
    if settings.iris_axis == 0:
        if settings.iris_open or settings.iris_closed or settings.iris_speed_sps:
            raise ConfigError("lens.iris_open, iris_closed and iris_speed_sps need lens.iris_axis: which one turns it")
        return None
    if settings.iris_axis == lens_axis:
        raise ConfigError(f"lens.iris_axis is {settings.iris_axis}, the lens's own axis; give the iris's")
    if settings.iris_open == settings.iris_closed:
        raise ConfigError(
            f"lens.iris_open and lens.iris_closed are both {settings.iris_open} steps; give where it is open, and "
            "where closed"
        )
    if not (math.isfinite(settings.iris_speed_sps) and settings.iris_speed_sps > 0):
        raise ConfigError(
            f"lens.iris_speed_sps is {settings.iris_speed_sps:g}; give steps/s (a P-iris makes some 200 full steps)"
        )
    return IrisAxis(settings.iris_axis, settings.iris_closed, settings.iris_open, settings.iris_speed_sps)
