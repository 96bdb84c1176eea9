"""An aperture's profile: how its transmittance grows, how long after the command, and who may use it.

Each opening is measured by itself (``opening``) and counted from its own first light, so that a mechanism that starts
now earlier, now later does not blur the curve. The mean of the curves is kept, with an error that holds what each
opening tells of itself and what openings differ by.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
import structlog
from pydantic import model_validator

from elpd.calibrate.profile import MeasuredOn, Profile, load, path_of, state_directory
from elpd.calibrate.quantity import Quantity
from elpd.errors import UsageError
from elpd.log.once import Once
from elpd.vision.temporal_map import tabulated

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.calibrate.opening import OpeningCurve
    from elpd.config import Config
    from elpd.ports import Aperture
    from elpd.records import CommandStamp

_once = Once()

CERTAIN = 3.0
"""Standard errors that an upper bound of the opening time lies above its mean."""

_SIMULATED_APERTURE = ("seed", "aperture_ms", "aperture_profile", "aperture_slow", "iris_steps", "iris_speed_sps")
_ON_THE_LENS = "iris_"
"""What the keys of ``[lens]`` begin with that say how an iris on its controller is turned."""


class ApertureCalibration(Profile):
    """How an aperture opens.

    ``since_us`` rises from 0, the first light; ``transmittance`` from 0 to 1 (fully open); ``sigma`` is one relative
    standard error of each row against the others, ``scale_sigma`` that of the slope of log T, common to all rows: the
    threshold's. ``delay_us`` is from the command to the first light. ``lag_corrected`` says whether the photoreceptors'
    lag was known and taken out.
    """

    KIND: ClassVar[str] = "aperture"
    VERSION: ClassVar[int] = 1

    delay_us: Quantity
    opening_us: Quantity
    since_us: tuple[float, ...]
    transmittance: tuple[float, ...]
    sigma: tuple[float, ...]
    scale_sigma: float
    threshold: float
    lag_corrected: bool
    openings: int
    events: int

    @model_validator(mode="after")
    def _a_table(self) -> Self:
        if not len(self.since_us) == len(self.transmittance) == len(self.sigma):
            raise ValueError("since_us, transmittance and sigma must be of one length")
        try:
            tabulated(np.array(self.since_us), np.array(self.transmittance))
        except UsageError as error:
            raise ValueError(str(error)) from None
        return self


def combine(
    curves: Sequence[OpeningCurve],
    delays_us: Sequence[float],
    on: MeasuredOn,
    *,
    threshold: float,
    lag_corrected: bool,
) -> ApertureCalibration:
    """Make one profile of one or more openings; *delays_us* is empty where nobody knows when it was commanded."""
    opening_us = np.array([curve.opening_us for curve in curves])
    grid = curves[0].since_us * (opening_us.mean() / opening_us[0])
    every = np.array([np.interp(grid, curve.since_us, curve.transmittance) for curve in curves])
    own = np.array([np.interp(grid, curve.since_us, curve.sigma) for curve in curves])
    mean = np.maximum.accumulate(every.mean(axis=0))
    count = len(curves)
    variance = np.square(own).mean(axis=0) / count
    if count > 1:
        variance = variance + np.square(every.std(axis=0, ddof=1) / np.maximum(mean, 1e-9)) / count
    begin_sigma_us = float(np.sqrt(np.mean([curve.begin_sigma_us**2 for curve in curves])))
    opening_sigma_us = float(np.sqrt(np.mean([curve.opening_sigma_us**2 for curve in curves])))
    delay = Quantity.none("nothing says when the aperture was told to open; calibrate on the rig", "us")
    if delays_us:
        delay = _mean(np.array(delays_us), begin_sigma_us)
    return ApertureCalibration(
        **ApertureCalibration.head(on),
        delay_us=delay,
        opening_us=_mean(opening_us, opening_sigma_us),
        since_us=tuple(float(one) for one in grid),
        transmittance=tuple(float(one) for one in mean),
        sigma=tuple(float(one) for one in np.sqrt(variance)),
        scale_sigma=max(curve.scale_sigma for curve in curves),
        threshold=threshold,
        lag_corrected=lag_corrected,
        openings=count,
        events=sum(curve.events for curve in curves),
    )


def _mean(values: NDArray[np.float64], own_sigma: float) -> Quantity:
    scatter = float(values.std(ddof=1)) if values.size > 1 else 0.0
    return Quantity.of(float(values.mean()), max(scatter, own_sigma) / np.sqrt(values.size), "us")


def measured_on(config: Config) -> MeasuredOn:
    """Describe the aperture of a configured rig. An aperture has no pixels."""
    if config.rig == "sim" and config.aperture.driver == "sim":
        every = config.sim.model_dump(mode="json")
        settings = {f"sim.{key}": every[key] for key in _SIMULATED_APERTURE if key in every}
    else:
        plain = json.loads(json.dumps(config.aperture.settings(), default=str))
        if config.aperture.driver == "lens-output":
            every = json.loads(json.dumps(config.lens.settings(), default=str))
            plain |= {f"lens.{key}": value for key, value in every.items() if key.startswith(_ON_THE_LENS)}
        settings = {key if "." in key else f"aperture.{key}": value for key, value in plain.items()}
    return MeasuredOn(device=f"aperture {config.aperture.driver}", serial=None, width=0, height=0, settings=settings)


@dataclass(frozen=True, slots=True)
class CalibratedAperture:
    """An aperture that knows its own profile."""

    aperture: Aperture
    profile: ApertureCalibration

    def open(self) -> CommandStamp:
        """Start to open."""
        return self.aperture.open()

    def close(self) -> CommandStamp:
        """Start to close."""
        return self.aperture.close()

    @property
    def opening_ms(self) -> float:
        """From command to fully open: the driver's bound, or what was measured and three standard errors if more.

        Never less than the bound: nothing was learnt about closing, which may take longer than opening.
        """
        parts = [self.profile.delay_us, self.profile.opening_us]
        if any(part.value is None or part.sigma is None for part in parts):
            return self.aperture.opening_ms
        # the error is that of a mean: one opening scatters more
        spread = CERTAIN * np.sqrt(self.profile.openings)
        most_us = float(sum((part.value or 0.0) + spread * (part.sigma or 0.0) for part in parts))
        return max(self.aperture.opening_ms, most_us / 1000.0)

    def transmittance(self, since_open_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the measured transmittance at times after the first light."""
        return tabulated(np.array(self.profile.since_us), np.array(self.profile.transmittance))(since_open_us)


def with_profile(config: Config, aperture: Aperture | None) -> Aperture | None:
    """Return the aperture with its stored profile, as it is where there is none that belongs to it.

    Raises ``FormatError`` for a profile that is damaged.
    """
    if aperture is None or not config.state.profiles:
        return aperture
    directory = state_directory(config)
    stored = load(directory, ApertureCalibration)
    if stored is None:
        return aperture
    difference = stored.on.difference(measured_on(config))
    if difference is not None:
        path = path_of(directory, ApertureCalibration)
        if _once.new(str(path), difference):
            structlog.get_logger(__name__).warning("aperture profile not used", path=str(path), reason=difference)
        return aperture
    return CalibratedAperture(aperture, stored)
