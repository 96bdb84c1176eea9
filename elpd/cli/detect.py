"""`elpd detect`: the causal detector over a recorded sweep, no lens."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from elpd.calibrate.profile import path_of, state_directory
from elpd.calibrate.sensor import SensorCalibration, sensor_of_file
from elpd.cli.common import config_options, json_option, parse_interval_us, parse_roi, print_json
from elpd.cli.replay import run_cycle
from elpd.config import load
from elpd.errors import FormatError, UsageError
from elpd.focus.picture import Picture
from elpd.record.journal import is_run
from elpd.record.layouts import read_sweep
from elpd.record.paper_sweep import detect_as_published
from elpd.record.replay import load_run, replay_run
from elpd.record.run_sweep import found_live, read_run_sweep
from elpd.record.sweep_file import Detection, SweepSearch
from elpd.records import Direction, Geometry, Outcome
from elpd.units import SensorUs
from elpd.vision.first_events import FirstEventMap
from elpd.vision.pictures import read_picture
from elpd.vision.reference import check_size, reference_from_temporal_image
from elpd.vision.ruler import Ruler
from elpd.vision.temporal_map import quality, read_transmittance, temporal_image

if TYPE_CHECKING:
    from elpd.record.run_sweep import RunSweep
    from elpd.records import TemporalImage


@click.command(name="detect")
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--roi", "roi_text", metavar="X,Y,W,H", help="Where to focus; by default info.txt's region, or all.")
@click.option("--frames", metavar="DIR|none", help="Folder of frames, relative to PATH, or none.")
@click.option(
    "--reference", "reference_path", type=click.Path(path_type=Path), help="An image that is there from the start."
)
@click.option("--aperture-us", "aperture_text", metavar="A,B", help="The aperture opened in this interval.")
@click.option("--transmittance", default="iris", show_default=True, metavar="linear|iris|FILE", help="How it opened.")
@click.option("--speed-um-s", type=float, help="Constant speed of the lens.")
@click.option("--lens-path", "lens_path", type=click.Path(path_type=Path), help="CSV with rows t_us,position_um.")
@click.option("--dof-um", type=float, help="Depth of focus.")
@click.option(
    "--sensor",
    metavar="FILE|stored",
    help="What `elpd calibrate sensor` measured of the camera that made the recording; `stored` is this rig's own.",
)
@click.option("--method", type=click.Choice(["elpd", "paper"]), default="elpd", show_default=True)
@config_options
@json_option
def command(
    path: Path,
    roi_text: str | None,
    frames: str | None,
    reference_path: Path | None,
    aperture_text: str | None,
    transmittance: str,
    speed_um_s: float | None,
    lens_path: Path | None,
    dof_um: float | None,
    sensor: str | None,
    method: str,
    *,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    """Find focus in a recorded sweep, using nothing later than the decision."""
    config = load(config_path, overrides)
    aperture_us = parse_interval_us(aperture_text, "--aperture-us")
    roi = parse_roi(roi_text)
    ruler = _ruler(speed_um_s, lens_path)
    if dof_um is not None and not dof_um > 0.0:
        raise UsageError(f"--dof-um must be positive; got {dof_um}")
    given = None if reference_path is None else read_picture(reference_path)
    size = None if given is None else Geometry(given.pixels.shape[1], given.pixels.shape[0])
    recorded = read_run_sweep(path) if is_run(path) else None
    as_recorded = not any(
        (roi, frames, reference_path, aperture_us, speed_um_s, lens_path, dof_um, sensor, method == "paper")
    )
    if recorded is not None and as_recorded:
        found = _run_again(path, recorded)
        if found is not None:
            return _finish(found, as_json=as_json)
    if recorded is None:
        sweep = read_sweep(path, frames=frames, size=size)
    else:
        sweep = replace(recorded.sweep, frames=()) if frames == "none" else recorded.sweep
        aperture_us = aperture_us or recorded.aperture_us
        dof_um = dof_um or load_run(path).config["focus"]["depth_of_focus_um"]
        if speed_um_s is None and lens_path is None:
            ruler = Ruler.of_path(recorded.path_t_us, recorded.path_um)
    for warning in sweep.warnings:
        print(f"elpd: {path}: {warning}", file=sys.stderr)
    roi = roi or sweep.roi
    if not roi.fits(sweep.geometry):
        raise UsageError(
            f"the region {roi.x},{roi.y},{roi.width},{roi.height} does not fit the sensor's "
            f"{sweep.geometry.width}x{sweep.geometry.height} pixels"
        )
    reference = None
    begin_us = None
    picture = None
    if aperture_us is not None:
        first = FirstEventMap(sweep.geometry, *aperture_us)
        first.add(sweep.t_us, sweep.x, sweep.y, sweep.on)
        picture = temporal_image(first.believed(), read_transmittance(transmittance), SensorUs(aperture_us[0]))
        usable, why = quality(picture)
        if not usable:
            return _finish(Detection(Outcome.NO_TEXTURE, why, Direction.UNKNOWN), as_json=as_json)
        reference = reference_from_temporal_image(picture, roi)
        begin_us = aperture_us[1]
    if recorded is not None:
        begin_us = recorded.begin_us
    pixels = None
    if given is not None:
        check_size(given.pixels.shape, sweep.geometry, str(reference_path))
        whole = Picture.of_image(given)
        picture, pixels, reference = whole.map or picture, whole.pixels, whole.reference(roi)
    if method == "paper":
        found = detect_as_published(sweep, roi, pixels if picture is None else _as_published(picture), begin_us)
        return _finish(found, as_json=as_json)
    known = None
    if sensor is not None:
        file = path_of(state_directory(config), SensorCalibration) if sensor == "stored" else Path(sensor)
        known = sensor_of_file(file, sweep.geometry)
    search = SweepSearch(
        sweep,
        roi,
        ruler,
        depth_of_focus_um=dof_um,
        begin_us=begin_us,
        reference=reference,
        sensor=known,
        max_sigma_dof=config.focus.max_sigma_dof,
    )
    return _finish(search.run(), as_json=as_json)


def _run_again(path: Path, recorded: RunSweep) -> Detection | None:
    """Run a recorded cycle again; what it found, if that is what it found then and it is a focus."""
    report = replay_run(load_run(path), run_cycle)
    return found_live(recorded, report.result) if report.identical and report.result is not None else None


def _finish(found: Detection, *, as_json: bool) -> int:
    if as_json:
        print_json(_answer(found))
    else:
        _tell(found)
    return 0 if found.outcome is Outcome.FOCUSED else 1


def _as_published(picture: TemporalImage) -> np.ndarray:
    """Return a temporal map as its authors' code writes it: linear, stretched, to the power 1.5, read as 8 bit."""
    linear = np.exp(picture.log_intensity.astype(np.float64))
    stretched = (linear - linear.min()) / max(float(np.ptp(linear)), 1e-12)
    return np.asarray(np.rint(255.0 * stretched**1.5), dtype=np.uint8)


def _ruler(speed_um_s: float | None, lens_path: Path | None) -> Ruler:
    if speed_um_s is not None and lens_path is not None:
        raise UsageError("--speed-um-s and --lens-path exclude each other; give one")
    if speed_um_s is not None:
        return Ruler.of_speed(speed_um_s)
    if lens_path is None:
        return Ruler.of_time()
    return Ruler.of_path(*read_lens_path(lens_path))


def read_lens_path(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read ``t_us,position_um`` rows; a heading is allowed. Raises ``FormatError``."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{path}: cannot be read as a lens path ({error})") from None
    rows = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if rows and not _numbers(rows[0]):
        rows = rows[1:]
    table = [_numbers(row) for row in rows]
    if len(table) < 2 or not all(table):
        raise FormatError(f"{path}: a lens path is a CSV of t_us,position_um with two rows or more")
    values = np.array(table, dtype=np.float64)
    return values[:, 0], values[:, 1]


def _numbers(row: str) -> tuple[float, float] | None:
    parts = row.replace(";", ",").split(",")
    if len(parts) < 2:
        return None
    try:
        return float(parts[0]), float(parts[1])
    except ValueError:
        return None


def _answer(found: Detection) -> dict[str, Any]:
    return {
        "outcome": found.outcome.value,
        "direction": found.direction.value,
        "direction_decided_us": found.direction_decided_us,
        "elp_crossing_us": found.elp_crossing_us,
        "focus_us": found.focus_us,
        "sigma_us": found.sigma_us,
        "decided_us": found.decided_us,
        "method": found.method,
        "events": found.events,
        "windows": found.windows,
        "reason": found.reason,
        "warnings": list(found.warnings),
        "depths_us": list(found.depths_us),
        "contributions": [
            {"name": name, "at": at, "sigma": sigma, "weight": weight}
            for name, at, sigma, weight in (found.focus.contributions if found.focus else ())
        ],
    }


def _tell(found: Detection) -> None:
    print(f"{found.outcome.value}: {found.reason}")
    for warning in found.warnings:
        print(f"  warning: {warning}")
    print(f"direction {found.direction.value}, {found.events} events in {found.windows} windows")
    if found.focus_us is not None:
        print(f"focus at {found.focus_us} us ± {found.sigma_us} us, decided at {found.decided_us} us ({found.method})")
