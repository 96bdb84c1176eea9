"""`elpd metrics`: counters and latencies, for Prometheus and for people."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import daemon_options, reach


@click.command("metrics")
@daemon_options
def command(*, as_json: bool, **where: Any) -> int:
    """Print the daemon's metrics in Prometheus' text format, as a text collector's file holds them."""
    answer = reach(**where).metrics()
    if as_json:
        print_json(dict(answer))
    else:
        print(answer["text"], end="")
    return 0
