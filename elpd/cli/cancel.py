"""`elpd cancel`: end what runs."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import daemon_options, reach


@click.command("cancel")
@daemon_options
def command(*, as_json: bool, **where: Any) -> int:
    """End the cycle or motion that runs; its own caller hears CANCELLED. Exit 0 also if nothing ran."""
    answer = reach(**where).cancel()
    if as_json:
        print_json(dict(answer))
    else:
        print("cancelled" if answer["cancelled"] else "nothing runs")
    return 0
