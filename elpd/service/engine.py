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
from elpd.errors import FaultLatchedError, UnavailableError, UnreferencedError, UsageError
from elpd.records import Cancel, StopMode
from elpd.service import archive, memory
from elpd.service.attention import Attention
from elpd.service.autopilot import Autopilot
from elpd.service.backroom import Backroom, answer_of
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
    from elpd.records import CameraPacket
    from elpd.service.engine_port import Answer, Caller, ClientCounts, Request
    from elpd.service.messages import Event, Result, Status
    from elpd.service.timing import Time

FOCUS_LOOP = "focus"

DEVICE_METHODS = frozenset({"focus", "home", "move", "jog", "record"})
"""Methods that need the focus thread; so does ``preset`` where it moves the lens."""

RIG_SECTIONS = ("rig", "camera", "lens", "aperture", "sim", "state")
"""What a rig is made of: another one of these is another rig."""

WITHOUT_REFERENCE = frozenset({"home", "record"})
"""What a lens that does not know where it is may be asked for."""

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
    build
        Opens the rig.
    """

    def __init__(
        self,
        config: Config,
        time: Time,
        place: Place | None = None,
        *,
        threaded: bool = False,
        build: Callable[[Config], RigParts] = rig.build,
    ) -> None:
        self.config = config
        self.time = time
        self.place = place or Place()
        self.heartbeats = Heartbeats()
        self.keeper = RigKeeper(config, build)
        self.situation = Situation(config, time.now_s)
        self.lease = Lease(time.now_s)
        self.backroom = Backroom(threaded=threaded)
        self.album = Album(time.now_s)
        self._kept = Kept(state_directory(config))
        self._stopping = False
        attention = Attention(self.heartbeats, FOCUS_LOOP)
        work = Work(self.situation, attention, self._kept)
        self.autopilot = Autopilot(config, self.situation, self._kept, self.lease, self.place, time)
        work.focused_at = self.autopilot.focused_at
        self._clerk = Clerk(self.situation, self._kept, self.lease, self.autopilot)
        self._work = work
        self.idle = Idle(self.situation, time, config.service, self._hear)
        self.worker = Worker(
            self.keeper, self.place, self.idle, work, self.autopilot, self.situation, attention, time, self._ended
        )
        self._remember()

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
        self._save()
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
        self._stopping = True
        self.situation.stopping()
        self.place.cancel_all(Cancel.HOLD, "the daemon is going down; the lens was left where it stopped")
        self.place.ring()
        if failure is not None:
            log.error("lens not stopped", reason=str(failure))

    def finish_stopping(self) -> None:
        """Give everything back. Called by whoever steps, after the last step."""
        self.worker.release()
        self._kept.change(open=False)
        self._save()
        self.backroom.close()

    # --- below -------------------------------------------------------------------------------------------------------

    def _accept(self, job: Job) -> None:
        request = job.request
        method = request.method
        params: Any = request.params
        if method in {"stop", "cancel", "clear"}:
            job.finish(answer_of(getattr(self, method)))
            return
        if self._stopping:
            raise UnavailableError("the daemon is going down; nothing was done")
        if operates(method, params):
            self.lease.refuse_others(request.caller)
        if method in DEVICE_METHODS or (method == "preset" and getattr(params, "action", None) == "apply"):
            self._refuse_motion(job)
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
        self.backroom.also(self._save)
        job.finish(answer_of(lambda: result))

    def _refuse_motion(self, job: Job) -> None:
        method, params = job.request.method, job.request.params
        state, fault = self.situation.state, self.situation.fault
        if state == "STARTING":
            raise UnavailableError("the daemon is starting; nothing was moved, ask again in a moment")
        if fault is not None:
            raise FaultLatchedError(
                f"nothing was moved: a fault is latched ({fault.kind}: {fault.message}); see to it, then clear it"
            )
        if method == "record" or (isinstance(params, FocusParams) and params.dry_run):
            return
        if method == "focus" and self.autopilot.mode == "manual":
            raise UsageError("the mode is manual: autofocus never moves the lens; set another mode first")
        if method not in WITHOUT_REFERENCE and self.keeper.needs_home:
            raise UnreferencedError("the lens may have moved unseen and does not know where it is; home it first")

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
            self.backroom.also(memory.trim)
        self.autopilot.ended(job, answer, self._work.session)
        self.backroom.also(self._save)

    def _hear(self, packet: CameraPacket, events: EventArrays) -> None:
        """Take what the idle camera says."""
        position_um = self.situation.lens.position_um
        parts = self.keeper.parts
        if packet.frames:
            self.album.keep_frame(packet.frames[-1], position_um)
        if parts is not None:
            self.album.keep_events(events, parts.camera.geometry, position_um)
            self.autopilot.hear(events)

    def _remember(self) -> None:
        """Begin with what was kept."""
        kept = self._kept.content
        self.situation.set_roi(kept.roi)
        self.keeper.needs_home = kept.open
        if self._kept.complaint is not None:
            self.situation.warn("state-damaged", self._kept.complaint)
            log.warning("state damaged", reason=self._kept.complaint)
        if kept.open:
            log.warning("daemon ended badly before")
            why = "the daemon before did not end in order; the lens may be anywhere: home it"
            self.situation.warn("ended-badly", why)

    def _save(self) -> None:
        try:
            self._kept.save()
        except OSError as error:
            text = f"{self._kept.path}: {error.strerror or error}; what was set is lost when the daemon ends"
            self.situation.warn("state-not-saved", text)
            log.warning("state not saved", reason=text)
        else:
            self.situation.unwarn("state-not-saved")
