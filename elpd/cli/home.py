"""`elpd home`: find the lens's reference."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.errands import errand_options, run


@click.command("home")
@click.option(
    "--limit",
    "limit_s",
    type=click.FloatRange(min=0, min_open=True),
    default=30.0,
    show_default=True,
    metavar="S",
    help="Give up, and stop, after so many seconds.",
)
@errand_options
def command(*, limit_s: float, **options: Any) -> int:
    """Find the reference: exit 0 there, 3 if the lens does not get there."""
    return run(lambda errands, _: errands.home(1000.0 * limit_s), **options)
