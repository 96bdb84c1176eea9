"""What the daemon does by itself: focuses when a mode says so, follows a temperature. It gives way to everybody.

Modes decide in ``modes``, compensation in ``temperature``; here their inputs are gathered and their wishes become
requests like any other, which anybody's request, a lease, a fault or a stop keeps back or ends. A lens that somebody
has put somewhere stays there: nothing moves by itself again before focus was asked for. The same holds after a start.
"""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Any, Literal

from elpd.focus.settings import CycleSettings
from elpd.records import Roi
from elpd.service import modes, temperature
from elpd.service.elsewhere import Elsewhere
from elpd.service.engine_port import Caller, Request
from elpd.service.evidence import Evidence
from elpd.service.job import Job
from elpd.service.kept import Thermometer
from elpd.service.messages import FocusAnswer, FocusParams, ModeAnswer, MoveParams, TemperatureAnswer

if TYPE_CHECKING:
    from elpd.config import Config
    from elpd.events.decoder import EventArrays
    from elpd.record.session import Session
    from elpd.service.engine_port import Answer
    from elpd.service.job import Place
    from elpd.service.kept import Kept
    from elpd.service.lease import Lease
    from elpd.service.messages import ModeName
    from elpd.service.situation import Situation
    from elpd.service.timing import Time

READING_S = 600.0
"""A temperature older than this says nothing of now."""

SIMULATED_LOOK_EVERY_S = 1.0

NEAR_UM = 1.0
"""Some controllers report micrometres, not steps."""

MOVES_BY_HAND = frozenset({"home", "move", "jog", "preset"})


class Autopilot:
    """Wishes of the daemon itself. ``job`` and ``ended`` belong to the focus thread, the rest to any."""

    def __init__(
        self, config: Config, situation: Situation, kept: Kept, lease: Lease, place: Place, time: Time
    ) -> None:
        self._situation, self._kept, self._lease = situation, kept, lease
        self._place, self._time = place, time
        self._lock = threading.RLock()
        self._caller = Caller(0, os.getpid(), os.getuid(), "elpd itself")
        self._evidence: Evidence | None = None
        self._resting: str | None = "focus to be asked for once"
        self._at_focus_um: float | None = None
        self._sign = 0
        self._defocused = self._focused_once = False
        self._since_s = time.now_s()
        self._strikes = self._failures = 0
        self._elsewhere = Elsewhere()
        self._celsius: float | None = None
        self._read_s = float("-inf")
        self.reconfigure(config)
        stored = kept.content
        self._mode: ModeName = stored.mode or config.modes.start
        if stored.period_s is not None:
            self._period_s = stored.period_s
        situation.set_mode(self._mode)

    def reconfigure(self, config: Config) -> None:
        """Take other settings."""
        with self._lock:
            self._config = config
            self._period_s = config.modes.period_s
            self._depth_um = CycleSettings.from_config(config).depth_of_focus_um

    # --- what people say ---------------------------------------------------------------------------------------------

    @property
    def mode(self) -> ModeName:
        """The mode."""
        return self._mode

    def set_mode(self, mode: ModeName | None, period_s: float | None) -> None:
        """Choose a mode, which is to ask for what it does."""
        with self._lock:
            self._period_s = period_s or self._period_s
            if mode is not None:
                self._mode, self._resting = mode, None
                self._since_s, self._strikes, self._failures = self._time.now_s(), 0, 0
                self._elsewhere.forget()
            self._kept.change(mode=self._mode, period_s=self._period_s)
        self._situation.set_mode(self._mode)

    def mode_answer(self) -> ModeAnswer:
        """Tell the mode and what it waits for."""
        with self._lock:
            view, decision = self._view(), self._decide()
            hold: dict[str, Any] = {
                "waits_for": decision.waits_for,
                "left_s": decision.left_s,
                "loss": view.loss,
                "defocused": decision.defocused,
                "quiet_s": view.quiet_s,
                "hold_off_s": modes.hold_off_s(view, self._patience()),
                "failures": view.failures,
            }
            return ModeAnswer(mode=self._mode, period_s=self._period_s, hold=hold)

    def reading(self, celsius: float) -> TemperatureAnswer:
        """Take a temperature."""
        with self._lock:
            self._celsius, self._read_s = celsius, self._time.now_s()
            then, table = self._kept.content.thermometer, self._config.temperature.table
            if then is None and self._at_focus_um is not None:
                self._kept.change(thermometer=self._thermometer(self._at_focus_um, 0))
                then = self._kept.content.thermometer
            if then is None or not table:
                return TemperatureAnswer(celsius=celsius, offset_um=None)
            return TemperatureAnswer(celsius=celsius, offset_um=temperature.offset_um(table, then, celsius))

    def rest(self, why: str) -> None:
        """Do nothing by itself until somebody asks for focus."""
        with self._lock:
            self._resting = f"focus to be asked for: {why}"
            self._at_focus_um, self._focused_once = None, False
            self._elsewhere.forget()
            self._forget()

    # --- what the focus thread says ----------------------------------------------------------------------------------

    @property
    def listen_every_s(self) -> float:
        """How often the camera should be listened to; 0 is all the time."""
        config = self._config
        if config.service.look_every_s is not None:
            return config.service.look_every_s
        simulated = config.rig == "sim" and config.camera.driver == "sim"
        return SIMULATED_LOOK_EVERY_S if simulated and self._mode != "continuous" else 0.0

    @property
    def weighs(self) -> bool:
        """Whether what the camera says is weighed: there is a focus that can be lost."""
        return self._mode == "continuous" and self._evidence is not None

    def opened(self) -> None:
        """Begin with a rig of which nothing is known."""
        self.rest("the rig was opened")

    def forget(self) -> None:
        """Drop what was seen of the scene: it is old."""
        with self._lock:
            self._forget()

    def hear(self, events: EventArrays) -> None:
        """Take what the idle camera says."""
        with self._lock:
            if self._evidence is not None:
                self._evidence.hear(events, self._time.now_s())

    def arrived_from(self, position_um: float) -> Literal[-1, 0, 1]:
        """Return from which side the lens came to where it is: -1, +1, or 0 where that is not known."""
        sign = self.focused_at(position_um) or 0
        return 1 if sign > 0 else -1 if sign < 0 else 0

    def focused_at(self, position_um: float) -> int | None:
        """Say whether the lens, being at a place, was put there by focusing: the sign of its last motion, else None."""
        near = self._at_focus_um is not None and abs(position_um - self._at_focus_um) <= NEAR_UM
        return self._sign if near else None

    def job(self) -> Job | None:
        """Return what should be done by itself now, already begun; mostly nothing."""
        if self._mode == "manual" or self._place.busy:
            return None
        with self._lock:
            decision = self._decide()
            self._defocused = decision.defocused
            if self._elsewhere.goes_on:
                wish = None if self._blocked() is not None else self._elsewhere.wish()
                job = None if wish is None else self._job(*wish)
            else:
                job = self._job("focus", FocusParams()) if decision.focus else self._compensation()
        return job if job is not None and self._place.begin(job) else None

    def ended(self, job: Job, answer: Answer, session: Session | None) -> None:
        """Hear how a request ended."""
        method, result = job.request.method, answer.result
        with self._lock:
            dry_run = isinstance(job.request.params, FocusParams) and job.request.params.dry_run
            if isinstance(result, FocusAnswer):
                if session is not None and not dry_run:
                    self._cycle_ended(result, session)
            elif method in MOVES_BY_HAND and not job.automatic:
                self.rest(f"somebody has moved the lens ({method})")
            elif method == "move" and job.automatic and self._elsewhere.goes_on:
                self._elsewhere.moved(ended_well=result is not None)
            elif method == "move" and job.automatic and result is not None:
                self._at_focus_um = self._situation.lens.position_um

    # --- below -------------------------------------------------------------------------------------------------------

    def _cycle_ended(self, result: FocusAnswer, session: Session) -> None:
        self._since_s = self._time.now_s()
        before_um = self._at_focus_um
        if result.outcome != "FOCUSED":
            back = result.final_um is not None and self.focused_at(result.final_um) is not None
            self._at_focus_um = before_um if back else None
            if result.outcome != "CANCELLED":
                self._failures, self._strikes = self._failures + 1, self._strikes + 1
            if self._mode == "continuous":
                self._elsewhere.failed(result.outcome, self._situation.lens, self._depth_um)
            return
        self._elsewhere.forget()
        self._resting, self._focused_once, self._failures = None, True, 0
        self._at_focus_um, self._sign = result.final_um, int(result.details.get("sweep_sign") or 0)
        moved = before_um is None or result.final_um is None or abs(result.final_um - before_um) > self._depth_um
        self._strikes = 0 if moved else self._strikes + 1
        self._defocused = False
        if result.final_um is not None:
            self._kept.change(thermometer=self._thermometer(result.final_um, self._sign))
        self._evidence = self._evidence_of(session, result)

    def _evidence_of(self, session: Session, result: FocusAnswer) -> Evidence | None:
        roi = result.details.get("roi")
        depths = self._config.modes.defocus_dof
        if session.sharpest is None or roi is None:
            return None
        return Evidence(session.sharpest.weights, Roi(*roi), session.sharpest.at(depths * self._depth_um))

    def _thermometer(self, focus_um: float, sign: int) -> Thermometer | None:
        if self._celsius is None or self._time.now_s() - self._read_s > READING_S:
            return None
        return Thermometer(focus_um=focus_um, celsius=self._celsius, sign=sign)

    def _compensation(self) -> Job | None:
        """Return the move that a temperature asks for, from where focus was found."""
        section, then, lens = self._config.temperature, self._kept.content.thermometer, self._situation.lens
        if not section.table or then is None or self._celsius is None or self._at_focus_um is None:
            return None
        if self._blocked() is not None or lens.position_um is None or lens.limits_um is None:
            return None
        wanted_um = then.focus_um + temperature.offset_um(section.table, then, self._celsius)
        step_um = section.step_um or 0.5 * self._depth_um
        target_um = temperature.target_um(
            wanted_um, lens.position_um, lens.limits_um, step_um=step_um, max_step_um=section.max_step_um
        )
        return None if target_um is None else self._job("move", MoveParams(to_um=target_um))

    def _job(self, method: str, params: FocusParams | MoveParams) -> Job:
        return Job(Request(method, params, self._caller), automatic=True)

    def _blocked(self) -> str | None:
        lens = self._situation.lens
        if self._situation.state != "READY":
            return f"the state {self._situation.state} to end"
        if self._lease.held:
            return "the end of a lease"
        if not lens.referenced:
            return "the lens to be homed"
        if lens.moving:
            return "the lens to be at rest"
        return self._resting

    def _view(self) -> modes.View:
        evidence = self._evidence
        return modes.View(
            mode=self._mode,
            now_s=self._time.now_s(),
            blocked=self._blocked(),
            focused_once=self._focused_once,
            loss=None if evidence is None else evidence.loss,
            defocused=self._defocused,
            quiet_s=0.0 if evidence is None else evidence.quiet_s,
            since_s=self._since_s,
            strikes=self._strikes,
            failures=self._failures,
            searched=bool(self._elsewhere.places_um),
        )

    def _decide(self) -> modes.Decision:
        return modes.decide(self._view(), self._patience())

    def _patience(self) -> modes.Patience:
        section = self._config.modes
        return modes.Patience(section.hold_off_s, section.settle_s, self._period_s, section.recheck_s)

    def _forget(self) -> None:
        self._evidence, self._defocused = None, False
