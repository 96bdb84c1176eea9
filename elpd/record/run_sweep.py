"""A recorded run as a recorded sweep: what `elpd detect` looks at when it is given a run's folder.

Only what a camera saw while the aperture opened and while the lens swept is taken: the way back to focus crosses it a
second time and knows where it is. Where the lens was is what the run itself noted for each window, so the offline
detector stands on the same ruler as the live one did.

A live cycle stops as soon as it is certain, so its record ends where an offline search, which has no lens to stop and
may wait for more, would still be waiting. What such a run found is therefore said by the cycle itself, run again over
the record (``record.replay``), and only told here as the answer of a detector.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError
from elpd.events.stream import PacketDecoder
from elpd.record.journal import DECISIONS_FILE
from elpd.record.layouts import FrameFile, RecordedSweep
from elpd.record.playback import TapeReader
from elpd.record.sweep_file import Detection
from elpd.record.tape import frame_name
from elpd.records import Direction, ElpSample, FocusEstimate, Outcome, Roi
from elpd.units import SensorUs
from elpd.vision.detector import Detector
from elpd.vision.ruler import Ruler

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

FRAME_LEAD_US = 500_000
"""Frames this long before the sweep still show the scene that it starts from."""


@dataclass(frozen=True, slots=True)
class RunSweep:
    """A sweep with everything that the run knew about it.

    ``path_t_us`` and ``path_um`` say where the lens was; ``aperture_us`` is the interval in which the aperture opened,
    ``None`` where there was none; ``begin_us`` is when the lens began to move; ``ways`` holds, for each direction of
    travel, the windows as they were noted.
    """

    sweep: RecordedSweep
    path_t_us: NDArray[np.float64]
    path_um: NDArray[np.float64]
    aperture_us: tuple[int, int] | None
    begin_us: int
    ways: tuple[tuple[dict[str, Any], ...], ...] = ()


def read_run_sweep(run: Path) -> RunSweep:
    """Read the sweep of a run's folder. Raises ``FormatError`` if the run never swept, or is damaged."""
    notes = _notes(run)
    windows = [note for note in notes if note["event"] == "window" and isinstance(note["position_um"], (int, float))]
    if len(windows) < 2:
        raise FormatError(f"{run}: this run never swept ({len(windows)} windows noted); its run.json says why")
    begin_us, end_us = windows[0]["begin_us"], windows[-1]["end_us"]
    with TapeReader(run) as tape:
        aperture_us = _aperture(notes, tape.facts.opening_ms)
        wanted = [interval for interval in (aperture_us, (begin_us, end_us)) if interval is not None]
        decoder = PacketDecoder(tape.facts.geometry)
        pieces, frames, count = [], [], 0
        for packet in tape.packets():
            events = decoder.feed(packet)
            t_us = np.asarray(events.t, dtype=np.int64)
            keep = np.zeros(t_us.size, dtype=np.bool_)
            for begin, end in wanted:
                keep |= (t_us >= begin) & (t_us < end)
            if keep.any():
                pieces.append((t_us[keep], events.x[keep], events.y[keep], events.p[keep]))
            for frame in packet.frames:
                count += 1
                path = run / frame_name(count)
                if begin_us - FRAME_LEAD_US <= frame.t_us < end_us and path.exists():
                    frames.append(FrameFile(frame.t_us, path))
        geometry = tape.facts.geometry
    if not pieces:
        raise FormatError(f"{run}: no event between {begin_us} and {end_us} us; the recording was cut off")
    t_us, x, y, on = (np.concatenate(column) for column in zip(*pieces, strict=True))
    order = np.argsort(t_us, kind="stable")
    chosen = next((Roi(*note["roi"]) for note in notes if note["event"] == "roi"), None)
    sweep = RecordedSweep(
        t_us=t_us[order],
        x=x[order].astype(np.uint16),
        y=y[order].astype(np.uint16),
        on=on[order].astype(np.uint8),
        geometry=geometry,
        roi=chosen or Roi(0, 0, geometry.width, geometry.height),
        frames=tuple(frames),
    )
    middle_us = np.array([(note["begin_us"] + note["end_us"]) / 2 for note in windows])
    path_um = np.array([float(note["position_um"]) for note in windows])
    return RunSweep(sweep, middle_us, path_um, aperture_us, begin_us, _ways(notes))


def found_live(recorded: RunSweep, result: Mapping[str, Any]) -> Detection | None:
    """Return what a cycle found, as *result* says it (the fields of `elpd focus`), on the clock of its sensor.

    ``None`` unless it is in focus: then nothing was certain when the lens stopped, and the record is worth a search.
    """
    if result["outcome"] != Outcome.FOCUSED.value or not recorded.ways:
        return None
    ruler = Ruler.of_path(recorded.path_t_us, recorded.path_um)
    first, last = _judged(recorded.ways[0]), _judged(recorded.ways[-1])
    decided_us = int(recorded.ways[-1][-1]["end_us"])
    focus_us = ruler.time_of(result["focus_um"], decided_us)
    turned = len(recorded.ways) > 1
    contributions = tuple(tuple(one) for one in result["details"]["contributions"])
    direction_us = int(recorded.ways[0][-1]["end_us"]) if turned or first.first is None else first.first.decided_us
    return Detection(
        outcome=Outcome.FOCUSED,
        reason=f"the recorded cycle, run again: {result['reason']}",
        direction=Direction.RECEDING if turned else Direction.APPROACHING,
        direction_decided_us=direction_us,
        elp_crossing_us=last.likely_crossing_us,
        focus_us=round(focus_us),
        sigma_us=max(1, round(result["sigma_um"] / (ruler.speed_at(focus_us) or float("nan")))),
        decided_us=decided_us,
        method=result["details"]["method"],
        events=last.events,
        windows=last.samples,
        focus=FocusEstimate(result["focus_um"], result["sigma_um"], result["details"]["method"], contributions),
    )


def _ways(notes: list[dict[str, Any]]) -> tuple[tuple[dict[str, Any], ...], ...]:
    """Part the windows by direction of travel: a note closes each."""
    ways: list[tuple[dict[str, Any], ...]] = []
    windows: list[dict[str, Any]] = []
    for note in notes:
        if note["event"] == "window":
            windows.append(note)
        elif note["event"] == "sweep" and windows:
            ways.append(tuple(windows))
            windows = []
    return tuple(ways)


def _judged(windows: tuple[dict[str, Any], ...]) -> Detector:
    """Show the windows of one direction of travel to a fresh detector."""
    detector = Detector()
    for note in windows:
        begin_us, end_us = SensorUs(note["begin_us"]), SensorUs(note["end_us"])
        detector.feed(
            ElpSample(begin_us, end_us, note["elp"], note["energy"], note["n_on"], note["n_off"], 0, 0.0, 0.0)
        )
    return detector


def _notes(run: Path) -> list[dict[str, Any]]:
    path = run / DECISIONS_FILE
    try:
        return [json.loads(line) for line in path.read_text(encoding="ascii").splitlines()]
    except (OSError, ValueError) as error:
        raise FormatError(f"{path}: cannot be read ({error}); a sweep needs the run's notes") from None


def _aperture(notes: list[dict[str, Any]], opening_ms: float | None) -> tuple[int, int] | None:
    """Return when the aperture opened: the map's own estimate of its beginning, the device's bound on its length."""
    opened = next((note["open_us"] for note in notes if note["event"] == "map"), None)
    return None if opened is None or opening_ms is None else (opened, opened + round(1000 * opening_ms))
