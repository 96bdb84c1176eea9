"""A sensor's profile: from evidence to numbers with errors, and from numbers to what a focus cycle uses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import structlog
from pydantic import BaseModel, ConfigDict

from elpd.calibrate.lag import measure_lag
from elpd.calibrate.profile import MeasuredOn, Profile, load, path_of, read, state_directory
from elpd.calibrate.quantity import Quantity
from elpd.calibrate.resting import FALSE_ALARMS, measure_rest, unmeasured
from elpd.calibrate.thresholds import NoiseRates, measure_absolute, measure_balance
from elpd.errors import UsageError
from elpd.log.once import Once
from elpd.records import SensorProfile
from elpd.vision.refractory import refractory_period

if TYPE_CHECKING:
    from datetime import datetime
    from pathlib import Path

    from elpd.calibrate.evidence import Columns, Evidence
    from elpd.config import Config
    from elpd.ports import EventCamera
    from elpd.records import Geometry

_once = Once()


class HotPixel(BaseModel):
    """A pixel that fires without a reason, and how often it did at rest."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    x: int
    y: int
    hz: float


class LagPoint(BaseModel):
    """The lag of pixels of one brightness, relative to the brightest parts."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    brightness: float
    lag_us: float
    sigma_us: float
    pairs: int


class SensorCalibration(Profile):
    """What was measured of a sensor; each quantity has a standard error or the reason why it could not be measured."""

    KIND: ClassVar[str] = "sensor"
    VERSION: ClassVar[int] = 1

    noise_on_hz: Quantity
    noise_off_hz: Quantity
    noise_on_off_ratio: Quantity
    dispersion_pixels: Quantity
    dispersion_time: Quantity
    threshold_ratio: Quantity
    """C_on / C_off."""
    threshold_on: Quantity
    threshold_off: Quantity
    mismatch: Quantity
    refractory_us: Quantity
    lag_us: Quantity
    """Of the brightest parts; it grows in inverse proportion to brightness."""
    lag_constant_us: Quantity
    lag_by_brightness: tuple[LagPoint, ...]
    hot_pixels: tuple[HotPixel, ...] | None
    hot_reason: str | None
    hot_above_hz: float | None
    hot_false_alarms: float
    rest_s: float
    events: int

    def quantities(self) -> dict[str, Quantity]:
        """Return all that have an error, by name, in the order of the fields."""
        return {name: value for name in type(self).model_fields if isinstance(value := getattr(self, name), Quantity)}

    def for_use(self) -> SensorProfile:
        """Return what a focus cycle takes from this."""
        return SensorProfile(
            hot_pixels=tuple((one.x, one.y) for one in self.hot_pixels or ()),
            lag_us=self.lag_us.value,
            lag_sigma_us=self.lag_us.sigma,
        )


def sensor_in_use(config: Config, camera: EventCamera) -> SensorProfile | None:
    """Return what is known of this camera, ``None`` if nothing is: no profile, one of another camera, or none wanted.

    Raises ``FormatError`` for a profile that is damaged.
    """
    if not config.state.profiles:
        return None
    directory = state_directory(config)
    stored = load(directory, SensorCalibration)
    if stored is None:
        return None
    difference = stored.on.difference(MeasuredOn.camera(config, camera))
    if difference is not None:
        path = path_of(directory, SensorCalibration)
        if _once.new(str(path), difference):
            structlog.get_logger(__name__).warning("sensor profile not used", path=str(path), reason=difference)
        return None
    return stored.for_use()


def sensor_of_file(path: Path, geometry: Geometry) -> SensorProfile:
    """Return what the profile in a file says of the sensor that made a recording.

    A recording does not say which camera it is of; only its size can be compared. Raises ``FormatError`` for what is no
    sensor profile, ``UsageError`` for one of another size.
    """
    stored = read(path, SensorCalibration)
    if (stored.on.width, stored.on.height) != (geometry.width, geometry.height):
        raise UsageError(
            f"{path}: was measured on {stored.on.width}x{stored.on.height} pixels, the recording has "
            f"{geometry.width}x{geometry.height}; give the profile of the camera that made it"
        )
    return stored.for_use()


def measure_sensor(
    evidence: Evidence, on: MeasuredOn, depth_of_focus_um: float, when: datetime | None = None
) -> SensorCalibration:
    """Measure everything that the evidence can tell."""
    geometry = evidence.geometry
    if evidence.rest is None:
        resting = unmeasured(evidence.why_not("rest", "nothing says when the lens stood still"))
    else:
        resting = measure_rest(evidence.rest, geometry)
    good = np.ones((geometry.height, geometry.width), np.bool_)
    for x, y, _ in resting.hot or ():
        good[y, x] = False
    noise = NoiseRates(resting.on_hz.value or 0.0, resting.off_hz.value or 0.0)
    fields: dict[str, Any] = {
        "noise_on_hz": resting.on_hz,
        "noise_off_hz": resting.off_hz,
        "noise_on_off_ratio": resting.on_off_ratio,
        "dispersion_pixels": resting.dispersion_pixels,
        "dispersion_time": resting.dispersion_time,
        "hot_pixels": None if resting.hot is None else tuple(HotPixel(x=x, y=y, hz=hz) for x, y, hz in resting.hot),
        "hot_reason": resting.hot_reason,
        "hot_above_hz": resting.hot_above_hz,
        "hot_false_alarms": FALSE_ALARMS,
        "rest_s": resting.duration_s,
    }
    moving = [*(one.events for one in evidence.sweeps), *(one.events for one in evidence.steps)]
    if evidence.other is not None:
        moving.append(evidence.other)
    fields["events"] = resting.events + sum(events.t_us.size for events in moving)
    fields["refractory_us"] = _refractory(moving, good, geometry, evidence)
    fields |= _from_sweeps(evidence, noise, good, depth_of_focus_um)
    return SensorCalibration(**SensorCalibration.head(on, when), **fields)


def _refractory(moving: list[Columns], good: np.ndarray, geometry: Geometry, evidence: Evidence) -> Quantity:
    if not moving:
        return Quantity.none(evidence.why_not("sweeps", "no sweep was recorded"), "us")
    most = max(moving, key=lambda events: events.t_us.size)
    keep = good[most.y, most.x]
    columns = (most.t_us[keep], most.x[keep], most.y[keep], most.on[keep])
    found = refractory_period(*columns, (geometry.height, geometry.width))
    if found.sigma_us == 0.0 or found.period_us < 2.0 * found.sigma_us:
        return Quantity.none(
            "no interval between two events of a pixel comes near it: the shortest tell of the scene, not of the pixel"
            + (f" (it is below {found.period_us + 2.0 * found.sigma_us:.0f} us)" if found.sigma_us else ""),
            "us",
        )
    return Quantity.of(found.period_us, found.sigma_us, "us")


def _from_sweeps(evidence: Evidence, noise: NoiseRates, good: np.ndarray, depth_of_focus_um: float) -> dict[str, Any]:
    geometry = evidence.geometry
    if not evidence.sweeps:
        reason = evidence.why_not("sweeps", "that takes sweeps there and back")
        none, none_us = Quantity.none(reason), Quantity.none(reason, "us")
        fields: dict[str, Any] = {
            "threshold_ratio": none,
            "mismatch": none,
            "lag_us": none_us,
            "lag_constant_us": none_us,
            "lag_by_brightness": (),
        }
    else:
        balance = measure_balance(evidence.sweeps, noise, good, geometry)
        lag = measure_lag(
            evidence.sweeps,
            evidence.brightness,
            good,
            geometry,
            depth_of_focus_um,
            doubt=evidence.brightness_doubt,
        )
        fields = {
            "threshold_ratio": balance.ratio,
            "mismatch": balance.mismatch,
            "lag_us": lag.per_slowness,
            "lag_constant_us": lag.constant,
            "lag_by_brightness": tuple(
                LagPoint(
                    brightness=one.brightness,
                    lag_us=one.lag.value or 0.0,
                    sigma_us=one.lag.sigma or 0.0,
                    pairs=one.pairs,
                )
                for one in lag.classes
            ),
        }
    if evidence.steps:
        absolute = measure_absolute(evidence.steps, fields["threshold_ratio"], good, geometry, evidence.black)
        return fields | {"threshold_on": absolute.on, "threshold_off": absolute.off}
    why = evidence.why_not("steps", "that takes frames: events alone do not say how large a step of light is")
    return fields | {"threshold_on": Quantity.none(why, "ln"), "threshold_off": Quantity.none(why, "ln")}
