"""What a Theia MCR board must be told of its lens, and the limits that follow from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.errors import ConfigError
from elpd_drivers.lenses import theia_wire as wire
from elpd_drivers.lenses.axis import limits_from

if TYPE_CHECKING:
    from elpd.records import LensLimits

SLOWEST_PPS = 100
START_S = 1e-4
"""It starts and ends at full speed, as far as anybody can tell."""


@dataclass(frozen=True, slots=True)
class TheiaSettings:
    """The table ``[lens]`` for a Theia MCR board. 0 um is at the switch of the motor.

    ``motor`` is 1 (focus) or 2 (zoom). ``switch`` says at which end of the travel it is: "low" where 0x66 leads away
    from it. ``connect_ms`` is how long to wait for a board that does not answer because it moves, ``late_ms`` how much
    longer than it should take a motion may go without an answer. ``position_file`` is where to keep the position from
    one session to the next; without it each begins with homing. ``latency_us`` is the usual time from a command's
    last bit to its effect, USB included, and ``latency_sigma_us`` how well that is known; unless given, a real port
    gets what USB adapters need. With ``iris_axis`` = 3 the board's iris motor is the output "iris": between
    ``iris_closed`` (its closed stop) and ``iris_open``, steps, at ``iris_speed_sps``, 10 to 200.
    """

    port: str = ""
    baud: int = 115_200
    motor: int = 1
    switch: str = "low"
    um_per_step: float = 0.3125
    min_um: float = 0.0
    max_um: float = 2500.0
    max_speed_um_s: float = 375.0
    query_ms: float = 20.0
    reply_ms: float = 100.0
    connect_ms: float = 5000.0
    late_ms: float = 500.0
    position_file: str = ""
    latency_us: float = 300.0
    latency_sigma_us: float = 87.0
    iris_axis: int | None = None
    iris_closed: int = 0
    iris_open: int = 0
    iris_speed_sps: float = 0.0


def limits_of(settings: TheiaSettings) -> LensLimits:
    """Read the limits, and refuse what the board's messages cannot carry."""
    ramp_um_s2 = settings.max_speed_um_s / START_S
    limits = limits_from(settings.um_per_step, settings.min_um, settings.max_um, settings.max_speed_um_s, ramp_um_s2)
    if settings.motor not in {1, 2} or settings.switch not in {"low", "high"}:
        raise ConfigError('lens: motor is 1 (focus) or 2 (zoom), switch is "low" or "high"; correct them')
    if not limits.min_steps <= 0 <= limits.max_steps or (limits.min_steps < 0) == (settings.switch == "low"):
        raise ConfigError(
            f"lens: {settings.min_um:g} to {settings.max_um:g} um must begin (lens.switch low) or end (high) at 0, the "
            "switch; correct min_um and max_um"
        )
    if limits.max_steps - limits.min_steps > wire.LONGEST_MOVE or limits.max_speed_sps > wire.LONGEST_MOVE:
        raise ConfigError(f"lens: the travel in steps and the speed in steps/s must not exceed {wire.LONGEST_MOVE}")
    if limits.max_speed_sps < SLOWEST_PPS:
        raise ConfigError(
            f"lens: max_speed_um_s is {limits.max_speed_sps:g} steps/s, at least {SLOWEST_PPS} are needed"
        )
    return limits
