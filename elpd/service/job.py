"""A request on its way to its one answer, and the place where requests wait for the lens.

The lens does one thing at a time, so there is one place: a second request is refused as busy rather than queued, for a
queue of motions is a surprise waiting for whoever stands beside the lens. What the daemon does by itself gives way.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from elpd.errors import BusyError
from elpd.records import Cancel

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.service.engine_port import Answer, Request


class Job:
    """An accepted request: the ``Ticket`` of whoever asked, the flag of whoever does it.

    Parameters
    ----------
    request
        What was asked.
    automatic
        The daemon asked itself: anybody's request ends it.
    """

    def __init__(self, request: Request, *, automatic: bool = False) -> None:
        self.request = request
        self.automatic = automatic
        self.why_cancelled: str | None = None
        """What to say instead of "on request"; set before ``cancel``."""
        self._lock = threading.Lock()
        self._cancelled = Cancel.NO
        self._answer: Answer | None = None
        self._callbacks: list[Callable[[Answer], None]] = []

    @property
    def cancelled(self) -> Cancel:
        """Whether its end was asked for."""
        return self._cancelled

    @property
    def answer(self) -> Answer | None:
        """The answer, once there is one."""
        return self._answer

    def cancel(self, how: Cancel = Cancel.RETURN) -> bool:
        """Ask for its end. ``False`` if it has ended."""
        with self._lock:
            if self._answer is not None:
                return False
            self._cancelled = max(self._cancelled, how)
            return True

    def add_done_callback(self, done: Callable[[Answer], None], /) -> None:
        """Call *done* with the answer, once."""
        with self._lock:
            if self._answer is None:
                self._callbacks.append(done)
                return
            answer = self._answer
        done(answer)

    def finish(self, answer: Answer) -> None:
        """Give the answer; a second one is a mistake of this program, and raises ``RuntimeError``."""
        with self._lock:
            if self._answer is not None:
                raise RuntimeError(f"{self.request.method}: a second answer; a request has one")
            self._answer = answer
            callbacks, self._callbacks = self._callbacks, []
        for done in callbacks:
            done(answer)


class Place:
    """Where one request waits, and what is done now. Thread-safe; only ``wait`` waits."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: Job | None = None
        self._current: Job | None = None
        self._rung = False

    @property
    def current(self) -> Job | None:
        """What is being done."""
        return self._current

    @property
    def busy(self) -> bool:
        """Whether anybody's request is being done or waits."""
        with self._changed:
            return self._occupant() is not None

    def put(self, job: Job) -> None:
        """Let *job* wait for its turn; what the daemon does by itself is cancelled for it. Raises ``BusyError``."""
        with self._changed:
            occupant = self._occupant()
            if occupant is not None:
                raise BusyError(
                    f"the lens is busy with {occupant.request.method!r} of {occupant.request.caller.name}; "
                    "wait for its end, or cancel it"
                )
            self._waiting = job
            if self._current is not None:
                self._current.cancel()
            self._changed.notify_all()

    def take(self) -> Job | None:
        """Return what waits, if anything does; it is current from now on."""
        with self._changed:
            job, self._waiting = self._waiting, None
            if job is not None:
                self._current = job
            return job

    def begin(self, job: Job) -> bool:
        """Make an automatic *job* current; ``False`` if somebody's request waits."""
        with self._changed:
            if self._waiting is not None:
                return False
            self._current = job
            return True

    def done(self) -> None:
        """Nothing is current any more."""
        with self._changed:
            self._current = None

    def cancel_all(self, how: Cancel = Cancel.RETURN, why: str | None = None) -> list[Job]:
        """Cancel what is done and what waits; return those that were."""
        with self._changed:
            jobs = [job for job in (self._current, self._waiting) if job is not None]
        asked = []
        for job in jobs:
            job.why_cancelled = job.why_cancelled or why
            if job.cancel(how):
                asked.append(job)
        return asked

    def jobs(self) -> list[Job]:
        """Return what is done and what waits."""
        with self._changed:
            return [job for job in (self._current, self._waiting) if job is not None]

    def ring(self) -> None:
        """Wake whoever waits: something else than a request has changed."""
        with self._changed:
            self._rung = True
            self._changed.notify_all()

    def wait(self, seconds: float) -> None:
        """Return when a request waits, when rung, or after *seconds*."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._rung, seconds)
            self._rung = False

    def _occupant(self) -> Job | None:
        if self._waiting is not None:
            return self._waiting
        current = self._current
        return current if current is not None and not current.automatic else None
