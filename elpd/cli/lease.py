"""`elpd lease`: keep the rig for oneself, with hands on the lens, say."""

from __future__ import annotations

import signal
import sys
import threading
from typing import Any

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import daemon_options, reach

RENEWED = 3
"""Times over a lease's span, so that a late renewal is no lost lease."""

SPAN_S = 15.0
"""A lease of a command that was killed holds for so long at most."""


@click.command("lease")
@click.option(
    "--seconds", type=click.FloatRange(min=0, min_open=True), metavar="S", help="End after so long; else by Ctrl-C."
)
@daemon_options
def command(*, seconds: float | None, as_json: bool, **where: Any) -> int:
    """Hold the lease until Ctrl-C: nobody else may operate the rig, though anybody may still stop it."""
    ended = threading.Event()
    previous = {number: signal.signal(number, lambda *_: ended.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        client = reach(**where)
        answer = client.lease("acquire", SPAN_S)
        print("the rig is yours until Ctrl-C", file=sys.stderr)
        left_s = float("inf") if seconds is None else seconds
        while left_s > 0 and not ended.wait(min(left_s, SPAN_S / RENEWED)):
            left_s -= SPAN_S / RENEWED
            if left_s > 0:
                client.lease("renew", SPAN_S)
        released = client.lease("release")
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if as_json:
        print_json({"held": dict(answer), "released": released["holder"] is None})
    return 0
