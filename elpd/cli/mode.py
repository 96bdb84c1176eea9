"""`elpd mode`: when the daemon focuses by itself."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import daemon_options, reach


@click.command("mode")
@click.argument("mode", required=False, type=click.Choice(["one-shot", "continuous", "manual", "scheduled"]))
@click.option(
    "--period", "period_s", type=click.FloatRange(min=1), metavar="S", help="How often, in the scheduled mode."
)
@daemon_options
def command(*, mode: Any, period_s: float | None, as_json: bool, **where: Any) -> int:
    """Tell the mode, or set it."""
    answer = reach(**where).mode(mode, period_s)
    if as_json:
        print_json(dict(answer))
        return 0
    every = f", every {answer['period_s']:g} s" if answer["mode"] == "scheduled" else ""
    print(f"{answer['mode']}{every}")
    for name, value in answer["hold"].items():
        print(f"  {name:20s}{'-' if value is None else value}")
    return 0
