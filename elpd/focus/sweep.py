"""The hot loop: read, measure, decide, stop.

One direction of travel at a time. ``Sweep.run`` returns as soon as one of three things is certain: focus has been
passed (the stop command has left by then), focus lies behind, or a rule of ``safety`` ends it. The stop leaves before
any bookkeeping; what the loop learned is read from the sweep afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING

from elpd.focus import safety
from elpd.records import Direction, Outcome, StopMode
from elpd.units import NS_PER_MS, HostNs, after_ms

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.focus.stage import Stage
    from elpd.focus.watch import Watch
    from elpd.records import CommandStamp, ElpSample

READ_TIMEOUT_S = 0.001


class SweepEnd(Enum):
    """Why a sweep in one direction ended."""

    PASSED = "passed"
    BEHIND = "behind"
    RULE = "rule"


@dataclass(frozen=True, slots=True)
class SweepPlan:
    """One direction of travel."""

    sign: int
    speed_um_s: float
    max_travel_um: float
    braking_um: float
    turn_s: float
    """Time to come from full speed the other way to full speed this way, the stop's onset included."""
    deadline_ns: HostNs
    depth_of_focus_um: float
    stop_mode: StopMode
    turned_at_um: float | None = None
    """Where the reversal that led to this direction was commanded; ``None`` if there was none."""
    trodden_um: float = 0.0
    """How far it leads back over the way that was just come, on which events undo one another."""
    lit: bool = False
    """Whether it is known that the scene is in the light."""


@dataclass(frozen=True, slots=True)
class SweepReport:
    """How a direction of travel ended. ``stop`` is set unless focus lies behind (the lens is to be reversed)."""

    end: SweepEnd
    verdict: safety.Verdict
    stop: CommandStamp | None
    begun_um: float
    dark: bool = False
    """Whether nothing stood above noise when it ended without having passed focus."""


class Sweep:
    """Runs one direction of travel over a stage, watched by a ``Watch``."""

    def __init__(
        self,
        stage: Stage,
        watch: Watch,
        *,
        cancelled: Callable[[], int],
        observe: Callable[[ElpSample, float], None],
    ) -> None:
        self._stage = stage
        self._watch = watch
        self._cancelled = cancelled
        self._observe = observe

    def run(self, plan: SweepPlan) -> SweepReport:
        """Sweep until something is certain; the lens has been told to stop or is to be reversed when this returns."""
        self._stage.shedding = self._watch.shedding
        try:
            return self._run(plan)
        finally:
            self._stage.shedding = None

    def _run(self, plan: SweepPlan) -> SweepReport:
        stage, watch, lens = self._stage, self._watch, self._stage.parts.lens
        begun_ns = stage.now_ns()
        begun_um = stage.to_um(lens.position_at(begun_ns).steps)
        travel_s = plan.max_travel_um / plan.speed_um_s
        until = min(plan.deadline_ns, after_ms(begun_ns, 1000.0 * travel_s + 500.0))
        reported_from = stage.report
        lens.run(plan.sign * plan.speed_um_s / stage.um_per_step, until)
        watch.begin(plan.sign, stage.sensor_clock.to_sensor(begun_ns), plan.turned_at_um)
        heard_ns = begun_ns
        while True:
            packet = stage.read(READ_TIMEOUT_S)
            if packet is not None:
                heard_ns = stage.now_ns()
                stage.delays.taken(packet.received_ns, heard_ns)
                samples = watch.feed(packet)
                if watch.passed:
                    stop = lens.stop(plan.stop_mode)
                    self._show(samples)
                    return SweepReport(SweepEnd.PASSED, safety.Verdict(safety.Action.CONTINUE), stop, begun_um)
                self._show(samples)
                if watch.direction is Direction.RECEDING:
                    dark = safety.is_dark(self._conditions(plan, begun_ns, begun_um, heard_ns, reported_from))
                    return SweepReport(SweepEnd.BEHIND, safety.Verdict(safety.Action.CONTINUE), None, begun_um, dark)
            conditions = self._conditions(plan, begun_ns, begun_um, heard_ns, reported_from)
            verdict = safety.decide(conditions)
            if verdict.outcome is Outcome.TOO_FEW_EVENTS and watch.sees_a_scene:
                plan = replace(plan, lit=True)  # what it sent at rest was more than noise: the scene moved
                continue
            if verdict.action is not safety.Action.CONTINUE:
                stop = lens.stop(StopMode.ABRUPT if verdict.action is safety.Action.FAULT else plan.stop_mode)
                return SweepReport(SweepEnd.RULE, verdict, stop, begun_um, dark=safety.is_dark(conditions))

    def _conditions(
        self, plan: SweepPlan, begun_ns: HostNs, begun_um: float, heard_ns: HostNs, reported_from: object
    ) -> safety.Conditions:
        stage = self._stage
        now = stage.now_ns()
        here_um = stage.to_um(stage.parts.lens.position_at(now).steps)
        report = stage.report
        reported_um, commanded_um = None, 0.0
        if report is not None and report is not reported_from and report.earliest_ns > begun_ns:
            reported_um = abs(stage.to_um(report.steps) - begun_um)
            commanded_um = plan.speed_um_s * ((report.earliest_ns - begun_ns) / 1e9 - plan.turn_s)
        limits = stage.parts.lens.limits
        lost = stage.lost_events - stage.lost_at_rest
        edge_um = stage.to_um(limits.max_steps if plan.sign > 0 else limits.min_steps)
        return safety.Conditions(
            cancelled=bool(self._cancelled()),
            ms_to_deadline=(plan.deadline_ns - now) / NS_PER_MS,
            camera_silent_ms=(now - heard_ns) / NS_PER_MS,
            travel_um=plan.sign * (here_um - begun_um),
            trodden_um=plan.trodden_um,
            commanded_travel_um=commanded_um,
            reported_travel_um=reported_um,
            max_travel_um=plan.max_travel_um,
            way_to_limit_um=plan.sign * (edge_um - here_um) - plan.braking_um,
            depth_of_focus_um=plan.depth_of_focus_um,
            events=self._watch.events,
            resting_events=self._watch.resting_rate_hz * (now - begun_ns) / 1e9,
            resting_counted=self._watch.resting_events,
            lit=plan.lit,
            lost_fraction=lost / max(1, lost + self._watch.events_in_cycle),
        )

    def _show(self, samples: list[ElpSample]) -> None:
        for sample in samples:
            self._observe(sample, self._watch.score)
