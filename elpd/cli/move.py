"""`elpd move`: move the lens to a place."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.errands import errand_options, run, speed_option


@click.command("move", context_settings={"ignore_unknown_options": True})  # -20 is a number
@click.argument("to_um", type=float, metavar="UM")
@speed_option
@errand_options
def command(*, to_um: float, speed_um_s: float | None, **options: Any) -> int:
    """Move to UM on the lens's ruler and rest there."""
    only_here = None if speed_um_s is None else "--speed"
    return run(
        lambda errands, config: errands.move_to(to_um, speed_um_s or config.lens.speed_um_s),
        "move",
        {"to_um": to_um},
        only_here=only_here,
        **options,
    )
