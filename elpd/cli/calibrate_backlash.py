"""`elpd calibrate backlash`: the play between motor and glass, measured by the rig."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from elpd.cli.common import config_options, json_option, print_json
from elpd.config import load
from elpd.errors import UsageError

REACH_DOF = 20.0


@click.command("backlash")
@click.option(
    "--reach-um", type=float, metavar="UM", help="How far to go to either side; by default 20 depths of focus."
)
@click.option("--here", is_flag=True, help="The lens stands in focus already; do not focus first.")
@click.option("--plot", type=click.Path(path_type=Path, dir_okay=False), help="Draw it, as a PNG.")
@click.option("--dry-run", is_flag=True, help="Measure, but leave the stored profile as it is.")
@config_options
@json_option
def command(
    *,
    reach_um: float | None,
    here: bool,
    plot: Path | None,
    dry_run: bool,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    """Measure the play between motor and glass, with its error.

    Aim at something with texture that stands still. The rig focuses, passes focus in both directions at two speeds and
    compares. Later cycles begin their final approach behind focus by what was found and three standard errors.
    Exit 0 with a profile, 1 if the play could not be measured.
    """
    config = load(config_path, overrides)
    if plot is not None and not plot.resolve().parent.is_dir():
        raise UsageError(f"--plot {plot}: there is no folder {plot.resolve().parent}; make it first")
    from elpd import rig  # noqa: PLC0415  (numba and devices only now)
    from elpd.calibrate.backlash import measure_backlash  # noqa: PLC0415
    from elpd.calibrate.in_use import as_measured  # noqa: PLC0415
    from elpd.calibrate.live import take_evidence  # noqa: PLC0415
    from elpd.calibrate.play import BacklashCalibration, backlash_calibration  # noqa: PLC0415
    from elpd.calibrate.profile import MeasuredOn, make_room, save, state_directory  # noqa: PLC0415
    from elpd.focus.settings import CycleSettings  # noqa: PLC0415

    if not dry_run:
        make_room(state_directory(config), BacklashCalibration)
    config = as_measured(config)
    settings = CycleSettings.from_config(config)
    depth_of_focus_um = settings.depth_of_focus_um

    def progress(words: str) -> None:
        if not as_json:
            print(f"{words} ...", file=sys.stderr)

    parts = rig.build(config)
    try:
        evidence = take_evidence(
            parts,
            settings,
            rest_s=0.0,
            reach_um=REACH_DOF * depth_of_focus_um if reach_um is None else reach_um,
            here=here,
            sweeps_alone=True,
            progress=progress,
        )
        on = MeasuredOn.lens(config, parts.lens, ruler=True)
    finally:
        rig.release(parts)
    found = backlash_calibration(measure_backlash(evidence, depth_of_focus_um), on)
    known = found.backlash_um.value is not None
    stored = save(state_directory(config), found) if known and not dry_run else None
    if plot is not None:
        from elpd.calibrate.play_plot import draw_play  # noqa: PLC0415

        draw_play(plot, found)
    if as_json:
        approach_um = found.approach_um if known else None
        print_json({**found.model_dump(mode="json"), "approach_um": approach_um, "saved": stored, "plot": plot})
        return 0 if known else 1
    print(f"{'play':24s} {found.backlash_um}")
    print(f"{'late by':24s} {found.lag_us}")
    if known:
        print(f"{'final approach':24s} from {found.approach_um:.2f} um behind")
    if stored is not None:
        print(f"stored in {stored}")
    return 0 if known else 1
