"""``elpd convert IN OUT``: between event formats, or a part of one.

The new file appears when it is whole. What it cannot hold is told.
"""

from __future__ import annotations

from pathlib import Path

import click

from elpd.cli.common import config_options, json_option, parse_roi, parse_size, print_json
from elpd.config import load
from elpd.record.convert import Slice, convert


@click.command()
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.argument("out", metavar="OUT", type=click.Path(path_type=Path))
@click.option(
    "--format", "word", metavar="NAME", help="evt3, evt2, dat, aedat4, hdf5, npz, csv ...; else OUT's suffix."
)
@click.option("--roi", metavar="X,Y,W,H", help="Keep the events of this region; addresses stay as they are.")
@click.option("--from-us", type=int, metavar="T", help="Keep what is not earlier, in us of the sensor's clock.")
@click.option("--to-us", type=int, metavar="T", help="Keep what is earlier.")
@click.option("--size", metavar="W,H", help="The sensor's size, where the file does not say it.")
@click.option("--force", is_flag=True, help="Replace OUT if it exists.")
@config_options
@json_option
def command(
    source: Path,
    out: Path,
    *,
    word: str | None,
    roi: str | None,
    from_us: int | None,
    to_us: int | None,
    size: str | None,
    force: bool,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> None:
    """Write an event file in another format, or a part of it."""
    load(config_path, overrides)  # every command takes them; a wrong key is wrong here too
    part = Slice(parse_roi(roi), from_us, to_us)
    answer = convert(source, out, word=word, part=part, geometry=parse_size(size), force=force)
    if as_json:
        print_json(answer)
        return
    length = out.stat().st_size
    print(f"{out}: {answer['format']}, {answer['width']}x{answer['height']}")
    print(f"events    {answer['events']:,}, {length:,} bytes")
    if answer["triggers"] or answer["frames"] or answer["imu"]:
        print(f"with it   {answer['triggers']} trigger edges, {answer['frames']} frames, {answer['imu']:,} IMU samples")
    if answer["lost"]:
        print(f"lost      {answer['lost']:,} in the source: " + "; ".join(answer["lost_reason"]))
    for warning in answer["warnings"]:
        print(f"warning   {warning}")
