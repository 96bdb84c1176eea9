"""What is done for a request, on the focus thread, with a rig that is open. Each ends in one answer.

What a person should change (``UsageError``) is an answer; broken machinery (``DeviceError``) is raised, and whoever
runs this latches it. Whatever waits asks ``Attention.interrupted`` each time round: that is where a cancellation is
heard, and where the supervisor sees that this thread lives.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from elpd.errors import LensError, UnreferencedError, UsageError
from elpd.focus import stored_map
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.motion.errand import Errands
from elpd.record.session import focus_on
from elpd.records import Outcome, Roi
from elpd.service.attention import STILL_S
from elpd.service.codec import plain
from elpd.service.messages import FocusAnswer, FocusParams, HomeAnswer, JogParams, MoveAnswer, MoveParams, PresetAnswer
from elpd.service.recording import record
from elpd.service.watchers import Audience

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from elpd.config import Config
    from elpd.motion.errand import Arrival
    from elpd.ports import RigParts
    from elpd.record.session import Session
    from elpd.service.attention import Attention
    from elpd.service.job import Job
    from elpd.service.kept import Kept
    from elpd.service.messages import Preset, PresetParams, RecordParams, Result, RoiBox
    from elpd.service.situation import Situation

HOME_LIMIT_S = 30.0
"""No lens this is for takes longer to find its reference; what `elpd home` allows."""


class Work:
    """Does requests.

    Parameters
    ----------
    situation
        What is told meanwhile.
    attention
        What interrupts.
    kept
        Regions and presets.
    """

    def __init__(self, situation: Situation, attention: Attention, kept: Kept) -> None:
        self._situation = situation
        self._attention = attention
        self._kept = kept
        self.session: Session | None = None
        """The last cycle, for whoever wants its pictures."""

    def do(self, job: Job, parts: RigParts, config: Config) -> Result:
        """Do what *job* asks. Raises ``UsageError``, ``DeviceError``."""
        params: Any = job.request.params
        match job.request.method:
            case "focus":
                return self._focus(job, params, parts, config)
            case "home":
                return self._home(job, parts)
            case "move":
                return self._moved(job, params, parts, config)
            case "jog":
                return _at(self._jog(job, params, parts, config))
            case "preset":
                return self._apply(job, params, parts, config)
            case "record":
                return self._record(job, params, parts, config)
        raise UsageError(f"{job.request.method!r} is nothing that a lens or camera does")

    def approach(self, job: Job, target_um: float, sign: int, parts: RigParts, config: Config) -> Arrival:
        """Go to a place and arrive there from the side that *sign* says (0: whichever), the play taken up."""
        settings = CycleSettings.from_config(config)
        here_um = parts.scale.to_um(parts.lens.position_at(parts.clock.now_ns()).steps)
        low_um, high_um = self._errands(job, parts).limits_um
        behind_um = min(max(target_um - sign * (settings.backlash_um + 1.0), low_um), high_um)
        if sign * (target_um - here_um) < 0:
            arrival = self._move(job, behind_um, parts, config)
            if arrival.cancelled:
                return arrival
        return self._move(job, target_um, parts, config)

    def _focus(self, job: Job, params: FocusParams, parts: RigParts, config: Config) -> FocusAnswer:
        preset = None if params.preset is None else self._kept.preset(params.preset)
        roi = params.roi or (None if preset is None else preset.roi) or self._kept.roi
        request = FocusRequest(roi=_roi(roi), reference=_reference(params, config), dry_run=params.dry_run)
        if preset is not None and not params.dry_run:
            self.approach(job, preset.position_um, preset.approach, parts, config)
        self._situation.focusing(on=True)
        begun_s = time.monotonic()
        try:
            with self._attention.without_signs(STILL_S):
                interrupted = self._attention.question(job, parts.lens, moving=False)
                session = focus_on(parts, config, request, Audience(self._situation, self._attention), interrupted)
        finally:
            self._situation.focusing(on=False)
        self.session = session
        if job.why_cancelled and session.result.outcome is Outcome.CANCELLED:
            session = replace(session, result=replace(session.result, reason=job.why_cancelled))
        self._measure(session, time.monotonic() - begun_s)
        if params.dry_run and session.map is not None and session.result.final_um is not None:
            self._keep_map(session, config)
        answer = focus_answer(session)
        self._situation.heard(answer.events, answer.lost)
        self._situation.ended(answer)
        return answer

    def _home(self, job: Job, parts: RigParts) -> HomeAnswer:
        with self._attention.without_signs(HOME_LIMIT_S + 1.0):
            try:
                arrival = self._errands(job, parts).home(1000.0 * HOME_LIMIT_S)
            except LensError as error:
                if job.cancelled:
                    raise UnreferencedError(f"homing was stopped on request; home the lens again ({error})") from None
                raise
        return HomeAnswer(position_um=arrival.um)

    def _moved(self, job: Job, params: MoveParams, parts: RigParts, config: Config) -> MoveAnswer:
        """Go there; what the daemon does by itself keeps to the side that focus was found from."""
        target_um = _target_um(params, parts)
        if not job.automatic:
            return _at(self._move(job, target_um, parts, config))
        then = self._kept.content.thermometer
        return _at(self.approach(job, target_um, 0 if then is None else then.sign, parts, config))

    def _move(self, job: Job, target_um: float, parts: RigParts, config: Config) -> Arrival:
        speed_um_s = CycleSettings.from_config(config).speed_um_s
        return self._arrive(job, parts, lambda errands: errands.move_to(target_um, speed_um_s))

    def _jog(self, job: Job, params: JogParams, parts: RigParts, config: Config) -> Arrival:
        speed_um_s = CycleSettings.from_config(config).speed_um_s
        return self._arrive(job, parts, lambda errands: errands.jog(params.by_um, speed_um_s))

    def _arrive(self, job: Job, parts: RigParts, go: Callable[[Errands], Arrival]) -> Arrival:
        return go(self._errands(job, parts))

    def _errands(self, job: Job, parts: RigParts) -> Errands:
        interrupted = self._attention.question(job, parts.lens, moving=True)

        def asked() -> bool:
            here = parts.lens.position_at(parts.clock.now_ns())
            self._situation.update_lens(position_um=parts.scale.to_um(here.steps), moving=True)
            return bool(interrupted())

        return Errands(parts.clock, parts.lens, parts.scale, asked)

    def _apply(self, job: Job, params: PresetParams, parts: RigParts, config: Config) -> PresetAnswer:
        assert params.name is not None, "apply takes a name"
        preset: Preset = self._kept.preset(params.name)
        arrival = self.approach(job, preset.position_um, preset.approach, parts, config)
        if preset.roi is not None:
            self._kept.set_roi(preset.roi)
            self._situation.set_roi(preset.roi)
        return PresetAnswer(presets=self._kept.presets(), position_um=arrival.um)

    def _record(self, job: Job, params: RecordParams, parts: RigParts, config: Config) -> Result:
        return record(params, parts, config, self._attention.question(job, parts.lens, moving=False))

    def _measure(self, session: Session, wall_s: float) -> None:
        stages = self._situation.stages
        stages.add("cycle", 1e6 * wall_s)
        if session.result.stop_latency_us is not None:
            stages.add("stop", float(session.result.stop_latency_us))
        for phase in session.result.phases:
            stages.add(phase.name, 1e3 * phase.ms)

    def _keep_map(self, session: Session, config: Config) -> None:
        """Let a person look, draw, and then focus with ``reference: last``."""
        assert session.map is not None
        assert session.result.final_um is not None
        stored = stored_map.StoredMap(session.map, session.result.final_um, time.time())
        try:
            stored_map.save(config.journal.directory / "last-map.npz", stored)
        except OSError as error:
            self._situation.warn("map-not-kept", f"the map could not be written ({error.strerror or error})")


def focus_answer(session: Session) -> FocusAnswer:
    """Return a session as its JSON; a run by its name."""
    fields = session.fields()
    fields["run"] = None if session.run is None else session.run.name
    return FocusAnswer.model_validate(plain(fields))


def _target_um(params: MoveParams, parts: RigParts) -> float:
    if params.to_um is not None:
        return params.to_um
    limits = parts.lens.limits
    low_um, high_um = parts.scale.to_um(limits.min_steps), parts.scale.to_um(limits.max_steps)
    assert params.fraction is not None, "one of both is given"
    return low_um + params.fraction * (high_um - low_um)


def _at(arrival: Arrival) -> MoveAnswer:
    return MoveAnswer(position_um=arrival.um, sigma_um=None, outcome="CANCELLED" if arrival.cancelled else "OK")


def _roi(box: RoiBox | None) -> Roi | None:
    return None if box is None else Roi(box.x, box.y, box.width, box.height)


def _reference(params: FocusParams, config: Config) -> Path | None:
    if params.reference is None:
        return None
    last = config.journal.directory / "last-map.npz"
    path = last if params.reference == "last" else last.__class__(params.reference)
    if not path.is_file():
        hint = "make one with a dry run, or with `elpd expose`" if params.reference == "last" else "give another"
        raise UsageError(f"reference {params.reference!r}: {path} does not exist on the daemon's machine; {hint}")
    return path
