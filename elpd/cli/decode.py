"""``elpd decode FILE``: what an event file holds.

Streams the file once, in bounded memory. The digests are those by which two decoders can be compared to the last bit.
"""

from __future__ import annotations

from hashlib import sha3_224
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from elpd.cli.common import config_options, json_option, print_json
from elpd.config import load
from elpd.events.stream import EventStream, open_recording
from elpd.record.tally import Tally, losses

if TYPE_CHECKING:
    from elpd.ports import RecordingReader

DIGEST_DTYPES = {"t": "<u8", "x": "<u2", "y": "<u2", "on": "u1"}


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@config_options
@json_option
def command(file: Path, *, config_path: Path | None, overrides: tuple[str, ...], as_json: bool) -> None:
    """Say what an event file holds: its events, times, triggers, digests and losses."""
    load(config_path, overrides)  # every command takes them; a wrong key is wrong here too
    reader = open_recording(file)
    try:
        summary = summarise(reader)
    finally:
        reader.close()
    if as_json:
        print_json(summary)
    else:
        for line in _lines(file, summary):
            print(line)


def summarise(reader: RecordingReader) -> dict[str, Any]:
    """Read a recording through and return the fields of ``elpd decode --json``."""
    stream = EventStream(reader)
    digests = {name: sha3_224() for name in DIGEST_DTYPES}
    tally = Tally()
    triggers: list[dict[str, Any]] = []
    for chunk in stream.chunks():
        tally.add(chunk)
        triggers += [{"t_us": edge.t_us, "id": edge.id, "rising": edge.rising} for edge in chunk.triggers]
        for (name, dtype), column in zip(DIGEST_DTYPES.items(), (chunk.t, chunk.x, chunk.y, chunk.p), strict=True):
            digests[name].update(np.ascontiguousarray(column, dtype).data)
    notes = reader.notes
    warnings = tally.warnings(notes, stream.counters)
    lost, lost_reason = losses(notes, stream.counters, stream.rate_controller)
    geometry = reader.geometry
    if geometry is None:
        warnings.append("the file does not say the sensor's size")
    rate = stream.rate_controller
    return {
        "format": notes["format"],
        "width": None if geometry is None else geometry.width,
        "height": None if geometry is None else geometry.height,
        "events": tally.events,
        "on": tally.on,
        "first_us": tally.first_us,
        "last_us": tally.last_us,
        "triggers": triggers,
        "frames": tally.frames,
        "imu": tally.imu,
        "rate_controller": None if rate is None else {"before": rate[0], "after": rate[1]},
        "digest": {name: digest.hexdigest()[:12] for name, digest in digests.items()},
        "lost": lost,
        "lost_reason": lost_reason,
        "warnings": warnings,
    }


def _lines(file: Path, summary: dict[str, Any]) -> list[str]:
    """Lay the summary out for a person."""
    size = "unknown size" if summary["width"] is None else f"{summary['width']}x{summary['height']}"
    lines = [f"{file.name}: {summary['format']}, {size}"]
    if summary["events"]:
        span_us = summary["last_us"] - summary["first_us"]
        rate = f", {summary['events'] / span_us:.3f} Mev/s" if span_us > 0 else ""
        lines.append(f"events    {summary['events']:,}, {summary['on'] / summary['events']:.1%} ON{rate}")
        lines.append(f"time      {summary['first_us']} .. {summary['last_us']} us ({span_us / 1e6:.6f} s)")
    else:
        lines.append("events    none")
    lines += [f"trigger   {t['t_us']} us, channel {t['id']}, {'rising' if t['rising'] else 'falling'}"
              for t in summary["triggers"][:20]]  # fmt: skip
    if len(summary["triggers"]) > 20:
        lines.append(f"          and {len(summary['triggers']) - 20} more trigger edges")
    if summary["frames"]:
        lines.append(f"frames    {summary['frames']}")
    if summary["imu"]:
        lines.append(f"imu       {summary['imu']:,} samples")
    if summary["rate_controller"]:
        lines.append(
            "rate controller: {before:,} events before it, {after:,} after".format(**summary["rate_controller"])
        )
    lines.append("digests   " + "  ".join(f"{name} {digest}" for name, digest in summary["digest"].items()))
    if summary["lost"]:
        lines.append(f"lost      {summary['lost']:,}: " + "; ".join(summary["lost_reason"]))
    lines += [f"warning   {warning}" for warning in summary["warnings"]]
    return lines
