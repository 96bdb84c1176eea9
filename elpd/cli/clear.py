"""`elpd clear`: clear a latched fault."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import daemon_options, reach
from elpd.cli.status import EXIT_CODES


@click.command("clear")
@daemon_options
def command(*, as_json: bool, **where: Any) -> int:
    """Clear the fault, once what caused it is mended: exit 0 ready, 3 it is still there."""
    answer = reach(**where).clear()
    if as_json:
        print_json(dict(answer))
    else:
        fault = answer["cleared"]
        what = "no fault was latched" if fault is None else f"cleared {fault['kind']}: {fault['message']}"
        print(f"{what}; the rig is {answer['state']}")
    return EXIT_CODES.get(answer["state"], 4)
