"""The profile of the play between motor and glass, and what a focus cycle takes from it.

How it is measured is in ``elpd.calibrate.backlash``; this is light, because every command that moves the lens reads it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import structlog
from pydantic import BaseModel, ConfigDict

from elpd.calibrate.profile import MeasuredOn, Profile, load, path_of, state_directory
from elpd.calibrate.quantity import Quantity  # noqa: TC001  (a model needs the types of its fields)
from elpd.log.once import Once

if TYPE_CHECKING:
    from datetime import datetime

    from elpd.config import Config

_once = Once()

SURELY_SIGMAS = 3.0
"""The final approach begins behind the target by the play and so many of its standard errors."""


LEAST_SIGMA_UM = 0.01
"""No play is the same to less than a hundredth of a micrometre twice."""


class Reading(BaseModel):
    """Where one pass saw focus, on the motor's ruler; ``speed_um_s`` is signed."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    speed_um_s: float
    focus_um: float
    sigma_um: float


class BacklashCalibration(Profile):
    """What was measured of the play."""

    KIND: ClassVar[str] = "backlash"
    VERSION: ClassVar[int] = 1

    backlash_um: Quantity
    lag_us: Quantity
    """Of everything that answers late, photoreceptors, thresholds and clock together, in this scene."""
    readings: tuple[Reading, ...]

    @property
    def measured_um(self) -> tuple[float, float]:
        """The play and its standard error. Zero play is possible, negative is not."""
        value, sigma = self.backlash_um.value or 0.0, self.backlash_um.sigma or 0.0
        return max(value, 0.0), max(sigma, LEAST_SIGMA_UM)

    @property
    def approach_um(self) -> float:
        """How far behind its target a final approach must begin."""
        value, sigma = self.measured_um
        return value + SURELY_SIGMAS * sigma


@dataclass(frozen=True, slots=True)
class Play:
    """Play and lag, or why not, and what the single passes read."""

    backlash_um: Quantity
    lag_us: Quantity
    readings: tuple[Reading, ...]


def backlash_profile(config: Config) -> BacklashCalibration | None:
    """Return the profile of the configured lens's play, ``None`` if there is none, another lens's, or none wanted.

    Raises ``FormatError`` for a profile that is damaged.
    """
    if not config.state.profiles:
        return None
    directory = state_directory(config)
    stored = load(directory, BacklashCalibration)
    if stored is None or stored.backlash_um.value is None:
        return None
    difference = stored.on.difference(MeasuredOn.lens(config, ruler=True))
    if difference is not None:
        path = path_of(directory, BacklashCalibration)
        if _once.new(str(path), difference):
            structlog.get_logger(__name__).warning("backlash profile not used", path=str(path), reason=difference)
        return None
    return stored


def backlash_calibration(play: Play, on: MeasuredOn, when: datetime | None = None) -> BacklashCalibration:
    """Make a profile of what was measured on a lens."""
    return BacklashCalibration(
        **BacklashCalibration.head(on, when),
        backlash_um=play.backlash_um,
        lag_us=play.lag_us,
        readings=play.readings,
    )
