"""`elpd map`: the daemon's newest picture, to a file."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any, Literal

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import daemon_options, reach
from elpd.errors import UsageError

FORMATS: dict[str, Literal["jpeg", "png"]] = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}


@click.command("map")
@click.argument("out", required=False, type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--kind",
    type=click.Choice(["latest", "map", "frame", "events"]),
    default="latest",
    show_default=True,
    help="The temporal map, the camera's frame, or what the sensor just saw.",
)
@click.option("--deep", is_flag=True, help="16 bits a pixel; OUT is a .png then.")
@click.option("--max-width", type=click.IntRange(16, 8192), metavar="PIXELS", help="Make it smaller, if it is wider.")
@daemon_options
def command(*, out: Path | None, kind: Any, deep: bool, max_width: int | None, as_json: bool, **where: Any) -> int:
    """Write the daemon's picture to OUT (.png, .jpg); without OUT only tell which there is."""
    form = _format(out, deep=deep)
    told = reach(**where).map(kind, form, max_width)
    image = base64.b64decode(told["image"], validate=True)
    if out is not None:
        out.write_bytes(image)
    if as_json:
        facts = {key: value for key, value in told.items() if key != "image"}
        print_json({**facts, "out": out, "bytes": len(image)})
        return 0
    at = "" if told["position_um"] is None else f", lens at {told['position_um']:.2f} um"
    to = "" if out is None else f"{out}: "
    print(f"{to}{told['kind']}, {told['width']}x{told['height']}, {told['age_s']:.1f} s old{at}")
    return 0


def _format(out: Path | None, *, deep: bool) -> Literal["jpeg", "png", "png16"]:
    if out is None:
        return "png16" if deep else "jpeg"
    form = FORMATS.get(out.suffix.lower())
    if form is None:
        raise UsageError(f"{out}: a picture is a .png or a .jpg")
    if deep and form != "png":
        raise UsageError(f"{out}: only a .png holds 16 bits a pixel")
    return "png16" if deep else form
