"""`elpd preset`: places of the lens, with their regions, that the daemon remembers."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import ask, daemon_options, reach
from elpd.errors import UsageError


@click.command("preset")
@click.argument("action", type=click.Choice(["list", "save", "apply", "delete"]), default="list")
@click.argument("name", required=False)
@daemon_options
def command(*, action: str, name: str | None, as_json: bool, **where: Any) -> int:
    """List the presets, save this place under NAME, go to NAME, or forget it."""
    if (action == "list") != (name is None):
        raise UsageError(f"preset {action}: {'takes no NAME' if action == 'list' else 'takes a NAME'}")
    answer = ask(reach(**where), "preset", {"action": action} | ({} if name is None else {"name": name}))
    if as_json:
        print_json(answer)
        return 0
    if answer["position_um"] is not None:
        print(f"at rest at {answer['position_um']:.2f} um")
    if not answer["presets"]:
        print("no presets; `elpd preset save NAME` makes one")
    for preset in answer["presets"]:
        roi = preset["roi"]
        region = "" if roi is None else f"   {roi['x']},{roi['y']},{roi['width']},{roi['height']}"
        print(f"{preset['name']:20s}{preset['position_um']:10.2f} um   {preset['saved_at']}{region}")
    return 0
