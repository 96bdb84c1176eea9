"""The engine of `elpd serve`: owns the rig, takes requests, and answers each exactly once.

It runs in two ways. ``start`` gives it its threads, against the wall clock: the focus thread, the backroom for what
needs no device, and a supervisor. Without ``start`` nothing happens by itself: whoever holds it calls ``step``, and the
rig's virtual time passes. The decisions are the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import structlog

from elpd import rig
from elpd.calibrate.profile import state_directory
from elpd.errors import UnavailableError
from elpd.records import Cancel, StopMode
from elpd.service import archive, memory
from elpd.service.admission import refuse_motion
from elpd.service.attention import Attention
from elpd.service.autopilot import Autopilot
from elpd.service.backroom import Backroom, answer_of
from elpd.service.books import Books
from elpd.service.clerk import Clerk
from elpd.service.heartbeats import Heartbeats
from elpd.service.idle import Idle
from elpd.service.job import Job, Place
from elpd.service.keeper import RigKeeper
from elpd.service.kept import Kept
from elpd.service.lease import Lease
from elpd.service.messages import (
    CancelAnswer,
    ClearAnswer,
    FocusAnswer,
    FocusParams,
    MetricsAnswer,
    StopAnswer,
    operates,
)
from elpd.service.metrics import exposition
from elpd.service.pictures import Album
from elpd.service.situation import Situation
from elpd.service.work import Work
from elpd.service.worker import Worker

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.config import Config
    from elpd.events.decoder import EventArrays
    from elpd.ports import RigParts
    from elpd.records import Frame
    from elpd.service.engine_port import Answer, Caller, ClientCounts, Request
    from elpd.service.messages import Event, Result, Status
    from elpd.service.timing import Time

FOCUS_LOOP = "focus"

DEVICE_METHODS = frozenset({"focus", "home", "move", "jog", "record"})
"""Methods that need the focus thread; so does ``preset`` where it moves the lens."""

RIG_SECTIONS = ("rig", "camera", "lens", "aperture", "sim", "state")
"""What a rig is made of: another one of these is another rig."""

log = structlog.get_logger(__name__)


class RigEngine:
    """``elpd.service.engine_port.Engine``.

    Parameters
    ----------
    config
        The rig and how to use it.
    time, place
        The engine's time, and where requests wait; ``threads.run`` and tests make them.
    threaded
        Whether what needs no device is done by a thread of its own.
    build, prepare
        Opens the rig; has the kernels for another one, where the configuration is changed.
    """

    def __init__(
        self,
        config: Config,
        time: Time,
        place: Place | None = None,
        *,
        threaded: bool = False,
        build: Callable[[Config], RigParts] = rig.build,
        prepare: Callable[[Config], None] = lambda _: None,
    ) -> None:
        self.config = config
        self.time = time
        self.place = place or Place()
        self.heartbeats = Heartbeats()
        self.keeper = RigKeeper(config, build, prepare)
        self.situation = Situation(config, time.now_s)
        self.lease = Lease(time.now_s)
        self._threaded = threaded
        self.backroom = Backroom(threaded=threaded)
        self.album = Album(time.now_s)
        self._kept = Kept(state_directory(config))
        self.stopping = False
        """Whether this is the end."""
        attention = Attention(self.heartbeats, FOCUS_LOOP)
        work = Work(self.situation, attention, self._kept)
        self.autopilot = Autopilot(config, self.situation, self._kept, self.lease, self.place, time)
        work.focused_at = self.autopilot.focused_at
        self._clerk = Clerk(self.situation, self._kept, self.lease, self.autopilot)
        self._work = work
        self.idle = Idle(self.situation, time, config.service, self._hear)
        self.worker = Worker(
            self.keeper,
            self.place,
            self.idle,
            work,
            self.autopilot,
            self.situation,
            attention,
            time,
            self._ended,
            lambda: self.album.watched,
        )
        self._books = Books(self._kept, self.situation)
        self.keeper.needs_home = self._books.remember()

    # --- what the socket sees ----------------------------------------------------------------------------------------

    def status(self) -> Status:
        """Return a snapshot."""
        return self.situation.snapshot(self.lease.answer(), self.heartbeats.ages())

    def submit(self, request: Request) -> Job:
        """Accept a request, or raise why not."""
        job = Job(request)
        try:
            self._accept(job)
        except Exception:
            self.situation.count(requests=1, refused=1)
            raise
        self.situation.count(requests=1)
        return job

    def stop(self) -> StopAnswer:
        """Stop the lens now, and end what runs where the lens stops."""
        was_moving = self.situation.lens.moving
        failure = self.keeper.stop_lens(StopMode.ABRUPT)
        self.place.cancel_all(Cancel.HOLD, "stopped on request; the lens was left where it stopped")
        self.autopilot.rest("somebody stopped the lens")
        if failure is not None:
            raise failure
        return StopAnswer(was_moving=was_moving)

    def cancel(self) -> CancelAnswer:
        """End what runs."""
        cancelled = self.place.cancel_all()
        if any(job.automatic for job in cancelled):
            self.autopilot.rest("somebody cancelled its cycle")
        return CancelAnswer(cancelled=bool(cancelled))

    def clear(self) -> ClearAnswer:
        """Clear the fault; a rig that is gone is tried again at once, and if it stays away it is a fault again."""
        cleared = self.situation.clear()
        if cleared is not None:
            log.info("fault cleared", kind=cleared.kind)
        if self.keeper.parts is None:
            self.keeper.hurry()
            self.place.ring()
        return ClearAnswer(cleared=cleared, state=self.situation.state)

    def listen(self, listener: Callable[[Event], None]) -> Callable[[], None]:
        """Tell *listener* every event."""
        return self.situation.listen(listener)

    def gone(self, caller: Caller) -> None:
        """Hear that a connection has ended."""
        self.lease.gone(caller)
        for job in self.place.jobs():
            params = job.request.params
            if job.request.caller.connection != caller.connection or not isinstance(params, FocusParams):
                continue
            if params.on_disconnect == "cancel":
                job.why_cancelled = job.why_cancelled or "cancelled: whoever asked for it has gone"
                job.cancel()

    def beat(self, loop: str) -> None:
        """Hear that a loop outside lives."""
        self.heartbeats.beat(loop)

    def note_clients(self, counts: ClientCounts) -> None:
        """Take over the socket's counts."""
        self.situation.set_counts(
            clients=counts.clients, dropped_clients=counts.dropped_clients, dropped_events=counts.dropped_events
        )

    # --- what runs it ------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Do one turn of the focus thread."""
        self.worker.step()

    def ready(self) -> None:
        """Everything that could be opened is; requests are taken from now on."""
        self._kept.change(open=True)
        self._books.save()
        self.situation.began()

    def reload(self, config: Config, done: Callable[[], None] = lambda: None) -> None:
        """Take another configuration, as soon as nothing is being done; *done* is called then.

        The rig is opened anew only if what it is made of has changed. State, once read, stays where it was.
        """

        def change() -> None:
            other = any(getattr(config, part) != getattr(self.config, part) for part in RIG_SECTIONS)
            self.config = self.keeper.config = config
            self.idle.reconfigure(config.service)
            self.autopilot.reconfigure(config)
            if other:
                self.worker.reopen()
                self.situation.configured(config)
            log.info("configuration reloaded", rig_reopened=other)
            done()

        self.worker.reload = change
        self.place.ring()

    def begin_stopping(self) -> None:
        """Stop the lens, refuse what comes, end what runs. From any thread; the bytes leave first."""
        failure = self.keeper.stop_lens(StopMode.RAMPED)
        self.stopping = True
        self.situation.stopping()
        self.place.cancel_all(Cancel.HOLD, "the daemon is going down; the lens was left where it stopped")
        self.place.ring()
        if failure is not None:
            log.error("lens not stopped", reason=str(failure))

    def finish_stopping(self) -> None:
        """Give everything back. Called by whoever steps, after the last step."""
        self.worker.release()
        self._kept.change(open=False)
        self._books.save()
        self.backroom.close()

    # --- below -------------------------------------------------------------------------------------------------------

    def _accept(self, job: Job) -> None:
        request = job.request
        method = request.method
        params: Any = request.params
        if method in {"stop", "cancel", "clear"}:
            job.finish(answer_of(getattr(self, method)))
            return
        if self.stopping:
            raise UnavailableError("the daemon is going down; nothing was done")
        if operates(method, params):
            self.lease.refuse_others(request.caller)
        if method in DEVICE_METHODS or (method == "preset" and getattr(params, "action", None) == "apply"):
            refuse_motion(request, self.situation, self.autopilot.mode, needs_home=self.keeper.needs_home)
            self.place.put(job)
            return
        directory = self.config.journal.directory
        table: dict[str, Callable[[], Result]] = {
            "status": self.status,
            "map": lambda: self.album.picture(params),
            "runs": lambda: archive.runs(directory, params.limit),
            "run": lambda: archive.run(directory, params.name),
            "metrics": lambda: MetricsAnswer(text=exposition(self.status())),
        }
        if method in table:
            self.backroom.answer(job, table[method])
            return
        result = self._clerk.answer(request)
        self.backroom.also(self._books.save)
        job.finish(answer_of(lambda: result))

    def _ended(self, job: Job, answer: Answer) -> None:
        """Keep the books of a request that was done, before anybody hears of it."""
        result = answer.result
        if isinstance(result, FocusAnswer):
            if result.outcome == "CANCELLED":
                self.situation.count(cancelled=1)
            self.album.keep_map(self._work.session, self.situation.lens.position_um)
            budget_bytes = 1e6 * self.config.journal.budget_mb
            directory = self.config.journal.directory
            self.backroom.also(lambda: archive.keep_budget(directory, budget_bytes))
            if self._threaded:
                self.backroom.also(memory.give_back)
        self.autopilot.ended(job, answer, self._work.session)
        self.backroom.also(self._books.save)

    def _hear(self, frame: Frame | None, events: EventArrays) -> None:
        """Take what the idle camera says."""
        position_um = self.situation.lens.position_um
        parts = self.keeper.parts
        if frame is not None:
            self.album.keep_frame(frame, position_um)
        if parts is not None:
            self.album.keep_events(events, parts.camera.geometry, position_um)
            self.autopilot.hear(events)
