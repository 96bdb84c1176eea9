"""The focus thread, one turn at a time: take a request, or mind the rig, or try to get it back.

The same turns run in a thread against the wall clock and, called one after the other, in virtual time. A turn is short
unless it is a request's. This is the one thread that talks to camera and lens; others may stop the lens, and no more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import structlog

from elpd.errors import (
    ConfigError,
    DeviceError,
    FormatError,
    LensError,
    UnavailableError,
    UnreferencedError,
    UsageError,
)
from elpd.records import Outcome, StopMode
from elpd.service.attention import PAUSE_S
from elpd.service.engine_port import Answer
from elpd.service.messages import ErrorBody, FocusAnswer, FocusParams

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.ports import RigParts
    from elpd.service.attention import Attention
    from elpd.service.autopilot import Autopilot
    from elpd.service.idle import Idle
    from elpd.service.job import Job, Place
    from elpd.service.keeper import RigKeeper
    from elpd.service.situation import Situation
    from elpd.service.timing import Time
    from elpd.service.work import Work

NAP_WITHOUT_RIG_S = 0.05

PREPARED_WITHIN_S = 180.0
"""Compiling takes ten seconds of two cores of a PC; this is for a board that is four times as slow, and has one."""

log = structlog.get_logger(__name__)


class Worker:
    """What the focus thread does.

    Parameters
    ----------
    keeper, place, idle, work, autopilot
        The rig, where requests wait, what is done between them, what is done for them, and what the daemon does by
        itself.
    situation, attention, time
        What is told, what interrupts, and by which time.
    ended
        Hears of every request that was done, before its answer is given.
    watched
        Says whether somebody looks at the camera's pictures.
    """

    def __init__(
        self,
        keeper: RigKeeper,
        place: Place,
        idle: Idle,
        work: Work,
        autopilot: Autopilot,
        situation: Situation,
        attention: Attention,
        time: Time,
        ended: Callable[[Job, Answer], None],
        watched: Callable[[], bool] = lambda: False,
    ) -> None:
        self._keeper = keeper
        self._place = place
        self._idle = idle
        self._work = work
        self._autopilot = autopilot
        self._situation = situation
        self._attention = attention
        self._time = time
        self._ended = ended
        self._watched = watched
        self._begun = False
        self.reload: Callable[[], None] | None = None
        """What to do once nothing is being done; it closes or changes the rig's configuration."""

    def step(self) -> None:
        """Do one turn."""
        passed_s = self._attention.beat()
        if passed_s > PAUSE_S and self._begun:
            self._after_pause(passed_s)
        if self.reload is not None and self._place.current is None:
            reload, self.reload = self.reload, None
            reload()
        parts = self._keeper.parts
        if parts is None:
            self._without_rig()
            return
        job = self._place.take() or self._autopilot.job()
        if job is not None:
            self._run(job, parts)
            return
        self._idle.every_s = self._autopilot.listen_every_s
        self._idle.somebody_watches = self._autopilot.weighs or self._watched()
        try:
            self._idle.turn(parts, needs_home=self._keeper.needs_home)
        except DeviceError as error:
            self.lost(error)

    def lost(self, error: Exception) -> None:
        """Latch what broke, stop the lens, give the rig back; it is opened again by itself."""
        self._keeper.stop_lens(StopMode.ABRUPT)
        is_lens = not isinstance(error, DeviceError) or isinstance(error, LensError)
        kind = getattr(error, "kind", "InternalError")
        if self._situation.latch(kind, str(error)):
            log.error("fault latched", kind=kind, reason=str(error), lens=self._situation.lens.model_dump())
        self._let_go(lens_moved_unseen=is_lens)

    def release(self) -> None:
        """Give the rig back and answer what still waits: the end."""
        waiting = self._place.take()
        if waiting is not None:
            self._place.done()
            self._finish(waiting, Answer.failed(UnavailableError("the daemon is going down; nothing was moved")))
        parts = self._keeper.parts
        if parts is not None:
            self._leave(parts)
        self._keeper.close()

    def reopen(self) -> None:
        """Give the rig back and open it anew, by another configuration."""
        self._let_go(lens_moved_unseen=False)
        self._keeper.hurry()

    # --- without a rig -----------------------------------------------------------------------------------------------

    def _without_rig(self) -> None:
        self._begun = True
        waiting = self._place.take()
        if waiting is not None:
            self._place.done()
            fault = self._situation.fault
            why = "no rig" if fault is None else fault.message
            self._finish(waiting, Answer(error=ErrorBody(kind="Fault", message=f"nothing was moved: {why}")))
        if not self._keeper.due(self._time.now_s()):
            self._time.nap(NAP_WITHOUT_RIG_S)
            return
        if self._keeper.unprepared and not self._prepared():
            return
        now_s = self._time.now_s()
        try:
            with self._attention.without_signs(30.0):
                parts = self._keeper.open(now_s)
        except (DeviceError, ConfigError, FormatError) as error:
            if self._situation.latch(error.kind, str(error)):
                log.error("fault latched", kind=error.kind, reason=str(error), lens=None)  # noqa: TRY400  (said, not traced)
            return
        self._time.follow(parts.clock)
        self._attention.follow(parts.clock)
        self._idle.opened(parts)
        try:
            self._idle.meet(parts, needs_home=self._keeper.needs_home and parts.lens.capabilities.homing)
        except LensError as error:
            self.lost(error)
            return
        self._autopilot.opened()
        homes = parts.lens.capabilities.homing
        if self._keeper.needs_home and not homes:
            self._keeper.needs_home = False
            self._situation.warn(
                "lens-unreferenced", "the lens may have moved unseen and this controller cannot home; see where it is"
            )
        log.info("rig open", needs_home=self._keeper.needs_home)

    def _prepared(self) -> bool:
        """Have the kernels of another rig's camera, for which all wait; ``False`` if the daemon was asked to end."""
        self._situation.warn(
            "compiling", "kernels for the other camera are being compiled; what is asked for is done after that"
        )
        try:
            with self._attention.without_signs(PREPARED_WITHIN_S):
                self._keeper.prepare()
        except SystemExit:
            return False
        finally:
            self._situation.unwarn("compiling")
        return True

    def _let_go(self, *, lens_moved_unseen: bool) -> None:
        self._keeper.lose(self._time.now_s(), lens_moved_unseen=lens_moved_unseen)
        self._situation.update_camera(connected=False, events_per_s=None, backlog=0)
        self._situation.update_lens(connected=False, position_um=None, sigma_um=None, moving=None, referenced=None)
        self._autopilot.rest("the rig was lost")
        self._time.follow(None)
        self._attention.follow(None)

    def _after_pause(self, passed_s: float) -> None:
        """Forget the scene: the machine slept. The lens is asked anew before anything moves."""
        log.warning("process stood still", seconds=passed_s)
        self._situation.warn("paused", f"this process stood still for {passed_s:.1f} s while nothing moved")
        self._autopilot.forget()

    # --- with one ----------------------------------------------------------------------------------------------------

    def _run(self, job: Job, parts: RigParts) -> None:
        try:
            answer = self._do(job, parts)
        finally:
            self._situation.set_phase(None)
            self._place.done()
        self._finish(job, answer)

    def _do(self, job: Job, parts: RigParts) -> Answer:
        if job.cancelled:
            return _cancelled_before(job)
        if job.request.method != "focus":
            self._situation.set_phase(job.request.method)
        try:
            self._idle.leave(parts)
            result = self._work.do(job, parts, self._keeper.config)
        except UnreferencedError as error:  # homing was stopped: nothing is broken, but the driver must begin anew
            self._let_go(lens_moved_unseen=True)
            return Answer.failed(error)
        except UsageError as error:
            return Answer.failed(error)
        except DeviceError as error:
            self.lost(error)
            return Answer.failed(error)
        except Exception as error:
            log.exception("request failed")
            self.lost(error)
            return Answer(
                error=ErrorBody(kind="InternalError", message=f"{type(error).__name__}: {error}; see the log")
            )
        self._attention.beat()
        self._situation.update_lens(moving=False)
        if job.request.method == "home":
            self._keeper.needs_home = False
            self._situation.unwarn("ended-badly")
            self._situation.update_lens(referenced=True)
        try:
            self._idle.tell_lens(parts, parts.lens.poll(), needs_home=self._keeper.needs_home)
        except DeviceError as error:
            self.lost(error)
        return Answer(result)

    def _finish(self, job: Job, answer: Answer) -> None:
        self._ended(job, answer)
        job.finish(answer)

    def _leave(self, parts: RigParts) -> None:
        try:
            self._idle.leave(parts)
        except DeviceError as error:
            log.warning("camera did not stop", reason=str(error))


def _cancelled_before(job: Job) -> Answer:
    """Answer a request that was cancelled before its turn came."""
    why = job.why_cancelled or "cancelled on request, before anything moved"
    if not isinstance(job.request.params, FocusParams):
        return Answer(error=ErrorBody(kind="Cancelled", message=why))
    fields = dict.fromkeys(("focus_um", "sigma_um", "stop_um", "final_um", "stop_latency_us"))
    counted = {"reversals": 0, "duration_ms": 0.0, "phases": [], "events": 0, "lost": 0}
    return Answer(FocusAnswer.model_validate({"outcome": Outcome.CANCELLED.value, "reason": why, **fields, **counted}))
