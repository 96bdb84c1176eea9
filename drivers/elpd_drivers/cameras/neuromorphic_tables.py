"""The table ``[camera]`` for neuromorphic-drivers: its keys, which camera it means, and the library's own settings.

Every key is checked as early as it can be: its type when the table is read, its name when the camera's model is known,
its range when the very sensor has said what it takes.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from elpd.errors import CameraError, ConfigError
from elpd_drivers.cameras.refusals import explain
from elpd_drivers.cameras.source import CaptureSettings

BUFFERS_IN_FLIGHT = 32
RATE_PERIOD_US = 200
"""The rate controller counts in periods; the one that the maker's examples use."""

MODELS = {
    "evk4": "prophesee_evk4",
    "evk3-hd": "prophesee_evk3_hd",
    "centuryarks-vga": "centuryarks_vga",
    "davis346": "inivation_davis346",
    "dvxplorer": "inivation_dvxplorer",
}


class BiasTables(BaseModel):
    """The two settings of the sensor's biases, by the library's names; others stay as the factory set them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    expose: dict[str, int] = {}
    focus: dict[str, int] = {}


class NeuromorphicSettings(CaptureSettings):
    """The table ``[camera]`` for the driver ``neuromorphic``.

    ``model`` is ``auto`` (what is plugged in) or one of ``MODELS``. ``rate_limit_mev_s`` bounds what a Prophesee sensor
    sends, ``trigger`` listens to an EVK4's trigger input: the library sets both when it opens and not later.
    ``usb_packets`` is how many buffers of 128 KiB it keeps. ``exposure_us`` and ``frame_interval_us`` are a DAVIS346's,
    ``imu`` says whether the samples of an iniVation camera's inertial sensor are delivered.
    """

    model: Literal["auto", "evk4", "evk3-hd", "centuryarks-vga", "davis346", "dvxplorer"] = "auto"
    biases: BiasTables = BiasTables()
    rate_limit_mev_s: Annotated[float, Field(gt=0, le=1000)] | None = None
    trigger: bool = True
    imu: bool = True
    usb_packets: Annotated[int, Field(gt=BUFFERS_IN_FLIGHT, le=4096)] = 256
    exposure_us: Annotated[int, Field(ge=1, le=1_000_000)] = 4000
    frame_interval_us: Annotated[int, Field(ge=1, le=10_000_000)] = 40_000


def choose(nd: Any, table: NeuromorphicSettings) -> tuple[str, str]:
    """Find the camera that is meant. Raises ``CameraError`` with what is there instead."""
    wanted = MODELS.get(table.model)
    listed = nd.list_devices()
    there = [(device.name.name.lower(), device.serial) for device in listed if device.error is None]
    fitting = [
        (kind, serial)
        for kind, serial in there
        if serial is not None and wanted in {None, kind} and table.serial in {None, serial}
    ]
    if len(fitting) == 1:
        return fitting[0]
    found = ", ".join(f"{kind.replace('_', ' ')} {serial}" for kind, serial in there)
    if fitting:
        raise CameraError(f"camera: several would do ({found}); choose one with camera.serial")
    errors = [device.error for device in listed if device.error is not None]
    if errors and not there:
        raise CameraError(explain(errors[0], "neuromorphic-drivers"))
    asked = " ".join(filter(None, (table.model if wanted else "", table.serial or ""))) or "any"
    raise CameraError(
        f"camera: none found (asked for: {asked}; plugged in: {found or 'none that neuromorphic-drivers knows'}); "
        "check the cable and camera.model; `elpd check` lists what is plugged in"
    )


def configured(module: Any, table: NeuromorphicSettings) -> Any:
    """Build the library's configuration; the sensor begins with the biases for focusing."""
    known = {field.name for field in fields(module.Configuration)}
    for where, biases in (("expose", table.biases.expose), ("focus", table.biases.focus)):
        names = {field.name for field in fields(module.Biases)}
        for name in biases:
            if name not in names:
                raise ConfigError(
                    f"camera.biases.{where}.{name}: this camera has no such bias; it has {', '.join(sorted(names))}"
                )
    wanted: dict[str, Any] = {"biases": module.Biases(**table.biases.focus)}
    if "enable_external_trigger" in known:
        wanted["enable_external_trigger"] = table.trigger
    if "exposure_us" in known:
        wanted |= {"exposure_us": table.exposure_us, "frame_interval_us": table.frame_interval_us}
    if table.rate_limit_mev_s is not None:
        if "rate_limiter" not in known:
            raise ConfigError("camera.rate_limit_mev_s: this camera has no rate controller; remove the key")
        most = max(1, round(table.rate_limit_mev_s * RATE_PERIOD_US))
        wanted["rate_limiter"] = module.RateLimiter(reference_period_us=RATE_PERIOD_US, maximum_events_per_period=most)
    return module.Configuration(**wanted)


def check_bounds(biases: BiasTables, bounds: Any, kind: str) -> None:
    """Refuse biases that this very sensor cannot be set to. Raises ``ConfigError``."""
    for where, table in (("expose", biases.expose), ("focus", biases.focus)):
        for name, value in table.items():
            allowed = getattr(bounds, name, None)
            if allowed is not None and not allowed.minimum <= value <= allowed.maximum:
                raise ConfigError(
                    f"camera.biases.{where}.{name}: {value} is outside what this {kind.replace('_', ' ')} takes, "
                    f"{allowed.minimum} to {allowed.maximum}"
                )
