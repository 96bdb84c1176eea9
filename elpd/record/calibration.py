"""Recordings as evidence for a sensor's calibration: what they can tell, and why they cannot tell the rest.

A recording of a lens at rest tells noise and hot pixels, where somebody says when it rested; any events tell the
refractory period. Thresholds and lag take there-and-backs at two speeds, which only a calibration makes: of those the
evidence file (``--keep``) tells everything again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.calibrate.evidence import Columns, Evidence, Rest
from elpd.errors import FormatError, UsageError
from elpd.events.stream import PacketDecoder
from elpd.record.journal import is_run
from elpd.record.layouts import read_sweep
from elpd.record.playback import TapeReader

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.records import Geometry

ONE_WAY = (
    "the recording holds no sweeps there and back at two speeds; calibrate on the rig, and keep its evidence with "
    "--keep"
)


def read_evidence(path: Path, rest_us: tuple[int, int] | None) -> Evidence:
    """Read a run's folder, a sweep's folder or an event file.

    *rest_us* says between which times nothing moved. Raises ``UsageError`` where there are no events then,
    ``FormatError`` for what is no recording.
    """
    events, geometry = events_of(path)
    missing = {
        "sweeps": ONE_WAY,
        "steps": ONE_WAY,
        "rest": "nothing says when the lens stood still; give --rest-us A,B",
    }
    rest = None
    if rest_us is not None:
        first_us, last_us = int(events.t_us[0]), int(events.t_us[-1])
        if not (first_us <= rest_us[0] and rest_us[1] <= last_us + 1):
            raise UsageError(
                f"--rest-us {rest_us[0]},{rest_us[1]} does not lie inside {path}, which holds {first_us} to "
                f"{last_us} us"
            )
        rest = Rest(events.between(*rest_us), *rest_us)
    return Evidence(geometry, rest, other=events, missing=missing)


def events_of(path: Path) -> tuple[Columns, Geometry]:
    """Return every event of a run, a sweep or an event file, in time order. Raises ``FormatError`` for others."""
    if not is_run(path):
        sweep = read_sweep(path, frames="none")
        return Columns(sweep.t_us, sweep.x, sweep.y, sweep.on), sweep.geometry
    with TapeReader(path) as tape:
        decoder = PacketDecoder(tape.facts.geometry)
        pieces = []
        for packet in tape.packets():
            t_us, x, y, on = decoder.feed(packet)
            pieces.append(Columns(t_us.astype(np.int64), x.copy(), y.copy(), on.copy()))
        geometry = tape.facts.geometry
    if not any(piece.t_us.size for piece in pieces):
        raise FormatError(f"{path}: no event in it")
    every = Columns(*(np.concatenate(part) for part in zip(*pieces, strict=True)))
    return every.chosen(np.argsort(every.t_us, kind="stable")), geometry
