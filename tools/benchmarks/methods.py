"""Everything that is measured, behind one call: a recording in, a row of numbers out.

The peers come from ``elpd.baselines``; ``elpd`` is our own causal detector through the Python API that ``elpd detect``
uses. Each is run at the frame rates that concern it: what needs no frames is run once. Processor time is that of the
method alone, without making or loading the case; times and lengths are signed so that late and beyond focus are
positive.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from benchmarks.cases import DEPTH_OF_FOCUS_UM, ROI, SIZE_PX, SPEED_UM_S
from elpd.baselines import PEERS
from elpd.record.layouts import RecordedSweep
from elpd.record.sweep_file import SweepSearch
from elpd.records import Geometry, Outcome
from elpd.vision.ruler import Ruler

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from benchmarks.cases import SweepRecording
    from elpd.baselines import StackFrame

OURS = "elpd"
NO_FRAMES = "-"
"""The frame rate of a method that sees events only."""
_AHEAD_US = 350_000
_CURVES_OF = (("elp-syn", "50"), ("elp-syn-1fps", "1"))
"""Only these curves are kept; the report draws some of them, and all would make the results ten times larger."""
_UM_PER_US = SPEED_UM_S / 1e6


@dataclass(frozen=True, slots=True)
class Method:
    """A name, a title for tables, what it is allowed to see, and the frame rates it is run at."""

    name: str
    title: str
    sees: str
    rates: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Row:
    """One method on one case. ``None`` where there is no answer.

    ``error_um`` is estimate less truth, ``decided_um`` how far past focus the lens was when the answer could be given,
    ``focusing_ms`` the time from the start of the sweep until the lens could be back at the estimate, without braking.
    """

    case: str
    set_name: str
    scene: str
    fov: int
    motion: str
    method: str
    rate: str
    events: int
    error_um: float | None
    sigma_um: float | None
    decided_um: float | None
    focusing_ms: float | None
    cpu_ms: float
    reason: str
    details: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the row as plain data."""
        return asdict(self)


def all_methods() -> dict[str, Method]:
    """Return every method by name, ours first."""
    methods = {OURS: Method(OURS, "elpd (ours)", "the past only", ("50", "20", "1", NO_FRAMES))}
    for name, peer in PEERS.items():
        if not peer.needs_frames:
            rates: tuple[str, ...] = (NO_FRAMES,)
        elif name == "elp-syn-1fps":
            rates = ("1",)
        else:
            # One frame has no contrast to compare with, and the released programs at 1 fps are the method above.
            rates = ("50", "20")
        methods[name] = Method(name, peer.title, peer.sees, rates)
    return methods


def run_method(method: Method, rate: str, recording: SweepRecording) -> Row:
    """Run *method* on *recording* with frames at *rate*."""
    frames = () if rate == NO_FRAMES else recording.frames_at(rate)
    if method.name == OURS:
        return _run_ours(recording, rate, frames)
    if method.name == "elp-syn-1fps":
        frames = (recording.frame_nearest(_AHEAD_US),)
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


def _run_ours(recording: SweepRecording, rate: str, frames: tuple[StackFrame, ...]) -> Row:
    held = tuple(_HeldFrame(frame.t_us, frame.pixels) for frame in frames)
    sweep = RecordedSweep(
        recording.t_us,
        recording.x,
        recording.y,
        recording.on,
        Geometry(SIZE_PX, SIZE_PX),
        ROI,
        held,  # type: ignore[arg-type]  # same shape as FrameFile: t_us and load()
    )
    started = time.process_time()
    search = SweepSearch(sweep, ROI, Ruler.of_speed(SPEED_UM_S), depth_of_focus_um=DEPTH_OF_FOCUS_UM)
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
    case = recording.case
    focusing_ms = math.nan
    if math.isfinite(focus_us):
        # A decision after the sweep is taken where the sweep ended; the way back is driven at the sweep's speed.
        end_us = float(recording.frame_t_us[-1])
        focusing_ms = (decided_us + abs(min(decided_us, end_us) - focus_us)) / 1e3 + cpu_ms * (decided_us >= end_us)
        if "search_us" in details:
            focusing_ms = details["search_us"] / 1e3
    return Row(
        case=case.name,
        set_name=case.set_name,
        scene=case.scene,
        fov=case.fov,
        motion=case.motion,
        method=method,
        rate=rate,
        events=int(recording.t_us.size),
        error_um=_or_none((focus_us - recording.truth_us) * _UM_PER_US),
        sigma_um=_or_none(sigma_us * _UM_PER_US),
        decided_um=_or_none((decided_us - recording.truth_us) * _UM_PER_US) if math.isfinite(focus_us) else None,
        focusing_ms=_or_none(focusing_ms),
        cpu_ms=round(cpu_ms, 3),
        reason=reason,
        details=details,
    )


def _or_none(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
