"""`elpd jog`: move the lens by so much."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.errands import errand_options, run, speed_option


@click.command("jog", context_settings={"ignore_unknown_options": True})  # -20 is a number
@click.argument("by_um", type=float, metavar="UM")
@speed_option
@errand_options
def command(*, by_um: float, speed_um_s: float | None, **options: Any) -> int:
    """Move by UM from here and rest there."""
    only_here = None if speed_um_s is None else "--speed"
    return run(
        lambda errands, config: errands.jog(by_um, speed_um_s or config.lens.speed_um_s),
        "jog",
        {"by_um": by_um},
        only_here=only_here,
        **options,
    )
