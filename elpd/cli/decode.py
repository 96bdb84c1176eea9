"""``elpd decode FILE``: what an event file holds.

Streams the file once, in bounded memory. The digests are those by which two decoders can be compared to the last bit.
"""

from __future__ import annotations

from collections import Counter
from hashlib import sha3_224
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from elpd.cli.common import json_option, print_json
from elpd.events.stream import EventStream, open_recording

if TYPE_CHECKING:
    from elpd.ports import RecordingReader

DIGEST_DTYPES = {"t": "<u8", "x": "<u2", "y": "<u2", "on": "u1"}
SMALL_STEP_BACK_US = 64
"""Real streams step back by some microseconds; more is worth a warning."""

ODDITIES = {
    "padding": "padding words (0x9999)",
    "reserved": "reserved words",
    "stray_continued": "continuation words that continue nothing",
    "triggers_lost": "trigger edges did not fit",
}


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@json_option
def command(file: Path, *, as_json: bool) -> None:
    """Say what an event file holds: its events, times, triggers, digests and losses."""
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
    events = on = frames = 0
    first_us: int | None = None
    last_us: int | None = None
    step_back_us = 0
    triggers: list[dict[str, Any]] = []
    for chunk in stream.chunks():
        frames += len(chunk.frames)
        triggers += [{"t_us": edge.t_us, "id": edge.id, "rising": edge.rising} for edge in chunk.triggers]
        if chunk.t.size == 0:
            continue
        for (name, dtype), column in zip(DIGEST_DTYPES.items(), (chunk.t, chunk.x, chunk.y, chunk.p), strict=True):
            digests[name].update(np.ascontiguousarray(column, dtype).data)
        events += chunk.t.size
        on += int(chunk.p.sum())
        t = chunk.t if last_us is None else np.concatenate(([last_us], chunk.t))
        step_back_us = max(step_back_us, -int(np.diff(t).min(initial=0)))
        first_us = int(chunk.t[0]) if first_us is None else first_us
        last_us = int(chunk.t[-1])
    notes = reader.notes
    counters = Counter(stream.counters)
    warnings = list(notes.get("warnings", []))
    warnings += [f"{counters[name]} {text}" for name, text in ODDITIES.items() if counters[name]]
    if events == 0:
        warnings.append("the file holds no events")
    if step_back_us > SMALL_STEP_BACK_US:
        warnings.append(f"time steps back by up to {step_back_us} us")
    lost, lost_reason = _losses(notes, counters, stream.rate_controller)
    geometry = reader.geometry
    if geometry is None:
        warnings.append("the file does not say the sensor's size")
    rate = stream.rate_controller
    return {
        "format": notes["format"],
        "width": None if geometry is None else geometry.width,
        "height": None if geometry is None else geometry.height,
        "events": events,
        "on": on,
        "first_us": first_us,
        "last_us": last_us,
        "triggers": triggers,
        "frames": frames,
        "imu": int(notes.get("imu", 0)),
        "rate_controller": None if rate is None else {"before": rate[0], "after": rate[1]},
        "digest": {name: digest.hexdigest()[:12] for name, digest in digests.items()},
        "lost": lost,
        "lost_reason": lost_reason,
        "warnings": warnings,
    }


def _losses(notes: Any, counters: Counter[str], rate_controller: tuple[int, int] | None) -> tuple[int, list[str]]:
    """Add up what is known to be missing, and say why."""
    lost, reasons = int(notes.get("lost", 0)), list(notes.get("lost_reason", []))
    outside = counters["x_out_of_range"] + counters["y_out_of_range"]
    if outside:
        lost += outside
        reasons.append(f"{outside} events lie outside the sensor or belong to no row")
    if rate_controller is not None and rate_controller[0] > rate_controller[1]:
        dropped = rate_controller[0] - rate_controller[1]
        lost += dropped
        reasons.append(f"the camera's rate controller dropped {dropped} events")
    return lost, reasons


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
    if summary["rate_controller"]:
        lines.append(
            "rate controller: {before:,} events before it, {after:,} after".format(**summary["rate_controller"])
        )
    lines.append("digests   " + "  ".join(f"{name} {digest}" for name, digest in summary["digest"].items()))
    if summary["lost"]:
        lines.append(f"lost      {summary['lost']:,}: " + "; ".join(summary["lost_reason"]))
    lines += [f"warning   {warning}" for warning in summary["warnings"]]
    return lines
