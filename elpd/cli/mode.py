"""`elpd mode`: when the daemon focuses by itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import daemon_options, reach

if TYPE_CHECKING:
    from collections.abc import Iterator


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
    for what, how in _told(answer["hold"]):
        print(f"  {what:16s}{how}")
    return 0


def _told(hold: dict[str, Any]) -> Iterator[tuple[str, str]]:
    left_s, loss = hold.get("left_s"), hold.get("loss")
    yield "waits for", f"{hold['waits_for']}{'' if left_s is None else f', {left_s:.1f} s more'}"
    if loss is not None:
        lost = "defocused" if hold["defocused"] else "in focus"
        yield "sharpness lost", f"{loss:.2f} of what counts as out of focus ({lost}), quiet for {hold['quiet_s']:.1f} s"
    if hold["failures"]:
        yield "without focus", f"{hold['failures']} cycles in a row; then {hold['hold_off_s']:g} s of hold-off"
