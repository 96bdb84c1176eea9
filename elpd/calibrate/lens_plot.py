"""A lens's calibration as a picture: ways over speeds, what is left of them, replies, the ruler."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.calibrate.figure import BLUE, GREY, INK, both_ways, head, nothing, sheet, write

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from elpd.calibrate.lens import LensCalibration
    from elpd.calibrate.stops import ModeFound


def draw_lens(path: Path, found: LensCalibration, round_trips_ns: Sequence[int] = ()) -> None:
    """Write the picture. Raises ``UsageError`` without matplotlib or where the file cannot be written."""
    figure = sheet(f"{found.on.device}, measured {found.measured_utc}")
    ((ramped, abrupt), (replies, ruler)) = figure.subplots(2, 2)
    stopping = found.stopping
    _ways(ramped, "stop on a ramp", None if stopping is None else stopping.ramped)
    _ways(abrupt, "stop at once", None if stopping is None else stopping.abrupt)
    _replies(replies, found, round_trips_ns)
    _ruler(ruler, found)
    write(figure, path)


def _ways(axes: Any, title: str, found: ModeFound | None) -> None:
    if found is None:
        nothing(axes, title, "not tried")
        return
    text = f"onset {found.onset_ms}\nfrom stop to stop {found.onset_scatter_ms}\nbraking {found.deceleration_sps2}"
    head(axes, title, text)
    onset_s, braking = 1e-3 * (found.onset_ms.value or 0.0), found.deceleration_sps2.value
    both_ways(axes, ((one.speed_sps, one.way_steps, one.scatter_steps) for one in found.ways))
    if found.ways:
        speed = np.linspace(0.0, max(abs(one.speed_sps) for one in found.ways), 100)
        ramp = 0.0 if braking is None else speed**2 / (2.0 * braking)
        axes.plot(speed, speed * onset_s + ramp, color=GREY, lw=1.2)
        axes.set_ylim(top=1.4 * axes.get_ylim()[1])  # room for the words
        axes.legend(loc="lower right", frameon=False, fontsize=8)
    axes.set_xlabel("speed, steps/s", color=INK)
    axes.set_ylabel("way after the stop, steps", color=INK)


def _replies(axes: Any, found: LensCalibration, round_trips_ns: Sequence[int]) -> None:
    stopping = found.stopping
    if stopping is None or not round_trips_ns:
        nothing(axes, "replies", "not measured")
        return
    head(axes, "replies", f"median {stopping.round_trip_ms}\njitter {stopping.round_trip_jitter_ms}")
    axes.hist(1e-6 * np.array(round_trips_ns, np.float64), bins=60, color=BLUE)
    axes.set_yscale("log")
    axes.set_ylim(top=20 * axes.get_ylim()[1])  # room for the words
    axes.set_xlabel("from a question's end to its answer's beginning, ms", color=INK)
    axes.set_ylabel("replies", color=INK)


def _ruler(axes: Any, found: LensCalibration) -> None:
    if not found.steps_to_um:
        nothing(axes, "ruler", "one length for every step (no table)")
        return
    steps, um = np.array(found.steps_to_um).T
    mean = (um[-1] - um[0]) / (steps[-1] - steps[0])
    head(axes, "ruler", f"{steps.size} rows, {mean:.4g} um a step on average")
    axes.plot(steps, um - um[0] - mean * (steps - steps[0]), "o-", color=BLUE, ms=4)
    axes.set_xlabel("steps", color=INK)
    axes.set_ylabel("away from a straight line, um", color=INK)
