"""A sensor's profile of which only the lag was measured."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from elpd.calibrate.profile import MeasuredOn
from elpd.calibrate.quantity import Quantity
from elpd.calibrate.sensor import SensorCalibration


def sensor_profile(width: int, height: int, *, lag_us: float) -> SensorCalibration:
    """Return a profile of a sensor of so many pixels."""
    on = MeasuredOn(device="sensor", serial=None, width=width, height=height, settings={})
    none = Quantity.none("nobody looked")
    fields: dict[str, Any] = {
        name: none for name, field in SensorCalibration.model_fields.items() if field.annotation is Quantity
    }
    fields["lag_us"] = Quantity.of(lag_us, 0.1 * lag_us, "us")
    return SensorCalibration(
        **SensorCalibration.head(on, datetime(2026, 3, 1, tzinfo=UTC)),
        **fields,
        lag_by_brightness=(),
        hot_pixels=None,
        hot_reason="nobody looked",
        hot_above_hz=None,
        hot_false_alarms=0.01,
        rest_s=0.0,
        events=0,
    )
