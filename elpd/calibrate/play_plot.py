"""A lens's play as a picture: where focus was seen, over the speed at which it was passed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.calibrate.figure import GREY, INK, both_ways, head, nothing, sheet, write

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.calibrate.play import BacklashCalibration


def draw_play(path: Path, found: BacklashCalibration) -> None:
    """Write the picture. Raises ``UsageError`` without matplotlib or where the file cannot be written."""
    figure = sheet(f"{found.on.device}, measured {found.measured_utc}", width_in=7.0, height_in=4.6)
    axes = figure.subplots()
    if not found.readings:
        nothing(axes, "focus, by the motor's count", f"not measurable, because {found.backlash_um.reason}")
        write(figure, path)
        return
    head(axes, "focus, by the motor's count", f"play {found.backlash_um}\nlate by {found.lag_us}")
    both_ways(axes, ((one.speed_um_s, one.focus_um, one.sigma_um) for one in found.readings))
    play_um, lag_us = found.backlash_um.value, found.lag_us.value
    if play_um is not None and lag_us is not None:
        middle_um = sum(one.focus_um for one in found.readings) / len(found.readings)
        fastest = max(abs(one.speed_um_s) for one in found.readings)
        for sign in (1, -1):
            ends = [middle_um + sign * (play_um / 2 + speed * lag_us * 1e-6) for speed in (0.0, fastest)]
            axes.plot([0.0, fastest], ends, color=GREY, lw=1.2, zorder=0)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.4 * (high - low))  # room for the words
    axes.set_xlim(left=0.0)
    axes.legend(loc="center right", frameon=False, fontsize=8)
    axes.set_xlabel("speed, um/s", color=INK)
    axes.set_ylabel("um", color=INK)
    write(figure, path)
