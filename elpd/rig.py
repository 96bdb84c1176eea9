"""Wiring, by hand and in one place: configuration in, devices out.

Drivers are found through entry points, so a stranger's package uses the same door as ours. A simulated rig comes as a
whole (its parts share a world); any of its parts can be replaced by a driver of its own, which then lives on the same
clock: a recording as the camera (``camera.driver = "file"``), a lens over a real port.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

from elpd.calibrate.in_use import as_measured
from elpd.calibrate.lens import teach
from elpd.errors import ConfigError, DeviceError
from elpd.focus.settings import CycleSettings
from elpd.motion.lens_output import aperture_on_lens
from elpd.motion.stepping import MOVE_DOF, SteppingLens
from elpd.ports import Closeable, RigParts
from elpd.scale import LensScale
from elpd.timebase import MonotonicClock

if TYPE_CHECKING:
    from collections.abc import Iterator

    from elpd.config import Config, DeviceSection, LensSection
    from elpd.ports import Aperture, Clock, EventCamera, Lens

KINDS = {
    "elpd.rigs": "rig",
    "elpd.cameras": "camera",
    "elpd.lenses": "lens",
    "elpd.apertures": "aperture",
    "elpd.formats": "format",
    "elpd.boards": "board",
}


def find(group: str, name: str) -> Any:
    """Load one entry point.

    Raises
    ------
    ConfigError
        If there is no such driver; the message lists those there are.
    DeviceError
        If it is there and cannot be imported.

    """
    found = {point.name: point for point in entry_points(group=group)}
    if name not in found:
        kind = KINDS.get(group, group)
        known = ", ".join(sorted(found)) or "none"
        raise ConfigError(f"no {kind} driver is called {name!r}; installed: {known}")
    return _load(found[name])


def build(config: Config) -> RigParts:
    """Build the rig that *config* describes, and what profiles know of its lens. Nothing moves yet.

    Raises ``ConfigError`` for unknown drivers and keys, ``DeviceError`` for devices that do not answer.
    """
    config = as_measured(config)
    if config.rig == "sim":
        parts: RigParts = find("elpd.rigs", "sim")(
            {
                **config.sim.model_dump(),
                "um_per_step": config.lens.um_per_step,
                "steps_to_um": config.lens.steps_to_um,
            }
        )
    else:
        parts = _hardware(config)
    if config.rig == "sim":
        parts = _with_replacements(parts, config)
    teach(parts.lens, config)
    if not parts.lens.capabilities.stop_on_command:
        parts = replace(parts, lens=_in_moves(parts, config))
    from elpd.calibrate.aperture import with_profile  # noqa: PLC0415  (brings numba: a lens alone is stopped without)

    return replace(parts, aperture=with_profile(config, parts.aperture))


@contextmanager
def lens_alone(config: Config) -> Iterator[tuple[Clock, Lens, LensScale]]:
    """Open the lens that *config* describes, without a camera, and give it back at the end.

    A controller on a port lives in real time, whatever simulated camera the configuration sets beside it.
    Raises what ``build`` raises.
    """
    if config.rig == "sim" and config.lens.driver == "sim":
        parts = build(config)
        try:
            yield parts.clock, parts.lens, parts.scale
        finally:
            release(parts)
        return
    if config.lens.driver == "sim":
        raise ConfigError('lens.driver: rig = "hardware" needs a driver; see config/evk4-grbl.toml')
    config = as_measured(config)
    clock = MonotonicClock()
    lens = _open_lens(config.lens, clock)
    try:
        teach(lens, config)
        yield clock, lens, _scale(config.lens)
    finally:
        if isinstance(lens, Closeable):
            lens.close()


@contextmanager
def camera_alone(config: Config) -> Iterator[tuple[Clock, EventCamera]]:
    """Open the camera that *config* describes, without a lens, and give it back at the end. Nothing can move.

    The simulated camera comes with its world, whose lens stands still. Raises what ``build`` raises.
    """
    if config.rig == "sim" and config.camera.driver == "sim":
        parts = build(config)
        try:
            yield parts.clock, parts.camera
        finally:
            release(parts)
        return
    if config.camera.driver == "sim":
        raise ConfigError('camera.driver: rig = "hardware" needs a driver; see config/evk4-grbl.toml')
    clock = MonotonicClock()
    camera = _open("elpd.cameras", config.camera, clock)
    try:
        yield clock, camera
    finally:
        if isinstance(camera, Closeable):
            camera.close()


def release(parts: RigParts) -> None:
    """Give the devices back, the lens last: it must be able to stop until the end. An aperture stays as it is."""
    for device in (parts.camera, parts.lens):
        if isinstance(device, Closeable):
            device.close()


def _hardware(config: Config) -> RigParts:
    for name in ("camera", "lens"):
        if getattr(config, name).driver == "sim":
            raise ConfigError(f'{name}.driver: rig = "hardware" needs a driver; see config/evk4-grbl.toml')
    clock = MonotonicClock()
    lens = _open_lens(config.lens, clock)
    try:
        camera = _open("elpd.cameras", config.camera, clock)
        aperture = None if config.aperture.driver in {"sim", "none"} else _open_aperture(config.aperture, clock, lens)
    except BaseException:
        if isinstance(lens, Closeable):
            lens.close()
        raise
    return RigParts(clock, camera, lens, aperture, _scale(config.lens))


def _with_replacements(parts: RigParts, config: Config) -> RigParts:
    if config.camera.driver != "sim":
        parts = replace(parts, camera=_open("elpd.cameras", config.camera, parts.clock), truth=None)
    if config.lens.driver != "sim":
        parts = replace(parts, lens=_open_lens(config.lens, parts.clock), truth=None)
    if config.aperture.driver == "none":
        parts = replace(parts, aperture=None)
    elif config.aperture.driver != "sim":
        parts = replace(parts, aperture=_open_aperture(config.aperture, parts.clock, parts.lens))
    return parts


def _in_moves(parts: RigParts, config: Config) -> SteppingLens:
    """Drive a lens that cannot be stopped in moves that need not be."""
    settings = CycleSettings.from_config(config)
    move_steps = MOVE_DOF * settings.depth_of_focus_um / parts.um_per_step
    return SteppingLens(parts.lens, parts.clock, move_steps, settings.speed_um_s / parts.um_per_step)


def _open(group: str, section: DeviceSection, clock: Clock) -> EventCamera:
    camera: EventCamera = find(group, section.driver)(section.settings(), clock)
    return camera


def _open_lens(section: LensSection, clock: Clock) -> Lens:
    settings = {**section.settings(), "um_per_step": section.um_per_step, "max_speed_um_s": section.speed_um_s}
    scale = _scale(section)
    if scale.table:  # a driver knows steps of one nominal size: say where the ends are in those
        for key in ("min_um", "max_um"):
            if isinstance(settings.get(key), (int, float)):
                settings[key] = scale.to_steps(settings[key]) * section.um_per_step
    lens: Lens = find("elpd.lenses", section.driver)(settings, clock)
    return lens


def _scale(section: LensSection) -> LensScale:
    return LensScale(section.um_per_step, section.steps_to_um)


def _open_aperture(section: DeviceSection, clock: Clock, lens: Lens) -> Aperture:
    if section.driver == "lens-output":
        return aperture_on_lens(section.settings(), lens)
    aperture: Aperture = find("elpd.apertures", section.driver)(section.settings(), clock)
    return aperture


def _load(point: EntryPoint) -> Any:
    try:
        return point.load()
    except ImportError as error:
        raise DeviceError(
            f"the driver {point.name!r} ({point.value}) cannot be imported: {error}; install what it needs"
        ) from error
