"""``elpd record``: what the configured camera sees, to a file. Nothing moves.

A camera that sends words of its own gives a ``.raw`` with them as they came; one that sends arrays (and frames) an
``.aedat4``. Ctrl-C ends it as time does.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from elpd.cli.common import config_options, interruptible, json_option, print_json
from elpd.cli.daemon import ask, daemon_unless, socket_option
from elpd.config import load
from elpd.errors import UsageError
from elpd.ports import Identified
from elpd.record.recorder import Ended, record
from elpd.rig import camera_alone

if TYPE_CHECKING:
    from elpd.client import Client

EXIT_CODES = {Ended.TIME: 0, Ended.INTERRUPTED: 0, Ended.DISK_FULL: 1, Ended.CAMERA_LOST: 3}


@click.command()
@click.option("--seconds", type=float, metavar="S", help="For how long; until Ctrl-C unless given.")
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="FILE", help="Where to; named by the time unless given."
)
@click.option("--format", "word", metavar="NAME", help="evt3, evt2, aedat4, npy, csv ...; else the camera's own.")
@click.option("--force", is_flag=True, help="Replace FILE if it exists.")
@click.option("--foreground", is_flag=True, help="From this process, with the configured camera.")
@socket_option
@config_options
@json_option
def command(
    *,
    seconds: float | None,
    out: Path | None,
    word: str | None,
    force: bool,
    foreground: bool,
    socket: Path | None,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    """Record what the camera sees."""
    if seconds is not None and not 0 < seconds < float("inf"):
        raise UsageError(f"--seconds must be positive; got {seconds}")
    client = daemon_unless(foreground=foreground, config_path=config_path, overrides=overrides, socket=socket)
    if client is not None:
        return _by_daemon(client, seconds, out, word, as_json=as_json)
    config = load(config_path, overrides)
    now = datetime.now().astimezone()
    path = out or Path(f"recording-{now:%Y%m%d-%H%M%S}")
    with interruptible() as cancelled, camera_alone(config) as (clock, camera):
        facts = {"date": f"{now:%Y-%m-%d %H:%M:%S}"}
        if isinstance(camera, Identified):
            facts["serial_number"] = camera.serial
        answer = record(camera, clock, path, word=word, seconds=seconds, cancelled=cancelled, facts=facts, force=force)
    ended = Ended(answer["ended"])
    if as_json:
        print_json(answer)
        return EXIT_CODES[ended]
    size = Path(answer["out"]).stat().st_size
    print(f"{answer['out']}: {answer['format']}, {answer['width']}x{answer['height']}, {answer['seconds']:.3f} s")
    print(f"events    {answer['events']:,}, {size:,} bytes")
    if answer["triggers"] or answer["frames"] or answer["imu"]:
        print(f"with it   {answer['triggers']} trigger edges, {answer['frames']} frames, {answer['imu']:,} IMU samples")
    if answer["lost"]:
        print(f"lost      {answer['lost']:,}: " + "; ".join(answer["lost_reason"]))
    for warning in answer["warnings"]:
        print(f"warning   {warning}")
    if answer["truncated"]:
        print(f"truncated {answer['reason']}")
    return EXIT_CODES[ended]


def _by_daemon(client: Client, seconds: float | None, out: Path | None, word: str | None, *, as_json: bool) -> int:
    """Let the daemon record into its own folder, and say where that is."""
    if seconds is None or out is not None or word is not None:
        raise UsageError(
            "a daemon runs: it records --seconds S into its own folder, in the camera's own format; "
            "`elpd convert` makes another of it"
        )
    answer = ask(client, "record", {"seconds": seconds})
    if as_json:
        print_json(answer)
    else:
        print(f"{answer['path']}: {answer['events']:,} events, {answer['bytes']:,} bytes")
    return 0
