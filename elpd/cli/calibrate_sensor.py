"""`elpd calibrate sensor`: what this camera's pixels are like, on the rig or from a recording."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from elpd.cli.common import config_options, json_option, parse_interval_us, print_json
from elpd.config import load
from elpd.errors import UsageError

if TYPE_CHECKING:
    from elpd.calibrate.evidence import Evidence
    from elpd.calibrate.profile import MeasuredOn
    from elpd.calibrate.sensor import SensorCalibration
    from elpd.config import Config

REACH_DOF = 20.0

WORDS = {
    "noise_on_hz": "noise, ON",
    "noise_off_hz": "noise, OFF",
    "noise_on_off_ratio": "noise, ON / OFF",
    "dispersion_pixels": "dispersion over pixels",
    "dispersion_time": "dispersion over time",
    "threshold_ratio": "threshold, ON / OFF",
    "threshold_on": "threshold, ON",
    "threshold_off": "threshold, OFF",
    "mismatch": "threshold mismatch",
    "refractory_us": "refractory period",
    "lag_us": "photoreceptor lag",
    "lag_constant_us": "lag of all alike",
}


@click.command("sensor")
@click.argument("path", required=False, type=click.Path(path_type=Path))
@click.option("--rest-s", default=1.0, show_default=True, metavar="S", help="How long noise is watched.")
@click.option(
    "--reach-um", type=float, metavar="UM", help="How far to go to either side; by default 20 depths of focus."
)
@click.option("--black", type=float, metavar="DN", help="Grey level of darkness in frames; else its bounds are used.")
@click.option("--here", is_flag=True, help="The lens stands in focus already; do not focus first.")
@click.option("--rest-us", "rest_text", metavar="A,B", help="In a recording: nothing moved between these times.")
@click.option("--plot", type=click.Path(path_type=Path, dir_okay=False), help="Draw it, as a PNG.")
@click.option(
    "--keep", type=click.Path(path_type=Path, dir_okay=False), help="Keep the evidence, as an .npz, for PATH."
)
@click.option("--dry-run", is_flag=True, help="Measure, but leave the stored profile as it is.")
@config_options
@json_option
def command(
    *,
    path: Path | None,
    rest_s: float,
    reach_um: float | None,
    black: float | None,
    here: bool,
    rest_text: str | None,
    plot: Path | None,
    keep: Path | None,
    dry_run: bool,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    """Measure noise, hot pixels, thresholds, refractory period and photoreceptor lag, each with its error.

    Without PATH: on the rig, aimed at something with texture, light and shade that stands still. It focuses, rests, and
    goes there and back at two speeds. PATH is evidence that --keep wrote, a run's folder, a sweep's folder or an event
    file; nothing is stored then. Exit 0 with a profile, 1 if the sweeps could not be made (nothing is stored).
    """
    config = load(config_path, overrides)
    rest_us = parse_interval_us(rest_text, "--rest-us")
    for name, file in (("--plot", plot), ("--keep", keep)):
        if file is not None and not file.resolve().parent.is_dir():
            raise UsageError(f"{name} {file}: there is no folder {file.resolve().parent}; make it first")
    if not 0.05 <= rest_s <= 600.0:
        raise UsageError(f"--rest-s is {rest_s:g}; it takes 0.05 to 600 seconds")
    if path is not None and keep is not None:
        raise UsageError("--keep keeps what a rig shows; PATH is kept already")
    if path is None and rest_us is not None:
        raise UsageError("--rest-us is about a recording; give PATH, or --rest-s for the rig")
    from elpd.calibrate.plot import draw  # noqa: PLC0415  (numba and devices only now)
    from elpd.calibrate.profile import make_room, save, state_directory  # noqa: PLC0415
    from elpd.calibrate.sensor import SensorCalibration, measure_sensor  # noqa: PLC0415

    if path is None:
        if not dry_run:
            make_room(state_directory(config), SensorCalibration)
        evidence, on, depth_of_focus_um = _on_the_rig(config, rest_s, reach_um, black, keep, here=here, quiet=as_json)
    else:
        evidence, on, depth_of_focus_um = _recorded(path, rest_us, config)
    found = measure_sensor(evidence, on, depth_of_focus_um)
    if plot is not None:
        draw(plot, found, evidence)
    complete = bool(evidence.sweeps)
    stored = None
    if path is None and complete and not dry_run:
        stored = save(state_directory(config), found)
    if as_json:
        print_json({**found.model_dump(mode="json"), "saved": stored, "plot": plot, "evidence": keep})
    else:
        _tell(found, stored)
    return 0 if complete or path is not None else 1


def _on_the_rig(
    config: Config,
    rest_s: float,
    reach_um: float | None,
    black: float | None,
    keep: Path | None,
    *,
    here: bool,
    quiet: bool,
) -> tuple[Evidence, MeasuredOn, float]:
    from elpd import rig  # noqa: PLC0415
    from elpd.calibrate.evidence_file import save_evidence  # noqa: PLC0415
    from elpd.calibrate.live import take_evidence  # noqa: PLC0415
    from elpd.calibrate.profile import MeasuredOn  # noqa: PLC0415
    from elpd.focus.settings import CycleSettings  # noqa: PLC0415

    settings = CycleSettings.from_config(config)
    depth_of_focus_um = settings.depth_of_focus_um
    reach_um = REACH_DOF * depth_of_focus_um if reach_um is None else reach_um

    def progress(words: str) -> None:
        if not quiet:
            print(f"{words} ...", file=sys.stderr)

    parts = rig.build(config)
    try:
        evidence = take_evidence(
            parts, settings, rest_s=rest_s, reach_um=reach_um, here=here, black=black, progress=progress
        )
        on = MeasuredOn.camera(config, parts.camera)
    finally:
        rig.release(parts)
    if keep is not None:
        save_evidence(keep, evidence, on.model_dump(mode="json"), depth_of_focus_um)
    return evidence, on, depth_of_focus_um


def _recorded(path: Path, rest_us: tuple[int, int] | None, config: Config) -> tuple[Evidence, MeasuredOn, float]:
    from elpd.calibrate.evidence_file import is_evidence, load_evidence  # noqa: PLC0415
    from elpd.calibrate.profile import MeasuredOn  # noqa: PLC0415
    from elpd.record.calibration import read_evidence  # noqa: PLC0415

    if is_evidence(path):
        if rest_us is not None:
            raise UsageError(f"{path} says itself when the lens rested; leave --rest-us out")
        evidence, on, depth_of_focus_um = load_evidence(path)
        return evidence, MeasuredOn.model_validate(on), depth_of_focus_um
    evidence = read_evidence(path, rest_us)
    size = evidence.geometry
    recording = MeasuredOn(
        device=f"recording {path.name}", serial=None, width=size.width, height=size.height, settings={}
    )
    return evidence, recording, config.focus.depth_of_focus_um


def _tell(found: SensorCalibration, stored: Path | None) -> None:
    for name, quantity in found.quantities().items():
        print(f"{WORDS.get(name, name):24s} {quantity}")
    for point in found.lag_by_brightness:
        print(f"{'':24s} {point.lag_us:.0f} ± {point.sigma_us:.0f} us at {point.brightness:.0%} of the brightest")
    print(f"{'hot pixels':24s} {_hot(found)}")
    if stored is not None:
        print(f"stored in {stored}")


def _hot(found: SensorCalibration) -> Any:
    if found.hot_pixels is None:
        return f"not measurable, because {found.hot_reason}"
    some = ", ".join(f"({one.x}, {one.y}) {one.hz:.0f} Hz" for one in found.hot_pixels[:6])
    more = len(found.hot_pixels) - 6
    names = f": {some}{f' and {more} more' if more > 0 else ''}" if found.hot_pixels else ""
    return (
        f"{len(found.hot_pixels)} above {found.hot_above_hz:.3g} Hz{names} "
        f"({found.hot_false_alarms:g} good ones expected among them)"
    )
