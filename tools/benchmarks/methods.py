"""Everything that is measured, behind one call: a recording in, a row of numbers out.

The peers come from ``elpd.baselines``; ``elpd`` is our own causal detector through the Python API that ``elpd detect``
uses. Each is run at the frame rates that concern it: what needs no frames is run once. Processor time is that of the
method alone, without making or loading the case; times and lengths are signed so that late and beyond focus are
positive.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from benchmarks.cycles import live_through
from benchmarks.rows import Row, row_of
from benchmarks.sets import E2VID, MAP, REBUILT
from benchmarks.starts import Start, start
from elpd.baselines import PEERS, StackFrame
from elpd.record.layouts import RecordedSweep
from elpd.record.sweep_file import SweepSearch
from elpd.records import Outcome
from elpd.vision.ruler import Ruler

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    import numpy as np
    from numpy.typing import NDArray

    from benchmarks.cases import SweepRecording
    from elpd.vision.reference import Reference

OURS = "elpd"
CYCLE = "elpd-cycle"
"""The same in charge of the lens."""
CYCLE_SETS = ("syn", "davis-bright", "davis-dark", "evk4-bright", "evk4-dark", "nothing", "noise")
"""Where it is run: a recorded sweep cannot be steered, and what a lamp makes of a cycle has tests of its own."""
NO_FRAMES = "-"
"""The frame rate of a method that sees events only."""
_AHEAD = 0.35
"""Where in the sweep the released "1 fps" program takes its one frame: a frame from the future."""
_CURVES_OF = (("elp-syn", "50"), ("elp-syn-1fps", "1"))
"""Only these curves are kept; the report draws some of them, and all would make the results ten times larger."""


@dataclass(frozen=True, slots=True)
class Method:
    """A name, a title for tables, what it is allowed to see, and the frame rates it is run at."""

    name: str
    title: str
    sees: str
    rates: tuple[str, ...]


def rate_name(rate: str) -> str:
    """Return a frame rate in words."""
    return {MAP: "temporal map", REBUILT: "rebuilt picture", E2VID: "E2VID picture", NO_FRAMES: "no frames"}.get(
        rate, f"{rate} fps"
    )


def all_methods() -> dict[str, Method]:
    """Return every method by name, ours first."""
    methods = {OURS: Method(OURS, "elpd (ours)", "the past only", ("50", "20", "1", MAP, REBUILT, E2VID, NO_FRAMES))}
    methods[CYCLE] = Method(
        CYCLE, "elpd, a whole cycle (ours)", "the past only, steers the lens", ("50", "20", "1", MAP)
    )
    for name, peer in PEERS.items():
        if not peer.needs_frames:
            rates: tuple[str, ...] = (NO_FRAMES,)
        elif name == "elp-syn-1fps":
            rates = ("1",)
        elif name == "registered":
            rates = ("50", "20", "1", MAP)
        else:
            # One frame has no contrast to compare with, and the released programs at 1 fps are the method above.
            rates = ("50", "20", MAP, REBUILT, E2VID) if name == "elp-evk4" else ("50", "20")
        methods[name] = Method(name, peer.title, peer.sees, rates)
    return methods


def run_method(method: Method, rate: str, recording: SweepRecording, weights: Path | None = None) -> Row:
    """Run *method* on *recording* with frames at *rate*, or with the picture that it names; *weights* are E2VID's."""
    if method.name == CYCLE:
        return _run_cycle(recording, rate)
    begin_us = recording.case.of_set.sweep_begin_us
    picture: Start | None = None
    if rate in (MAP, REBUILT, E2VID):
        picture = start(rate, recording, weights)
        if picture is None:
            return _no_picture(method.name, rate, recording)
        begin_us = picture.begin_us
        frames: tuple[StackFrame, ...] = (StackFrame(begin_us, picture.grey),)
    else:
        frames = () if rate == NO_FRAMES else recording.frames_at(rate)
    if method.name == OURS:
        if picture is not None:
            return _run_ours(recording, rate, (), begin_us, picture.reference)
        return _run_ours(recording, rate, frames, begin_us, None)
    if method.name == "elp-syn-1fps":
        chosen = recording.case.of_set
        ahead_us = chosen.sweep_begin_us + _AHEAD * (chosen.end_us - chosen.sweep_begin_us)
        frames = (recording.frame_nearest(ahead_us),)
    stack = recording.stack(frames)
    started = time.process_time()
    answer = PEERS[method.name].run(stack)
    cpu_ms = 1e3 * (time.process_time() - started)
    details = dict(answer.details)
    curve = details.pop("curve", None)
    if curve is not None and (method.name, rate) in _CURVES_OF:
        details["curve"] = {"t_us": curve["t_us"], "elp": [round(value, 3) for value in curve["elp"]]}
    return _row(
        recording,
        method.name,
        rate,
        focus_us=answer.focus_us,
        sigma_us=math.nan,
        decided_us=answer.decided_us,
        cpu_ms=cpu_ms,
        reason=str(details.pop("reason", "")),
        details=details,
    )


@dataclass(frozen=True, slots=True)
class _HeldFrame:
    """A frame in memory, where the detector expects one on disk."""

    t_us: int
    pixels: NDArray[np.uint8]

    def load(self) -> NDArray[np.uint8]:
        return self.pixels


def _no_picture(name: str, rate: str, recording: SweepRecording) -> Row:
    nothing = {"focus_us": math.nan, "sigma_us": math.nan, "decided_us": math.nan, "cpu_ms": 0.0}
    return _row(recording, name, rate, **nothing, reason="no event to make a picture of", details={})


def _run_cycle(recording: SweepRecording, rate: str) -> Row:
    """Let the controller live through the same case; what it took of the processor is its own, not the simulation's."""
    lived = live_through(recording.case, rate)
    return row_of(
        recording,
        CYCLE,
        rate,
        error_um=lived.error_um,
        sigma_um=lived.sigma_um,
        decided_um=lived.decided_um,
        focusing_ms=lived.focusing_ms,
        cpu_ms=lived.cpu_ms,
        events=lived.events,
        again_ms=lived.again_ms,
        reason=lived.reason,
        details={
            "direction": lived.direction,
            "estimate_um": lived.estimate_um,
            "one_pass_um": lived.one_pass_um,
            "one_pass_sigma_um": lived.one_pass_sigma_um,
            "contributions": lived.contributions,
        },
    )


def _run_ours(
    recording: SweepRecording,
    rate: str,
    frames: tuple[StackFrame, ...],
    begin_us: int,
    reference: Reference | None,
) -> Row:
    age_us = recording.case.of_set.frame_age_us
    held = tuple(_HeldFrame(frame.t_us + age_us, frame.pixels) for frame in frames)
    sweep = RecordedSweep(
        recording.t_us,
        recording.x,
        recording.y,
        recording.on,
        recording.geometry,
        recording.roi,
        held,  # type: ignore[arg-type]  # same shape as FrameFile: t_us and load()
        frame_age_us=age_us,
    )
    started = time.process_time()
    chosen = recording.case.of_set
    path = recording.path()
    search = SweepSearch(
        sweep,
        recording.roi,
        Ruler.of_path(path.t_us, path.position_um),
        depth_of_focus_um=chosen.depth_of_focus_um,
        begin_us=begin_us,
        reference=reference,
    )
    found = search.run()
    cpu_ms = 1e3 * (time.process_time() - started)
    focused = found.outcome is Outcome.FOCUSED
    contributions = found.focus.contributions if found.focus is not None else ()
    return _row(
        recording,
        OURS,
        rate,
        focus_us=_number(found.focus_us if focused else None),
        sigma_us=_number(found.sigma_us if focused else None),
        decided_us=_number(found.decided_us if focused else None),
        cpu_ms=cpu_ms,
        reason="" if focused else f"{found.outcome.value}: {found.reason}",
        details={
            "direction": found.direction.value,
            "contributions": [
                {"name": name, "at_um": at_um, "sigma_um": sigma_um, "weight": weight}
                for name, at_um, sigma_um, weight in contributions
            ],
        },
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _row(
    recording: SweepRecording,
    method: str,
    rate: str,
    *,
    focus_us: float,
    sigma_us: float,
    decided_us: float,
    cpu_ms: float,
    reason: str,
    details: dict[str, Any],
) -> Row:
    chosen = recording.case.of_set
    focusing_ms = math.nan
    if math.isfinite(focus_us):
        # A decision after the sweep is taken where the sweep ended; the way back is driven at the sweep's speed.
        there_us = min(decided_us, chosen.end_us)
        focusing_ms = (decided_us - chosen.sweep_begin_us + abs(there_us - focus_us)) / 1e3
        if decided_us >= chosen.end_us:
            focusing_ms += cpu_ms
        if "search_us" in details:
            focusing_ms = details["search_us"] / 1e3
    return row_of(
        recording,
        method,
        rate,
        error_um=(focus_us - recording.truth_us) * chosen.um_per_us,
        sigma_um=sigma_us * chosen.um_per_us,
        decided_um=(decided_us - recording.truth_us) * chosen.um_per_us if math.isfinite(focus_us) else math.nan,
        focusing_ms=focusing_ms,
        cpu_ms=cpu_ms,
        events=int(recording.t_us.size),
        again_ms=None,
        reason=reason,
        details=details,
    )
