"""What a cycle is told: numbers, not the configuration they came from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.config import Config
    from elpd.records import Roi, SensorProfile


MAX_SIGMA_DOF = 0.5
"""The standard error, in depths of focus, above which there is no FOCUSED unless a configuration says otherwise."""


@dataclass(frozen=True, slots=True)
class CycleSettings:
    """The numbers of one rig and one taste; see ``elpd.config`` for what each means."""

    speed_um_s: float = 4000.0
    backlash_um: float = 6.0
    measured_play_um: tuple[float, float] | None = None
    first_direction: Literal["auto", "up", "down"] = "auto"
    roi_fraction: float = 0.4
    depth_of_focus_um: float = 6.0
    deadline_ms: float = 5000.0
    max_travel_um: float = 1500.0
    max_reversals: int = 2
    max_sigma_dof: float = MAX_SIGMA_DOF
    cross_again: Literal["better", "needed"] = "better"
    on_failure: Literal["hold", "start", "preset"] = "start"
    preset_um: float | None = None
    transmittance: Literal["profile", "linear", "iris"] = "profile"
    background_activity_us: int = 0

    @classmethod
    def from_config(cls, config: Config) -> CycleSettings:
        """Pick the cycle's numbers out of a configuration. On a simulated rig, the rig's optics and speed count."""
        focus = config.focus.model_dump(exclude={"roi"})
        speed_um_s = config.lens.speed_um_s
        if config.rig == "sim":
            focus["depth_of_focus_um"] = config.sim.depth_of_focus_um
            speed_um_s = config.sim.speed_um_s
        return cls(
            speed_um_s=speed_um_s,
            backlash_um=config.lens.backlash_um,
            measured_play_um=config.lens.measured_play_um,
            first_direction=config.lens.first_direction,
            **focus,
        )


@dataclass(frozen=True, slots=True)
class FocusRequest:
    """One request.

    The picture to focus on is the file ``reference`` (an image of the whole sensor, or a stored map), or, without one,
    what the aperture's opening or the newest frame shows. ``sensor`` is what a calibration knows of this camera.
    """

    roi: Roi | None = None
    reference: Path | None = None
    dry_run: bool = False
    sensor: SensorProfile | None = None
