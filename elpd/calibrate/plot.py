"""A sensor's calibration as a picture: the sensor at rest, its counts, its thresholds' balance, its lag."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.calibrate.figure import BLUE, GREY, INK, RED, sheet, write
from elpd.calibrate.lag import slowness_of

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.calibrate.evidence import Evidence
    from elpd.calibrate.quantity import Quantity
    from elpd.calibrate.sensor import SensorCalibration

MOST_RINGS = 60


def draw(path: Path, found: SensorCalibration, evidence: Evidence) -> None:
    """Write the picture. Raises ``UsageError`` without matplotlib or where the file cannot be written."""
    figure = sheet(f"{found.on.device}, {found.on.width}x{found.on.height}, measured {found.measured_utc}")
    ((rest, counts), (balance, lag)) = figure.subplots(2, 2)
    _rest(rest, found, evidence)
    _counts(counts, found, evidence)
    _balance(balance, found, evidence)
    _lag(lag, found)
    write(figure, path)


def _rest(axes: Any, found: SensorCalibration, evidence: Evidence) -> None:
    _head(axes, "at rest", f"ON {found.noise_on_hz}\nOFF {found.noise_off_hz}", found.noise_on_hz)
    if evidence.rest is None:
        return
    on, off = evidence.rest.events.counts(evidence.geometry)
    axes.imshow(np.log1p(np.minimum(on + off, 12)), cmap="magma", interpolation="nearest")
    hot = (found.hot_pixels or ())[:MOST_RINGS]
    axes.plot([one.x for one in hot], [one.y for one in hot], "o", mfc="none", mec="#5ec8ff", ms=9, mew=1.4)
    axes.set_xlabel(
        f"{len(found.hot_pixels or ())} hot pixels (ringed): above {found.hot_above_hz or 0:.3g} Hz", color=INK
    )
    axes.set_xticks([])
    axes.set_yticks([])


def _counts(axes: Any, found: SensorCalibration, evidence: Evidence) -> None:
    _head(axes, "events per pixel at rest", f"variance / mean {found.dispersion_pixels}", found.dispersion_pixels)
    if evidence.rest is None or found.rest_s <= 0.0:
        return
    on, off = evidence.rest.events.counts(evidence.geometry)
    total = (on + off).ravel()
    values, pixels = np.unique(total, return_counts=True)
    bound = (found.hot_above_hz or 0.0) * found.rest_s
    colours = np.where(values < bound - 0.5, BLUE, RED)
    axes.bar(values + 1, pixels, width=0.12 * (values + 1), color=colours)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axvline(bound + 0.5, color=GREY, ls="--", lw=1.2)
    axes.set_xlabel("events + 1 (red: hot)", color=INK)
    axes.set_ylabel("pixels", color=INK)


def _balance(axes: Any, found: SensorCalibration, evidence: Evidence) -> None:
    text = f"$C_{{on}}/C_{{off}}$ = {found.threshold_ratio}\nmismatch {found.mismatch}"
    if found.threshold_on.value is not None:
        text += f"\n$C_{{on}}$ = {found.threshold_on}\n$C_{{off}}$ = {found.threshold_off}"
    _head(axes, "there and back: what ON adds, OFF takes away", text, found.threshold_ratio, corner=True)
    if not evidence.sweeps:
        return
    slowest = min(evidence.sweeps, key=lambda one: one.speed_um_s)
    on, off = slowest.events.counts(evidence.geometry)
    top = max(8, int(np.percentile(np.maximum(on, off), 99.8)))
    axes.hist2d(
        on.ravel(),
        off.ravel(),
        bins=min(top, 60),
        range=((0, top), (0, top)),
        cmap="Blues",
        norm="log",
        rasterized=True,
    )
    if found.threshold_ratio.value is not None:
        axes.plot([0, top], [0, top * found.threshold_ratio.value], color=RED, lw=1.4)
    axes.set_xlim(0, top)
    axes.set_ylim(0, top)
    axes.set_xlabel("ON events of a pixel", color=INK)
    axes.set_ylabel("OFF events of a pixel", color=INK)


def _lag(axes: Any, found: SensorCalibration) -> None:
    _head(axes, "photoreceptor lag", f"brightest parts {found.lag_us}", found.lag_us)
    points = found.lag_by_brightness
    if not points or found.lag_us.value is None:
        return
    axes.errorbar(
        [one.brightness for one in points],
        [one.lag_us for one in points],
        [one.sigma_us for one in points],
        fmt="o",
        color=BLUE,
        capsize=3,
        ms=5,
    )
    bright = np.geomspace(max(0.005, 0.8 * min(one.brightness for one in points)), 1.0, 100)
    axes.plot(bright, found.lag_us.value * slowness_of(bright), color=RED, lw=1.4)
    axes.set_xscale("log")
    axes.set_xlabel("brightness of the pixel, of the brightest parts", color=INK)
    axes.set_ylabel("late by, us", color=INK)
    axes.grid(visible=True, color="#e6e6e6")


def _head(axes: Any, title: str, text: str, main: Quantity, *, corner: bool = False) -> None:
    """Title a panel; say what it shows, in the right or left corner, or in full why it is empty."""
    axes.set_title(title, color=INK, fontsize=10, loc="left", fontweight="bold")
    axes.tick_params(colors=INK, labelsize=8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    known = main.value is not None
    words = text if known else f"not measurable, because\n{main.reason}"
    axes.text(
        (0.03 if corner else 0.98) if known else 0.5,
        0.97 if known else 0.5,
        words,
        transform=axes.transAxes,
        ha=("left" if corner else "right") if known else "center",
        va="top" if known else "center",
        fontsize=8.5,
        color=INK,
        wrap=True,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )
