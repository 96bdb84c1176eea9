"""An aperture's calibration as a picture: transmittance over time, and its logarithm, with errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.calibrate.figure import BLUE, GREY, INK, head, sheet, write

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.calibrate.aperture import ApertureCalibration


def draw_opening(path: Path, found: ApertureCalibration) -> None:
    """Write the picture. Raises ``UsageError`` without matplotlib or where the file cannot be written."""
    figure = sheet(f"{found.on.device}, measured {found.measured_utc}", height_in=4.6)
    linear, logarithmic = figure.subplots(1, 2)
    since_ms = np.array(found.since_us) / 1e3
    light, log_sigma = np.array(found.transmittance), np.array(found.sigma)
    high = np.minimum(light * np.exp(log_sigma), 1.0)
    words = f"opens within {found.opening_us}\nbegins after {found.delay_us}\n{found.openings} openings"
    head(linear, "light that passes", words)
    linear.fill_between(since_ms, light * np.exp(-log_sigma), high, color=GREY, alpha=0.4, lw=0)
    linear.plot(since_ms, light, "o-", color=BLUE, ms=3)
    linear.set_ylim(top=1.35)
    linear.set_ylabel("transmittance", color=INK)
    lit = light > 0.0
    head(logarithmic, "its logarithm, which events count", f"as a whole it may be stretched by {found.scale_sigma:.1%}")
    logarithmic.errorbar(
        since_ms[lit], np.log(light[lit]), log_sigma[lit], fmt="o-", color=BLUE, ecolor=GREY, capsize=2, ms=3
    )
    low, high_end = logarithmic.get_ylim()
    logarithmic.set_ylim(low, high_end + 0.2 * (high_end - low))  # room for the words
    logarithmic.set_ylabel("ln transmittance", color=INK)
    for axes in (linear, logarithmic):
        axes.set_xlabel("since the first light, ms", color=INK)
    write(figure, path)
