"""Probe and sweep, one direction after the other, until focus has been passed or cannot be had."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from elpd.focus import safety
from elpd.focus.ended import Beside, Ended, ended_by
from elpd.focus.expose import AFTER_FACTOR
from elpd.focus.frame_track import show_change
from elpd.focus.stage import REST_LIMIT_MS
from elpd.focus.sweep import Sweep, SweepEnd, SweepPlan, SweepReport
from elpd.motion.braking import braking_from
from elpd.records import Outcome, Phase, StopMode
from elpd.units import NS_PER_S, HostNs

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.focus.frame_track import FrameTrack
    from elpd.focus.settings import CycleSettings
    from elpd.focus.stage import Stage
    from elpd.focus.watch import Watch
    from elpd.ports import RunSink
    from elpd.records import ElpSample

REJOG_S = 0.25
"""What a controller without a velocity mode takes from one jog to the opposite one, beside braking."""

LIT_SHARE = 0.5
"""Half of the region's pixels answer when an aperture closes over a scene in the light; most do several times."""


class EnterPhase(Protocol):
    """How a search says where it is."""

    def __call__(self, phase: Phase, /, **fields: float) -> None:
        """Note a phase and what is worth knowing of it."""
        ...


class Search:
    """Looks for focus over a stage.

    Parameters
    ----------
    stage, watch, settings
        The rig, what watches its events, and the numbers.
    deadline_ns
        No motion outlives it.
    exposed
        Whether this cycle's picture was made by opening the aperture, which then can tell darkness from a stuck lens.
    shown
        Whether it is a frame that was taken just now: a scene with structure in a frame is in the light.
    sink, enter, observe
        Where notes go, and who hears of phases and windows.
    cancelled, interrupt
        Whether somebody wants an end, and what ends a wait.
    from_aside
        In which direction focus lies, where the lens has just gone off it on purpose; else 0.
    reversals
        How many there have been in this cycle.

    """

    def __init__(
        self,
        stage: Stage,
        watch: Watch,
        settings: CycleSettings,
        deadline_ns: HostNs,
        *,
        exposed: bool,
        shown: bool,
        sink: RunSink,
        enter: EnterPhase,
        observe: Callable[[ElpSample, float], None],
        cancelled: Callable[[], int],
        interrupt: Callable[[], None],
        from_aside: int = 0,
        reversals: int = 0,
    ) -> None:
        self._from_aside = from_aside
        self._stage = stage
        self._lens = stage.parts.lens
        self._watch = watch
        self._settings = settings
        self._deadline_ns = deadline_ns
        self._exposed = exposed
        self._shown = shown
        self._sink = sink
        self._phase = enter
        self._observe = observe
        self._cancelled = cancelled
        self._interrupt = interrupt
        self.reversals = reversals
        self.sign = 0
        """Direction of the present or last sweep."""
        self.strategy = ""

    def run(self) -> SweepReport:
        """Sweep, reversing while focus lies behind, until it has been passed. Leaves with the lens told to stop.

        Raises ``Ended`` when focus cannot be had, ``DeviceError`` when machinery breaks.
        """
        watch = self._watch
        capabilities, limits = self._lens.capabilities, self._lens.limits
        speed_um_s = min(self._settings.speed_um_s, self._stage.to_um(limits.max_speed_sps))
        braking = braking_from(speed_um_s, capabilities, limits, self._stage.um_per_step)
        braking_um = braking.longest_um
        turn_s = 2 * speed_um_s / self._stage.to_um(limits.acceleration_sps2) + capabilities.stop_onset_ms / 500.0
        if not capabilities.native_velocity:
            turn_s += REJOG_S
        at_once = braking.stops_on_detect(self._settings.depth_of_focus_um)
        self.strategy = "stop_on_detect" if at_once else "sweep_and_return"
        sweep = Sweep(self._stage, watch, cancelled=self._cancelled, observe=self._observe)
        sign = self._first_sign()
        reach_um = self._settings.max_travel_um
        turned_at_um: float | None = None
        trodden_um = 0.0
        lit, dark, ruled = watch.lit or self._shown, True, True
        frames: list[FrameTrack] = []
        while True:
            self._stage.listener = self._stage.interrupt = None  # a sweep asks for itself, and stops the lens first
            self.sign = sign
            plan = SweepPlan(
                sign=sign,
                speed_um_s=speed_um_s,
                max_travel_um=reach_um,
                braking_um=braking_um,
                turn_s=turn_s,
                deadline_ns=self._deadline_ns,
                depth_of_focus_um=self._settings.depth_of_focus_um,
                stop_mode=StopMode.ABRUPT if capabilities.abrupt_stop else StopMode.RAMPED,
                turned_at_um=turned_at_um,
                trodden_um=trodden_um,
                lit=lit,
            )
            self._phase(Phase.SWEEP, sign=sign, position_um=self._stage.here_um())
            report = sweep.run(plan)
            self._sink.note(
                "sweep",
                sign=sign,
                end=report.end.value,
                begun_um=report.begun_um,
                ended_um=self._stage.here_um(),
                events=watch.events,
                reason=report.verdict.reason,
            )
            if report.end is SweepEnd.PASSED:
                self._stage.listener, self._stage.interrupt = watch.after.hear_out, self._interrupt
                return report
            if report.end is SweepEnd.RULE and report.verdict.outcome is not Outcome.NO_CROSSING:
                if report.verdict.outcome is Outcome.TOO_FEW_EVENTS and self._in_the_light():
                    lit, reach_um = True, reach_um - abs(self._stage.here_um() - report.begun_um)
                    continue  # far from focus a lens may go a long way before anything changes
                raise ended_by(report.verdict)
            dark, ruled = dark and report.dark, ruled and report.end is SweepEnd.RULE
            frames.append(watch.frames)
            once_more = self.reversals < self._settings.max_reversals and not self._from_aside
            if report.end is SweepEnd.BEHIND and turned_at_um is not None and once_more:
                self.reversals += 1
                raise Beside(Outcome.NO_CROSSING, "focus seemed to lie behind both ways")
            if self.reversals >= self._settings.max_reversals:
                if lit and not watch.lit and dark and show_change(frames):  # a lamp makes events, if not of focus
                    raise Ended(
                        Outcome.TOO_FEW_EVENTS,
                        "the frames show the picture change as the lens goes, but the events do not stand above noise; "
                        "it is too dark for them: add light, or lower the sensor's thresholds",
                    )
                if lit and dark and ruled:
                    raise Ended(
                        Outcome.LENS_DID_NOT_MOVE,
                        "nothing changed while the lens should have moved, and yet the scene is in the light "
                        "(the aperture shows it, or its lamp); check the coupling, and that the motor turns",
                    )
                if report.end is SweepEnd.RULE:
                    raise ended_by(report.verdict)
                raise Ended(
                    Outcome.NO_CROSSING,
                    f"focus seemed to lie behind {self.reversals + 1} times; "
                    "does the subject move in depth? raise focus.max_reversals or hold it still",
                )
            turned_at_um = self._stage.here_um() if report.end is SweepEnd.BEHIND else None
            trodden_um = abs(self._stage.here_um() - report.begun_um) if report.end is SweepEnd.BEHIND else 0.0
            if report.end is SweepEnd.RULE:
                self._stage.listener = watch.follow
                self._stage.rest(REST_LIMIT_MS)
            self.reversals += 1
            reach_um = self._settings.max_travel_um + abs(self._stage.here_um() - report.begun_um) + 2 * braking_um
            sign = -sign

    def _in_the_light(self) -> bool:
        """Ask the aperture, if it made this cycle's picture: every lit pixel answers when it closes."""
        aperture, stage = self._stage.parts.aperture, self._stage
        watch = self._watch
        if aperture is None or not self._exposed:
            return False
        stage.listener, stage.interrupt = watch.count, self._interrupt
        stage.rest(REST_LIMIT_MS)
        before, begun_ns = watch.events_in_cycle, stage.now_ns()
        aperture.close()
        try:
            stage.wait_ms(aperture.opening_ms)
            stage.hear(safety.CAMERA_SILENCE_MS)
        finally:
            aperture.open()
        noise = watch.resting_rate_hz * (stage.now_ns() - begun_ns) / NS_PER_S
        answers = watch.events_in_cycle - before - noise
        stage.wait_ms(AFTER_FACTOR * aperture.opening_ms)
        return bool(answers > LIT_SHARE * watch.roi.width * watch.roi.height)

    def _first_sign(self) -> int:
        if self._from_aside:
            return self._from_aside
        if self._settings.first_direction != "auto":
            return 1 if self._settings.first_direction == "up" else -1
        limits = self._lens.limits
        here = self._lens.position_at(self._stage.now_ns()).steps
        return 1 if limits.max_steps - here >= here - limits.min_steps else -1
