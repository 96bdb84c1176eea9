"""`elpd calibrate aperture`: how this aperture opens, on the rig or from a recording of a grey card."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from elpd.cli.common import config_options, json_option, parse_interval_us, print_json
from elpd.config import load
from elpd.errors import UsageError

if TYPE_CHECKING:
    from elpd.calibrate.aperture import ApertureCalibration
    from elpd.calibrate.evidence import Columns
    from elpd.config import Config
    from elpd.records import Geometry

MOST_OPENINGS = 50


@click.command("aperture")
@click.argument("path", required=False, type=click.Path(path_type=Path))
@click.option("--open-us", "interval", metavar="A,B", help="In a recording: the opening, and some darkness before it.")
@click.option("--openings", default=4, show_default=True, metavar="N", help="On the rig: how often to open.")
@click.option("--threshold", metavar="C[,SIGMA]", help="ON threshold in natural log; else the stored sensor profile's.")
@click.option(
    "--refractory-us", type=float, metavar="US", help="How long a pixel is deaf after an event; else measured."
)
@click.option(
    "--lag-us", type=float, metavar="US", help="The photoreceptors' lag at full light; else left in the curve."
)
@click.option("--plot", type=click.Path(path_type=Path, dir_okay=False), help="Draw it, as a PNG.")
@click.option("--dry-run", is_flag=True, help="Measure, but leave the stored profile as it is.")
@config_options
@json_option
def command(
    *,
    path: Path | None,
    interval: str | None,
    openings: int,
    threshold: str | None,
    refractory_us: float | None,
    lag_us: float | None,
    plot: Path | None,
    dry_run: bool,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    """Measure transmittance over time while the aperture opens over a grey card, bright and evenly lit.

    Without PATH: on the rig; the lens stays where it is. PATH is an event file or a run's folder in which the aperture
    opens once; what it tells is stored for the aperture of the configuration.
    """
    config = load(config_path, overrides)
    if plot is not None and not plot.resolve().parent.is_dir():
        raise UsageError(f"--plot {plot}: there is no folder {plot.resolve().parent}; make it first")
    span = parse_interval_us(interval, "--open-us")
    if path is None and span is not None:
        raise UsageError("--open-us is about a recording; give PATH")
    if not 1 <= openings <= MOST_OPENINGS:
        raise UsageError(f"--openings is {openings}; it takes 1 to {MOST_OPENINGS}")
    for name, value in (("--refractory-us", refractory_us), ("--lag-us", lag_us)):
        if value is not None and not 0 <= value < 1e5:
            raise UsageError(f"{name} is {value:g}; it takes 0 to 100000 microseconds")
    given = None if threshold is None else _parse_threshold(threshold)
    from elpd.calibrate.aperture import ApertureCalibration, combine, measured_on  # noqa: PLC0415  (numba only now)
    from elpd.calibrate.opening import Pixels, measure_opening  # noqa: PLC0415
    from elpd.calibrate.profile import make_room, save, state_directory  # noqa: PLC0415

    c, c_sigma = given or _stored_threshold(config)
    if not dry_run:
        make_room(state_directory(config), ApertureCalibration)
    if path is None:
        geometry, taken = _on_the_rig(config, openings, quiet=as_json)
    else:
        geometry, taken = _recorded(path, span)
    curves, delays = [], []
    for events, begin_us, told_us, end_us in taken:
        deaf_us = _deafness(events, geometry) if refractory_us is None else refractory_us
        pixels = Pixels(c, c_sigma, deaf_us, lag_us)
        curves.append(measure_opening(events, geometry, begin_us, end_us, pixels))
        if told_us is not None:
            delays.append(curves[-1].begin_us - told_us)
    on = measured_on(config)
    found = combine(curves, delays, on, threshold=c, lag_corrected=lag_us is not None)
    stored = None if dry_run else save(state_directory(config), found)
    if plot is not None:
        from elpd.calibrate.opening_plot import draw_opening  # noqa: PLC0415

        draw_opening(plot, found)
    if as_json:
        print_json({**found.model_dump(mode="json"), "saved": stored, "plot": plot})
    else:
        _tell(found)
        if stored is not None:
            print(f"stored in {stored}")
    return 0


def _parse_threshold(text: str) -> tuple[float, float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in {1, 2} or not 0.01 <= numbers[0] <= 1 or not all(0 <= one < 1 for one in numbers[1:]):
        raise UsageError(
            f"--threshold is C or C,SIGMA in natural log, C from 0.01 to 1, such as 0.18,0.01; got {text!r}"
        )
    return numbers[0], (numbers[1] if len(numbers) == 2 else 0.0)


def _stored_threshold(config: Config) -> tuple[float, float]:
    from elpd.calibrate.profile import load as load_profile  # noqa: PLC0415
    from elpd.calibrate.profile import state_directory  # noqa: PLC0415
    from elpd.calibrate.sensor import SensorCalibration  # noqa: PLC0415

    stored = load_profile(state_directory(config), SensorCalibration)
    if stored is None or stored.threshold_on.value is None:
        why = "there is no sensor profile" if stored is None else f"the sensor profile has none: {stored.threshold_on}"
        raise UsageError(
            f"events count thresholds, and nobody knows how large one is ({why}); give --threshold C, in natural log"
        )
    return stored.threshold_on.value, stored.threshold_on.sigma or 0.0


def _on_the_rig(
    config: Config, openings: int, *, quiet: bool
) -> tuple[Geometry, list[tuple[Columns, int, int | None, int]]]:
    from elpd import rig  # noqa: PLC0415
    from elpd.calibrate.aperture_live import take_openings  # noqa: PLC0415

    def progress(words: str) -> None:
        if not quiet:
            print(f"{words} ...", file=sys.stderr)

    without = config.model_copy(update={"state": config.state.model_copy(update={"profiles": False})})
    parts = rig.build(without)
    try:
        return parts.camera.geometry, [*take_openings(parts, openings, progress)]
    finally:
        rig.release(parts)


def _recorded(path: Path, span: tuple[int, int] | None) -> tuple[Geometry, list[tuple[Columns, int, int | None, int]]]:
    from elpd.record.calibration import events_of  # noqa: PLC0415

    events, geometry = events_of(path)
    first_us, last_us = int(events.t_us[0]), int(events.t_us[-1])
    begin_us, end_us = (first_us, last_us + 1) if span is None else span
    if not events.between(begin_us, end_us).t_us.size:
        raise UsageError(f"--open-us {begin_us},{end_us} holds no event; {path} holds {first_us} to {last_us} us")
    return geometry, [(events, begin_us, None, end_us)]


def _deafness(events: Columns, geometry: Geometry) -> float:
    from elpd.vision.refractory import refractory_period  # noqa: PLC0415

    shape = (geometry.height, geometry.width)
    return refractory_period(events.t_us, events.x, events.y, events.on, shape).period_us


def _tell(found: ApertureCalibration) -> None:
    print(f"delay     {found.delay_us}")
    print(f"opening   {found.opening_us}")
    shares = (0.01, 0.1, 0.5, 0.9)
    for share in shares:
        row = next(i for i, value in enumerate(found.transmittance) if value >= share)
        print(f"          {found.transmittance[row]:.3f} ± {found.sigma[row]:.1%} after {found.since_us[row]:.0f} us")
    print(f"scale     log T within {found.scale_sigma:.1%} (threshold {found.threshold:g})")
    print(f"lag       {'taken out' if found.lag_corrected else 'left in the curve; --lag-us takes it out'}")
    print(f"from      {found.openings} openings, {found.events} events")
