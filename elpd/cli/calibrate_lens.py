"""`elpd calibrate lens`: how this lens stops, or the ruler that somebody measured for it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from elpd.cli.common import config_options, json_option, print_json
from elpd.config import load
from elpd.errors import UsageError

if TYPE_CHECKING:
    from elpd.calibrate.lens import LensCalibration, Stopping
    from elpd.calibrate.profile import MeasuredOn
    from elpd.calibrate.stops import ModeFound
    from elpd.config import Config


@click.command("lens")
@click.option(
    "--table",
    type=click.Path(path_type=Path, dir_okay=False),
    help="A CSV of steps,um measured with a gauge: becomes the lens's ruler. Nothing moves.",
)
@click.option(
    "--speed",
    "speed_um_s",
    type=click.FloatRange(min=0, min_open=True),
    metavar="UM_S",
    help="The highest speed to stop from; the sweep's if not given.",
)
@click.option(
    "--repeats",
    type=click.IntRange(2, 100),
    default=4,
    show_default=True,
    help="Stops each way at each of four speeds.",
)
@click.option("--no-home", is_flag=True, help="Do not home: lost steps are not looked for.")
@click.option("--plot", type=click.Path(path_type=Path, dir_okay=False), help="Draw it, as a PNG.")
@click.option("--dry-run", is_flag=True, help="Measure, but leave the stored profile as it is.")
@config_options
@json_option
def command(
    *,
    table: Path | None,
    speed_um_s: float | None,
    repeats: int,
    no_home: bool,
    plot: Path | None,
    dry_run: bool,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    """Measure how the lens stops, how its replies travel and whether it loses steps, each with its error.

    It homes, runs and stops at four speeds in the middle of the travel, and homes again; no camera is needed. With
    --table nothing moves: the rows become the lens's ruler, unless the configuration has its own. Exit 0 with a
    profile, 1 if stops could not be measured.
    """
    config = load(config_path, overrides)
    if plot is not None and not plot.resolve().parent.is_dir():
        raise UsageError(f"--plot {plot}: there is no folder {plot.resolve().parent}; make it first")
    from elpd.calibrate.lens import LensCalibration, keep, read_table, with_part  # noqa: PLC0415  (numpy only now)
    from elpd.calibrate.profile import MeasuredOn, make_room, state_directory  # noqa: PLC0415

    if not dry_run:
        make_room(state_directory(config), LensCalibration)
    trips: tuple[int, ...] = ()
    if table is not None:
        rows = read_table(table, config.lens.um_per_step)
        found = with_part(config, MeasuredOn.lens(config), steps_to_um=rows)
    else:
        stopping, on, trips = _on_the_rig(config, speed_um_s, repeats, home=not no_home, quiet=as_json)
        found = with_part(config, on, stopping=stopping)
    if plot is not None:
        from elpd.calibrate.lens_plot import draw_lens  # noqa: PLC0415

        draw_lens(plot, found, trips)
    known = table is not None or _timed(found)
    stored = keep(config, found) if known and not dry_run else None
    if as_json:
        print_json({**found.model_dump(mode="json"), "saved": stored, "plot": plot})
    else:
        _tell(found, config, stored)
    return 0 if known else 1


def _on_the_rig(
    config: Config, speed_um_s: float | None, repeats: int, *, home: bool, quiet: bool
) -> tuple[Stopping, MeasuredOn, tuple[int, ...]]:
    from elpd import rig  # noqa: PLC0415
    from elpd.calibrate.lens import measure_lens  # noqa: PLC0415
    from elpd.calibrate.lens_live import LensBench  # noqa: PLC0415
    from elpd.calibrate.profile import MeasuredOn  # noqa: PLC0415
    from elpd.focus.settings import CycleSettings  # noqa: PLC0415

    def progress(words: str) -> None:
        if not quiet:
            print(f"{words} ...", file=sys.stderr)

    speed_um_s = CycleSettings.from_config(config).speed_um_s if speed_um_s is None else speed_um_s
    naive = config.model_copy(update={"state": config.state.model_copy(update={"profiles": False})})
    with rig.lens_alone(naive) as (clock, lens, scale):
        bench = LensBench(clock, lens, scale, speed_um_s=speed_um_s, repeats=repeats, progress=progress)
        evidence = bench.measure(homing=home)
        on = MeasuredOn.lens(config, lens)
    return measure_lens(evidence), on, evidence.round_trips_ns


def _timed(found: LensCalibration) -> bool:
    return found.stopping is not None and bool(found.stopping.timings())


def _tell(found: LensCalibration, config: Config, stored: Path | None) -> None:
    stopping = found.stopping
    if stopping is not None:
        _tell_stop("stop on a ramp", stopping.ramped, config)
        _tell_stop("stop at once", stopping.abrupt, config)
        print(f"{'round trip':24s} {stopping.round_trip_ms}; jitter {stopping.round_trip_jitter_ms}")
        print(f"{'steps lost':24s} {stopping.lost_steps}")
    if found.steps_to_um:
        (low, first), (high, last) = found.steps_to_um[0], found.steps_to_um[-1]
        print(f"{'ruler':24s} {len(found.steps_to_um)} rows, steps {low:g} to {high:g}, {first:g} to {last:g} um")
        if config.lens.steps_to_um:
            print(f"{'':24s} not used while the configuration has its own lens.steps_to_um")
    for warning in stopping.warnings if stopping is not None else ():
        print(f"warning: {warning}", file=sys.stderr)
    if stored is not None:
        print(f"stored in {stored}")


def _tell_stop(name: str, found: ModeFound | None, config: Config) -> None:
    if found is None:
        print(f"{name:24s} not tried")
        return
    print(f"{name:24s} bites after {found.onset_ms}, from stop to stop ± {found.onset_scatter_ms}")
    print(f"{'':24s} brakes with {found.deceleration_sps2}")
    if found.set_ramp_onset_ms.value is not None:
        print(f"{'':24s} which is what it is set to; by that, bites after {found.set_ramp_onset_ms}")
    print(f"{'':24s} at rest after {found.settle_ms}, from the highest speed")
    for row in found.ways:
        um_s = row.speed_sps * config.lens.um_per_step
        print(
            f"{'':24s} {um_s:+8.0f} um/s: {row.way_steps:7.1f} ± {row.scatter_steps:.1f} steps, "
            f"at rest after {row.settled_ms:.1f} ms ({row.stops} stops)"
        )
