"""Configuration: TOML on disk, typed in memory, a wrong key refused with its place.

Components do not keep a ``Config``; whoever builds them (``elpd.rig``) passes the few numbers each needs. Device
sections are open tables on purpose: their keys belong to the driver, which checks them itself.
"""

from __future__ import annotations

import tomllib
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from elpd.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

Positive = Annotated[float, Field(gt=0)]


class _Section(BaseModel):
    """A table whose every key is known."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class DeviceSection(BaseModel):
    """A table for a driver: ``driver`` names the entry point, the other keys are the driver's own."""

    model_config = ConfigDict(extra="allow", frozen=True)

    driver: str = "sim"

    def settings(self) -> dict[str, Any]:
        """Return the driver's own keys."""
        return dict(self.model_extra or {})


class LensSection(DeviceSection):
    """The lens and how to move it. Lengths on the motor's ruler."""

    um_per_step: Positive = 0.3125
    steps_to_um: tuple[tuple[float, float], ...] = ()
    """Rows of (steps, um) for a lens whose focus does not move in proportion to its motor; empty: it does."""
    speed_um_s: Positive = 4000.0
    backlash_um: Annotated[float, Field(ge=0)] = 6.0
    """Upper bound of the play between motor and carriage: the final approach overshoots by this much and a margin."""
    measured_play_um: tuple[Annotated[float, Field(ge=0)], Positive] | None = None
    """The play itself and its standard error, where it was measured; without it, it is anything up to the bound."""
    first_direction: Literal["auto", "up", "down"] = "auto"
    """Which way to probe first; ``auto`` is towards the longer way to a limit."""


class FocusSection(_Section):
    """One focus cycle."""

    roi: tuple[int, int, int, int] | None = None
    roi_fraction: Annotated[float, Field(gt=0, le=1)] = 0.4
    """Side of a proposed ROI as a fraction of the sensor's shorter side."""
    depth_of_focus_um: Positive = 6.0
    deadline_ms: Positive = 5000.0
    max_travel_um: Positive = 1500.0
    """Longest way in one direction before focus counts as not found."""
    max_reversals: Annotated[int, Field(ge=0, le=5)] = 2
    max_sigma_dof: Positive = 0.5
    """LOW_CONFIDENCE above this many depths of focus of standard error."""
    cross_again: Literal["better", "needed"] = "better"
    """Go over a still scene's focus again where that knows it better, or only where one pass leaves it in doubt, which
    is some 50 ms faster. A scene that moves needs it in any case."""
    on_failure: Literal["hold", "start", "preset"] = "start"
    preset_um: float | None = None
    transmittance: Literal["profile", "linear", "iris"] = "profile"
    """``profile`` asks the aperture for its own."""
    background_activity_us: Annotated[int, Field(ge=0)] = 0
    """An event of a sweep counts only if another pixel of its 2x2 cell fired at most so long before; 0: all count."""


class JournalSection(_Section):
    """Where runs are written."""

    directory: Path = Path("runs")
    enabled: bool = True
    keep: Annotated[int, Field(ge=1)] = 50
    budget_mb: Positive = 4000.0
    """How much all runs together may occupy; the oldest go first."""
    memory_mb: Positive = 256.0
    """How much may wait in memory while the lens moves; past it the run's journal ends, marked truncated."""


class StateSection(_Section):
    """What a rig has found out about itself: calibration profiles."""

    directory: Path | None = None
    """Where profiles lie; ``$XDG_STATE_HOME/elpd``, mostly ``~/.local/state/elpd``, unless given."""
    profiles: bool = True
    """Whether profiles that belong to this rig are used."""


class WebSection(_Section):
    """The page, which is a process of its own (`elpd web`)."""

    host: str = "127.0.0.1"
    """Where it listens. Anything but the loopback needs *allowed_hosts*, and is not encrypted."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8732
    """0: any free one."""
    allowed_hosts: tuple[str, ...] = ()
    """What browsers may call it beside the loopback's names, such as ``rig.lab:8732``, or ``rig.lab`` (a proxy's)."""
    token_file: Path | None = None
    """Where the token lies; in the state directory unless given."""


class ServiceSection(_Section):
    """The daemon: how it idles and how it is scheduled."""

    poll_ms: Positive = 100.0
    """How often an idle lens is asked where it is."""
    look_s: Positive = 0.1
    """How long an idle camera is listened to at a time."""
    look_every_s: Annotated[float, Field(ge=0)] | None = None
    """How often; 0 is all the time. Unless given, a simulated camera (each millisecond is computed) is listened to
    once a second, any other all the time, and in continuous mode either is all the time."""
    priority: Annotated[int, Field(ge=0, le=99)] = 10
    """SCHED_FIFO priority of the focus thread, where it may have one; 0: none."""


class ApiSection(_Section):
    """The socket."""

    socket: Path | None = None
    """``/run/elpd/elpd.sock`` where that folder can be written, else ``$XDG_RUNTIME_DIR/elpd/elpd.sock``."""
    operators: str | None = None
    """A group whose members may operate, beside root and the daemon's own user; whoever else gets in may look."""


class ModesSection(_Section):
    """When the daemon focuses by itself."""

    start: Literal["one-shot", "continuous", "manual", "scheduled"] = "one-shot"
    """The mode of a daemon that has none stored."""
    period_s: Annotated[float, Field(ge=1, le=604_800)] = 600.0
    """Scheduled mode: from the end of one cycle to the beginning of the next."""
    hold_off_s: Positive = 2.0
    """Continuous mode: the least time between two cycles. Doubled, to 64 times, with each that did not find focus or
    found it where it was; after seven without focus the lens rests until somebody asks."""
    settle_s: Positive = 0.3
    """Continuous mode: so long the scene must have been quiet before the lens moves."""
    recheck_s: Annotated[float, Field(ge=0, le=604_800)] = 0.0
    """Continuous mode: focus is checked again after so long without a cycle, evidence or not; 0: only with evidence."""
    defocus_dof: Annotated[float, Field(ge=1, le=20)] = 2.0
    """Continuous mode: what counts as out of focus, in depths of focus; half of it counts as in focus again."""


class TemperatureSection(_Section):
    """What temperature does to focus: rows of (celsius, um), celsius ascending; empty: nothing is compensated."""

    table: tuple[tuple[float, float], ...] = ()
    step_um: Positive | None = None
    """Moves are made once this much is due: half a depth of focus unless given."""
    max_step_um: Positive = 50.0
    """A single reading moves the lens no further than this."""

    @field_validator("table")
    @classmethod
    def _ascends(cls, table: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        if len(table) == 1 or any(after[0] <= before[0] for before, after in pairwise(table)):
            raise ValueError("takes two rows or more, celsius ascending")
        return table


class SimSection(_Section):
    """The simulated rig. Everything is drawn from ``seed``; a set key wins over the draw."""

    model_config = ConfigDict(extra="allow", frozen=True)

    seed: Annotated[int, Field(ge=0)] = 0
    start_um: float = -200.0
    scene: str = "random"
    motion: Literal["static", "moderate", "violent", "shake"] = "static"
    board: str = "tic"
    camera: Literal["evk4", "davis346"] = "evk4"
    depth_of_focus_um: Positive = 6.0
    speed_um_s: Positive = 4000.0
    pace: Annotated[float, Field(ge=0)] = 0.0


class Config(_Section):
    """Everything."""

    rig: Literal["sim", "hardware"] = "sim"
    camera: DeviceSection = DeviceSection()
    lens: LensSection = LensSection()
    aperture: DeviceSection = DeviceSection()
    focus: FocusSection = FocusSection()
    journal: JournalSection = JournalSection()
    state: StateSection = StateSection()
    sim: SimSection = SimSection()
    web: WebSection = WebSection()
    service: ServiceSection = ServiceSection()
    api: ApiSection = ApiSection()
    modes: ModesSection = ModesSection()
    temperature: TemperatureSection = TemperatureSection()


def load(path: Path | None = None, overrides: Sequence[str] = ()) -> Config:
    """Read a configuration.

    Parameters
    ----------
    path
        A TOML file, or ``None`` for the defaults (the simulated rig).
    overrides
        ``KEY=VALUE`` strings with dotted keys, applied after the file. Values are TOML where they parse as TOML,
        else bare strings.

    Raises
    ------
    ConfigError
        With the file and line, or the override, that is wrong.

    """
    text = _read(path) if path is not None else ""
    try:
        table: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: {error}; see config/elpd.toml for an annotated example") from None
    for override in overrides:
        _apply(table, override)
    try:
        return Config.model_validate(table)
    except ValidationError as error:
        raise ConfigError(_explain(error, path, text, overrides)) from None


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); give --config another file") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not text; a configuration is a TOML file in UTF-8") from None


def _apply(table: dict[str, Any], override: str) -> None:
    key, separator, value = override.partition("=")
    names = key.strip().split(".")
    if not separator or not all(names):
        raise ConfigError(f"--set takes KEY=VALUE with a dotted key, such as sim.seed=3; got {override!r}")
    target = table
    for name in names[:-1]:
        target = target.setdefault(name, {})
        if not isinstance(target, dict):
            raise ConfigError(f"--set {override}: {name!r} is a value, not a table")
    try:
        target[names[-1]] = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        target[names[-1]] = value


def _explain(error: ValidationError, path: Path | None, text: str, overrides: Sequence[str]) -> str:
    """Say the first thing that is wrong, and where."""
    first = error.errors()[0]
    names = [str(part) for part in first["loc"]]
    key = ".".join(names)
    what = "unknown key" if first["type"] == "extra_forbidden" else first["msg"].lower()
    if any(item.partition("=")[0].strip() == key for item in overrides):
        where = f"--set {key}"
    else:
        where = f"{path}:{_line_of(text, names)}: {key}"
    known = ""
    if first["type"] == "extra_forbidden":
        section: BaseModel = Config() if len(names) == 1 else getattr(Config(), names[0], Config())
        known = f"; known here: {', '.join(sorted(type(section).model_fields))}"
    return f"{where}: {what} (got {first['input']!r}){known}"


def _line_of(text: str, names: list[str]) -> int:
    """Find the line that holds a key, for the message; 1 where it cannot be told."""
    section = ""
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if stripped.startswith("["):
            section = stripped.strip("[] ")
        if stripped.split("=")[0].strip() == names[-1] and section == ".".join(names[:-1]):
            return number
        if section == ".".join(names):
            return number
    return 1
