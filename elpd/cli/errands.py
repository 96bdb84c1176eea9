"""What `home`, `move`, `jog` and `stop` share: a lens opened for one errand, and how its end is told."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import click

from elpd import rig
from elpd.cli.common import config_options, from_here, interruptible, json_option, print_json
from elpd.config import Config, load
from elpd.motion.errand import Arrival, Errands

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

F = TypeVar("F", bound="Callable[..., Any]")


def errand_options(function: F) -> F:
    """Add the options that every errand has."""
    foreground = click.option("--foreground", is_flag=True, help="From this process, not through the daemon.")
    return foreground(config_options(json_option(function)))


def run(
    errand: Callable[[Errands, Config], Arrival],
    *,
    foreground: bool,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    """Open the lens, run *errand*, tell where it rests; return the exit code: 0 there, 1 cancelled."""
    from_here(foreground=foreground, config_path=config_path, overrides=overrides)
    config = load(config_path, overrides)
    with interruptible() as cancelled, rig.lens_alone(config) as (clock, lens, scale):
        errands = Errands(clock, lens, scale, cancelled)
        arrival = errand(errands, config)
        low_um, high_um = errands.limits_um
    if as_json:
        print_json({**arrival.fields(), "limits_um": [low_um, high_um]})
    else:
        came = "" if arrival.from_um is None else f", from {arrival.from_um:.2f} um"
        what = "stopped when asked to" if arrival.cancelled else "at rest"
        known = "" if arrival.referenced else "; the reference is unknown: home the lens before absolute moves"
        print(f"{what} at {arrival.um:.2f} um (step {arrival.steps:.0f}){came}, {arrival.duration_ms:.0f} ms{known}")
    return 1 if arrival.cancelled else 0


def speed_option(function: F) -> F:
    """Add ``--speed`` (as ``speed_um_s``)."""
    return click.option(
        "--speed",
        "speed_um_s",
        type=click.FloatRange(min=0, min_open=True),
        metavar="UM_S",
        help="In um/s; the configuration's lens.speed_um_s if not given.",
    )(function)
