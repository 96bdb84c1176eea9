"""What every lens driver has in common, as plain parts to compose: its settings, its bounds, its patience.

No base class: a driver owns a ``BytePort`` and a ``Trajectory`` and uses what it needs from here.
"""

from __future__ import annotations

import math
from dataclasses import MISSING, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

from elpd.errors import ConfigError, UsageError
from elpd.records import LensLimits, StopMode
from elpd.units import NS_PER_S, Steps

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from elpd.records import LensCapabilities, StopTiming

T = TypeVar("T")

ADAPTER_LATENCY_US, ADAPTER_LATENCY_SIGMA_US = 600.0, 350.0
"""What a USB adapter and a board take over a command when nobody has measured them: a USB frame is 1 ms."""


def read_settings(kind: type[T], settings: Mapping[str, Any], where: str) -> T:
    """Build the settings dataclass *kind* from a table, refusing unknown keys and wrong types by name."""
    known = {item.name: item for item in fields(kind)}  # type: ignore[arg-type]
    for key in settings:
        if key not in known:
            raise ConfigError(f"{where}.{key}: unknown key; known are {', '.join(sorted(known))}")
    values: dict[str, Any] = {}
    for key, value in settings.items():
        default = known[key].default
        if default is MISSING or default is None or isinstance(value, type(default)):
            values[key] = value
        elif isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
            values[key] = float(value)
        else:
            raise ConfigError(f"{where}.{key}: {value!r} is not a {type(default).__name__} (such as {default!r})")
    missing = [name for name, item in known.items() if item.default is MISSING and name not in values]
    if missing:
        raise ConfigError(f"{where}: missing {', '.join(missing)}")
    return kind(**values)


def limits_from(
    um_per_step: float, min_um: float, max_um: float, max_speed_um_s: float, acceleration_um_s2: float
) -> LensLimits:
    """Turn lengths in um into the limits in steps, rounded inwards. Raises ``ConfigError`` on nonsense."""
    if not (um_per_step > 0 and max_um > min_um and max_speed_um_s > 0 and acceleration_um_s2 > 0):
        raise ConfigError(
            f"lens: um_per_step {um_per_step:g}, travel {min_um:g}..{max_um:g} um, speed {max_speed_um_s:g} um/s and "
            f"acceleration {acceleration_um_s2:g} um/s2 must all be positive, and the travel not empty"
        )
    return LensLimits(
        Steps(math.ceil(min_um / um_per_step - 1e-9)),
        Steps(math.floor(max_um / um_per_step + 1e-9)),
        max_speed_um_s / um_per_step,
        acceleration_um_s2 / um_per_step,
    )


def check_speed(speed_sps: float, limits: LensLimits) -> None:
    """Refuse a speed that is not finite, is zero, or exceeds the limit. Raises ``UsageError``."""
    if not 0.0 < abs(speed_sps) <= limits.max_speed_sps * (1 + 1e-9):
        raise UsageError(
            f"lens: a speed of {speed_sps:g} steps/s was asked for; the limit is {limits.max_speed_sps:g} either way"
        )


def check_target(target: int, limits: LensLimits) -> None:
    """Refuse a target outside the travel. Raises ``UsageError``."""
    if not limits.min_steps <= target <= limits.max_steps:
        raise UsageError(
            f"lens: target {target} steps is outside the travel of {limits.min_steps}..{limits.max_steps}; "
            "choose one inside, or widen lens.min_um or lens.max_um if the lens can go there"
        )


def check_output(name: str, outputs: Sequence[str]) -> None:
    """Refuse an output that the controller does not have. Raises ``UsageError``."""
    if not outputs:
        raise UsageError("lens: this controller has no outputs that it can be told to switch")
    if name not in outputs:
        raise UsageError(f"lens: no output is called {name!r}; this controller has {', '.join(outputs)}")


def run_target(
    steps: float, velocity_sps: float, wanted_sps: float, time_left_ns: int, limits: LensLimits, *, referenced: bool
) -> int:
    """Return where a motion at *wanted_sps* must end so that it is at rest in time and inside the limits.

    From *steps* at *velocity_sps*, ramps included. Unreferenced, the limits say nothing about where the motor is, but
    the travel still bounds how far it may go.
    """
    a, time_s = limits.acceleration_sps2, max(0, time_left_ns) / NS_PER_S
    way = math.copysign(1.0, wanted_sps)
    speed, before = abs(wanted_sps), way * velocity_sps
    gone = speed * time_s - ((speed - before) ** 2 + speed * speed) / (2 * a)
    shortest = before * abs(before) / (2 * a)
    if gone < shortest:
        # too little time to reach the speed: a triangle whose top is what the time allows
        top = max(0.0, (a * time_s + before) / 2)
        gone = max(shortest, (2 * top * top - before * before) / (2 * a))
    travel = limits.max_steps - limits.min_steps
    end = steps + way * min(gone, float(travel))
    if referenced:
        end = min(max(end, limits.min_steps), limits.max_steps)
    return math.floor(end) if way > 0 else math.ceil(end)


def with_measured_stop(assumed: LensCapabilities, measured: Mapping[StopMode, StopTiming]) -> LensCapabilities:
    """Return the capabilities with the stop that a cycle uses as it was measured, if it was."""
    stop = measured.get(StopMode.ABRUPT if assumed.abrupt_stop else StopMode.RAMPED)
    if stop is None:
        return assumed
    return replace(
        assumed,
        stop_onset_ms=stop.onset_ms,
        stop_onset_sigma_ms=stop.onset_sigma_ms,
        stop_deceleration_sps2=stop.deceleration_sps2,
        stop_deceleration_sigma_sps2=stop.deceleration_sigma_sps2,
    )
