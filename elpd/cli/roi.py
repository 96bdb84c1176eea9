"""`elpd roi`: the daemon's regions, the default one and those with names."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from elpd.cli.common import parse_roi, print_json
from elpd.cli.daemon import daemon_options, reach
from elpd.errors import UsageError

if TYPE_CHECKING:
    from elpd.client.shapes import RoiBox


@click.command("roi")
@click.argument("region", required=False, metavar="[X,Y,W,H|proposed]")
@click.option("--name", metavar="NAME", help="The region of this name, instead of the default one.")
@click.option("--delete", is_flag=True, help="Forget the region of that name.")
@daemon_options
def command(*, region: str | None, name: str | None, delete: bool, as_json: bool, **where: Any) -> int:
    """Tell the regions, or set one; `proposed` lets each cycle look for texture itself."""
    if delete and (name is None or region is not None):
        raise UsageError("--delete takes --name and no region")
    if name is not None and region is None and not delete:
        raise UsageError(f"--name {name}: give a region X,Y,W,H for it, or --delete")
    client = reach(**where)
    if region is None:
        answer = client.roi(name=name, delete=delete)
    else:
        answer = client.roi(None if region == "proposed" else _box(region), name)
    if as_json:
        print_json(dict(answer))
        return 0
    print(f"default   {'proposed for each cycle' if answer['roi'] is None else _text(answer['roi'])}")
    for known, box in sorted(answer["named"].items()):
        print(f"{known:10s}{_text(box)}")
    return 0


def _box(text: str) -> RoiBox:
    roi = parse_roi(text)
    assert roi is not None
    return {"x": roi.x, "y": roi.y, "width": roi.width, "height": roi.height}


def _text(box: RoiBox) -> str:
    return f"{box['x']},{box['y']},{box['width']},{box['height']}"
