"""`elpd temperature`: what a thermometer near the lens reads, from whatever program reads it."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import daemon_options, reach


@click.command("temperature", context_settings={"ignore_unknown_options": True})  # -5 is a number
@click.argument("celsius", type=float, metavar="CELSIUS")
@daemon_options
def command(*, celsius: float, as_json: bool, **where: Any) -> int:
    """Tell the daemon the temperature at the lens; in its own modes it follows the configured table."""
    answer = reach(**where).temperature(celsius)
    if as_json:
        print_json(dict(answer))
        return 0
    moved = answer["offset_um"]
    if moved is None:
        print(f"{answer['celsius']:g} degrees; noted, and nothing follows: there is no table, or no focus yet")
    else:
        print(f"{answer['celsius']:g} degrees; focus has moved by {moved:+.2f} um since it was last found")
    return 0
