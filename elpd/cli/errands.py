"""What `home`, `move`, `jog` and `stop` share: a lens opened for one errand, and how its end is told."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, TypeVar

import click

from elpd.cli.common import config_options, interruptible, json_option, print_json
from elpd.cli.daemon import ask, daemon_unless, naming_the_holder, socket_option
from elpd.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from elpd.client import Client
    from elpd.config import Config
    from elpd.motion.errand import Arrival, Errands

F = TypeVar("F", bound="Callable[..., Any]")


def errand_options(function: F) -> F:
    """Add the options that every errand has."""
    foreground = click.option("--foreground", is_flag=True, help="From this process, not through the daemon.")
    return foreground(socket_option(config_options(json_option(function))))


def run(
    errand: Callable[[Errands, Config], Arrival],
    method: str,
    params: dict[str, Any],
    *,
    foreground: bool,
    socket: Path | None,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
    only_here: str | None = None,
) -> int:
    """Have it done and tell where the lens rests; return the exit code: 0 there, 1 cancelled.

    By the daemon that is *method* with *params*; from here it is *errand* on a lens that is opened for it. *only_here*
    names an option that was given and that the daemon does not have.
    """
    client = daemon_unless(foreground=foreground, config_path=config_path, overrides=overrides, socket=socket)
    if client is None:
        fields = _from_here(errand, config_path, overrides)
    elif only_here is not None:
        raise UsageError(f"{only_here}: the daemon uses its configuration's; leave it out, or give --foreground")
    else:
        fields = _by_daemon(client, method, params)
    cancelled = fields["outcome"] == "CANCELLED"
    if as_json:
        print_json(fields)
        return 1 if cancelled else 0
    steps = "" if fields["position_steps"] is None else f" (step {fields['position_steps']:.0f})"
    came = "" if fields["from_um"] is None else f", from {fields['from_um']:.2f} um"
    what = "stopped when asked to" if cancelled else "at rest"
    where = "where that is is not known" if fields["position_um"] is None else f"{fields['position_um']:.2f} um{steps}"
    known = "" if fields["referenced"] else "; the reference is unknown: home the lens before absolute moves"
    print(f"{what} at {where}{came}, {fields['duration_ms']:.0f} ms{known}")
    return 1 if cancelled else 0


def _from_here(
    errand: Callable[[Errands, Config], Arrival], config_path: Path | None, overrides: tuple[str, ...]
) -> dict[str, Any]:
    from elpd import rig  # noqa: PLC0415  (drivers and numba, which a daemon's client does not need)
    from elpd.config import load  # noqa: PLC0415
    from elpd.motion.errand import Errands  # noqa: PLC0415

    config = load(config_path, overrides)
    with interruptible() as cancelled, naming_the_holder(), rig.lens_alone(config) as (clock, lens, scale):
        errands = Errands(clock, lens, scale, cancelled)
        arrival = errand(errands, config)
        return {**arrival.fields(), "limits_um": list(errands.limits_um)}


def _by_daemon(client: Client, method: str, params: dict[str, Any]) -> dict[str, Any]:
    """Ask the daemon, and it for the lens before and after: a STOP goes out before anything is asked."""
    before = None if method == "stop" else client.status()["lens"]
    begun_s = time.monotonic()
    answer = ask(client, method, params)
    duration_ms = 1e3 * (time.monotonic() - begun_s)
    lens = client.status()["lens"]
    return {
        "outcome": "OK",
        "position_um": lens["position_um"],
        "position_steps": None,
        "from_um": None if before is None else before["position_um"],
        "referenced": lens["referenced"],
        "duration_ms": duration_ms,
        "limits_um": lens["limits_um"],
        **answer,
    }


def speed_option(function: F) -> F:
    """Add ``--speed`` (as ``speed_um_s``)."""
    return click.option(
        "--speed",
        "speed_um_s",
        type=click.FloatRange(min=0, min_open=True),
        metavar="UM_S",
        help="In um/s; the configuration's lens.speed_um_s if not given.",
    )(function)
