"""`elpd home`: find the lens's reference."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.errands import errand_options, run

LIMIT_S = 30.0


@click.command("home")
@click.option(
    "--limit",
    "limit_s",
    type=click.FloatRange(min=0, min_open=True),
    metavar="S",
    help="Give up, and stop, after so many seconds; 30 if not given.",
)
@errand_options
def command(*, limit_s: float | None, **options: Any) -> int:
    """Find the reference: exit 0 there, 3 if the lens does not get there."""
    only_here = None if limit_s is None else "--limit"
    return run(lambda errands, _: errands.home(1e3 * (limit_s or LIMIT_S)), "home", {}, only_here=only_here, **options)
