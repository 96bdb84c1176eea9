"""What is done for a request, on the focus thread, with a rig that is open. Each ends in one answer.

What a person should change (``UsageError``) is an answer; broken machinery (``DeviceError``) is raised, and whoever
runs this latches it. Whatever waits asks ``Attention.interrupted`` each time round: that is where a cancellation is
heard, and where the supervisor sees that this thread lives.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from elpd.errors import UsageError
from elpd.focus import stored_map
from elpd.focus.settings import FocusRequest
from elpd.record.session import focus_on
from elpd.records import Outcome, Roi
from elpd.service.attention import STILL_S
from elpd.service.codec import plain
from elpd.service.messages import FocusAnswer, FocusParams, HomeAnswer, MoveAnswer, MoveParams, PresetAnswer
from elpd.service.moves import Moves
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
        self.moves = Moves(situation, attention)
        self.focused_at: Callable[[float], int | None] = lambda _: None
        """Says from which side the lens came to focus, if a place is where it did; else ``None``."""
        self.session: Session | None = None
        """The last cycle, for whoever wants its pictures."""

    def do(self, job: Job, parts: RigParts, config: Config) -> Result:
        """Do what *job* asks. Raises ``UsageError``, ``DeviceError``."""
        params: Any = job.request.params
        match job.request.method:
            case "focus":
                return self._focus(job, params, parts, config)
            case "home":
                return HomeAnswer(position_um=self.moves.home(job, parts).um)
            case "move":
                return self._moved(job, params, parts, config)
            case "jog":
                return _at(self.moves.by(job, params.by_um, parts, config))
            case "preset":
                return self._apply(job, params, parts, config)
            case "record":
                return self._record(job, params, parts, config)
        raise UsageError(f"{job.request.method!r} is nothing that a lens or camera does")

    def _focus(self, job: Job, params: FocusParams, parts: RigParts, config: Config) -> FocusAnswer:
        preset = None if params.preset is None else self._kept.preset(params.preset)
        roi = params.roi or (None if preset is None else preset.roi) or self._kept.roi
        request = FocusRequest(roi=_roi(roi), reference=_reference(params, config), dry_run=params.dry_run)
        if preset is not None and not params.dry_run:
            self.moves.approach(job, preset.position_um, preset.approach, parts, config)
        self._situation.focusing(on=True)
        begun_s = time.monotonic()
        try:
            session = self._cycle(job, request, parts, config)
        finally:
            self._situation.focusing(on=False)
        self.session = session
        self._measure(session, time.monotonic() - begun_s)
        if params.dry_run and session.map is not None and session.result.final_um is not None:
            self._keep_map(session, config)
        answer = focus_answer(session)
        self._situation.heard(answer.events, answer.lost)
        self._situation.ended(answer)
        return answer

    def _cycle(self, job: Job, request: FocusRequest, parts: RigParts, config: Config) -> Session:
        with self._attention.without_signs(STILL_S):
            interrupted = self._attention.question(job, parts.lens, moving=False)
            session = focus_on(parts, config, request, Audience(self._situation, self._attention), interrupted)
        if job.why_cancelled and session.result.outcome is Outcome.CANCELLED:
            session = replace(session, result=replace(session.result, reason=job.why_cancelled))
        return session

    def _moved(self, job: Job, params: MoveParams, parts: RigParts, config: Config) -> MoveAnswer:
        """Go there; what the daemon does by itself keeps to the side that focus was found from."""
        target_um = _target_um(params, parts)
        if not job.automatic:
            return _at(self.moves.to(job, target_um, parts, config))
        sign = self.focused_at(self.moves.here_um(parts)) or 0
        return _at(self.moves.approach(job, target_um, sign, parts, config))

    def _apply(self, job: Job, params: PresetParams, parts: RigParts, config: Config) -> PresetAnswer:
        assert params.name is not None, "apply takes a name"
        preset: Preset = self._kept.preset(params.name)
        arrival = self.moves.approach(job, preset.position_um, preset.approach, parts, config)
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
            stages.add("stop command", float(session.result.stop_latency_us))
        for phase in session.result.phases:
            stages.add(phase.name, 1e3 * phase.ms)
        for stage, durations_us in session.delays.items():
            for duration_us in durations_us:
                stages.add(stage, duration_us)

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
