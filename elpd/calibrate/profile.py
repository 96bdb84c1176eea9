"""Profiles: what was measured, on what, and when; one file per kind, whole or not at all.

A profile is a pydantic model in JSON, ``<kind>.json`` in the state directory. It is written beside its place, forced
to the disk, and renamed over the old one, so that a crash or a full disk leaves the old profile as it was. On loading,
the kind, the version and every field are checked; a file that is damaged or of another version is an error that says
what to do, never a silent default. Whether a profile belongs to the device at hand is what ``MeasuredOn.difference``
says.

A new kind is a subclass of ``Profile`` with its ``KIND``, its ``VERSION`` and its fields; nothing here changes.
"""

from __future__ import annotations

import json
import os
import tempfile
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

import structlog
from pydantic import BaseModel, ConfigDict, ValidationError

from elpd import __version__
from elpd.errors import FormatError, UsageError
from elpd.ports import Identified

if TYPE_CHECKING:
    from collections.abc import Mapping

    from elpd.config import Config
    from elpd.ports import EventCamera, Lens

_log = structlog.get_logger(__name__)

_SIMULATED_LENS = ("board", "travel_um", "backlash_um", "acceleration_um_s2", "microstep_error_um", "cam")
_SIMULATED_SENSOR = ("seed", "camera", "width", "height", "noise_hz", "leak_hz", "hot_pixels", "hot_pixel_hz",
                     "contrast_on", "contrast_off", "refractory_us", "mismatch", "lag_us", "brightness")  # fmt: skip


class MeasuredOn(BaseModel):
    """The device that a profile is about. ``settings`` are the config keys that change what it does.

    ``width`` and ``height`` are a camera's pixels; a lens has none.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    part: Literal["camera", "lens"] = "camera"
    device: str
    serial: str | None
    width: int = 0
    height: int = 0
    settings: dict[str, Any]

    @classmethod
    def camera(cls, config: Config, camera: EventCamera) -> MeasuredOn:
        """Describe the camera of a configured rig."""
        settings: Mapping[str, Any] = config.camera.settings()
        device = config.camera.driver
        if config.rig == "sim" and device == "sim":
            every = config.sim.model_dump(mode="json")
            settings = {f"sim.{key}": every[key] for key in _SIMULATED_SENSOR if key in every}
            device = f"sim {config.sim.camera}"
        else:
            settings = {f"camera.{key}": value for key, value in settings.items()}
        serial = camera.serial if isinstance(camera, Identified) else None
        geometry = camera.geometry
        plain = json.loads(json.dumps(dict(settings), default=str))
        return cls(device=device, serial=serial, width=geometry.width, height=geometry.height, settings=plain)

    @classmethod
    def lens(cls, config: Config, lens: Lens | None = None, *, ruler: bool = False) -> MeasuredOn:
        """Describe the lens of a configured rig; *ruler* adds its table of steps, for what was measured in um by it.

        Without the open *lens* its serial number is not known, and not compared.
        """
        section = config.lens
        device = section.driver
        if config.rig == "sim" and device == "sim":
            every = config.sim.model_dump(mode="json")
            settings: dict[str, Any] = {f"sim.{key}": every[key] for key in _SIMULATED_LENS if key in every}
            device = f"sim {config.sim.board}"
        else:
            settings = {f"lens.{key}": value for key, value in section.settings().items()}
        settings["lens.um_per_step"] = section.um_per_step
        if ruler and section.steps_to_um:
            settings["lens.steps_to_um"] = section.steps_to_um
        serial = lens.serial if isinstance(lens, Identified) else None
        return cls(part="lens", device=device, serial=serial, settings=json.loads(json.dumps(settings, default=str)))

    def difference(self, other: MeasuredOn) -> str | None:
        """Say in what *other* is another device or otherwise set; ``None`` if it is the same."""
        if (self.width, self.height) != (other.width, other.height):
            return f"it was measured on {self.width}x{self.height} pixels, this camera has {other.width}x{other.height}"
        pairs: list[tuple[str, str | None, str | None]] = [(self.part, self.device, other.device)]
        if self.part == "camera" or (self.serial is not None and other.serial is not None):
            pairs.append(("serial number", self.serial, other.serial))
        for name, before, now in pairs:
            if before != now:
                return f"it was measured on the {name} {before}, this one is {now}"
        for key in sorted({*self.settings, *other.settings}):
            then, today = self.settings.get(key), other.settings.get(key)
            if then != today:
                return f"it was measured with {key} = {then}, which is {today} now"
        return None


class Profile(BaseModel):
    """What every profile has. ``measured_utc`` is ISO 8601; ``elpd`` the version that measured."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    KIND: ClassVar[str]
    VERSION: ClassVar[int]

    kind: str
    version: int
    elpd: str
    measured_utc: str
    on: MeasuredOn

    @classmethod
    def head(cls, on: MeasuredOn, when: datetime | None = None) -> dict[str, Any]:
        """Return the fields that every profile begins with."""
        when = when or datetime.now(UTC)
        return {
            "kind": cls.KIND,
            "version": cls.VERSION,
            "elpd": __version__,
            "measured_utc": when.astimezone(UTC).isoformat(timespec="seconds"),
            "on": on,
        }


P = TypeVar("P", bound=Profile)


def state_directory(config: Config) -> Path:
    """Return where profiles lie: ``state.directory``, else the user's state directory (XDG)."""
    if config.state.directory is not None:
        return config.state.directory
    base = os.environ.get("XDG_STATE_HOME", "")
    return (Path(base) if Path(base).is_absolute() else Path.home() / ".local" / "state") / "elpd"


def path_of(directory: Path, kind: type[Profile]) -> Path:
    """Return the file of a kind of profile."""
    return directory / f"{kind.KIND}.json"


def save(directory: Path, profile: Profile) -> Path:
    """Write a profile whole or not at all; return its file. Raises ``UsageError`` where that cannot be done."""
    path = path_of(directory, type(profile))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    text = json.dumps(profile.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        folder = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UsageError(
            f"{path}: the profile cannot be written ({error.strerror or error}); the old one, if any, is untouched; "
            "free some space or set state.directory"
        ) from None
    return path


def make_room(directory: Path, kind: type[Profile]) -> None:
    """See before anything is measured that a profile can be kept; set one aside that nobody can read.

    A damaged file, or one of another version, is renamed to end in ``.unreadable``. Raises ``UsageError`` where nothing
    can be written.
    """
    path = path_of(directory, kind)
    try:
        load(directory, kind)
    except FormatError as error:
        aside = path.with_name(f"{path.name}.unreadable")
        with suppress(OSError):  # what cannot be renamed cannot be written either
            path.replace(aside)
            _log.warning("profile set aside", path=str(aside), reason=str(error).partition("; ")[0])
    there = next(one for one in (directory, *directory.absolute().parents) if one.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise UsageError(
            f"{path}: the profile could not be written ({error.strerror or error}); set state.directory to a folder "
            "of yours, or measure with --dry-run"
        ) from None


def load(directory: Path, kind: type[P]) -> P | None:
    """Return the profile of a kind, ``None`` if there is none.

    Raises ``FormatError`` for a file that is damaged, of another kind or of another version.
    """
    path = path_of(directory, kind)
    return read(path, kind) if path.exists() else None


def read(path: Path, kind: type[P]) -> P:
    """Return the profile of a kind that a file holds. Raises as ``load``, and where there is no such file."""
    again = f"run `elpd calibrate {kind.KIND}` again, or delete the file"
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{path}: the profile cannot be read ({error}); {again}") from None
    try:
        content = json.loads(text)
    except ValueError as error:
        raise FormatError(f"{path}: damaged or cut off after {len(text)} characters ({error}); {again}") from None
    if not isinstance(content, dict) or content.get("kind") != kind.KIND:
        found = content.get("kind") if isinstance(content, dict) else type(content).__name__
        raise FormatError(f"{path}: is no profile of kind {kind.KIND!r} (found {found!r}); {again}")
    if content.get("version") != kind.VERSION:
        raise FormatError(f"{path}: profile version {content.get('version')}, this elpd reads {kind.VERSION}; {again}")
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise FormatError(f"{path}: {where}: {first['msg'].lower()}; {again}") from None
