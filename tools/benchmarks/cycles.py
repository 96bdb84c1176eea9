"""A case lived through by the controller: the focus cycle itself, from both sides of focus where it decides to.

``elpd.focus.FocusCycle`` is run on the case's rig as on any other, with everything that it does: it gets its picture,
listens to the sensor at rest, sweeps, stops, asks its witnesses, goes over focus again where its own rule says that one
pass is not enough (``elpd.focus.recross``), returns, and sees that the lens is there. Its settings are those that a
configuration has unless it says otherwise, but for the case's speed and depth of focus. What counts is where the glass
rests.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from benchmarks.rig import LONGEST_MS, build_rig
from elpd.errors import ElpdError
from elpd.focus.cycle import FocusCycle
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.records import Outcome, Phase

if TYPE_CHECKING:
    from benchmarks.cases import Case

MOVING = (Phase.SWEEP, Phase.STOP, Phase.RECROSS, Phase.RETURN, Phase.VERIFY)
"""From the first step of the sweep until focus is verified at rest."""


@dataclass(frozen=True, slots=True)
class Lived:
    """What became of a case; lengths in um from the truth; ``None`` without an answer.

    ``decided_um`` is how far past focus the sweep was stopped, in its own direction, ``again_ms`` what the passes after
    it took with the ways between them. ``one_pass_um`` is what the sweep alone had said where there were such passes.
    """

    cpu_ms: float
    reason: str
    direction: str
    events: int = 0
    error_um: float | None = None
    sigma_um: float | None = None
    decided_um: float | None = None
    focusing_ms: float | None = None
    again_ms: float = 0.0
    estimate_um: float | None = None
    one_pass_um: float | None = None
    one_pass_sigma_um: float | None = None
    contributions: list[dict[str, Any]] = field(default_factory=list)


class _Notes:
    """Notes of a cycle, of which those are kept that the score needs."""

    def __init__(self) -> None:
        self.sweeps: list[dict[str, Any]] = []
        self.one_pass: dict[str, Any] = {}

    def note(self, event: str, /, **fields: Any) -> None:
        if event == "sweep":
            self.sweeps.append(fields)
        if event == "one pass":
            self.one_pass = fields

    @property
    def direction(self) -> str:
        """What the first sweep said of focus, which lies ahead."""
        ends = [one["end"] for one in self.sweeps[:1]]
        return {"passed": "approaching", "behind": "receding"}.get(ends[0] if ends else "", "unknown")


def live_through(case: Case, rate: str) -> Lived:
    """Run one cycle on *case*, with frames at *rate* or the aperture's picture."""
    begun_s = time.process_time()
    chosen = case.of_set
    parts, camera, glass = build_rig(case, rate)
    settings = CycleSettings(
        speed_um_s=abs(chosen.speed_um_s),
        depth_of_focus_um=chosen.depth_of_focus_um,
        deadline_ms=LONGEST_MS,
        transmittance="linear",
    )
    notes = _Notes()

    def cpu_ms() -> float:
        return 1e3 * (time.process_time() - begun_s - camera.simulated_s)

    try:
        result = FocusCycle(parts, settings, FocusRequest(roi=camera.roi), notes).run()
    except ElpdError as error:
        return Lived(cpu_ms(), f"{error.kind}: {error}", notes.direction)
    focused = result.outcome is Outcome.FOCUSED
    sweep_sign = int(result.details.get("sweep_sign", 0))
    focus_um = glass.focus_um(sweep_sign)

    def took_ms(*phases: Phase) -> float:
        names = [phase.value for phase in phases]
        return sum(one.ms for one in result.phases if one.name in names)

    def beyond_um(place_um: float | None) -> float | None:
        return None if place_um is None or not focused else place_um - focus_um

    stopped_um = beyond_um(result.stop_um)

    return Lived(
        error_um=glass.defocus_um(parts.clock.now_ns()) if focused else None,
        sigma_um=result.sigma_um if focused else None,
        decided_um=None if stopped_um is None else sweep_sign * stopped_um,
        focusing_ms=took_ms(*MOVING) if focused else None,
        again_ms=took_ms(Phase.RECROSS),
        events=result.events,
        cpu_ms=cpu_ms(),
        reason="" if focused else f"{result.outcome.value}: {result.reason}",
        direction=notes.direction,
        estimate_um=beyond_um(result.focus_um),
        one_pass_um=None if not notes.one_pass else notes.one_pass["focus_um"] - focus_um,
        one_pass_sigma_um=notes.one_pass.get("sigma_um"),
        contributions=[
            {"name": name, "at_um": at_um - focus_um, "sigma_um": sigma_um, "weight": weight}
            for name, at_um, sigma_um, weight in result.details.get("contributions", [])
        ],
    )
