"""What takes a moment and needs no device: pictures to encode, folders to read, a file to write.

Neither the socket's thread nor the focus thread may wait for a disk, so a third one does this, in order, from a queue
of bounded length.
"""

from __future__ import annotations

import queue
import threading
from contextlib import suppress
from typing import TYPE_CHECKING

import structlog

from elpd.errors import BusyError, ElpdError
from elpd.service.engine_port import Answer, error_body
from elpd.service.messages import ErrorBody

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.service.job import Job
    from elpd.service.messages import Result

LONGEST_QUEUE = 64

log = structlog.get_logger(__name__)


class Backroom:
    """Does errands that need no device; *threaded* or, for an engine that is stepped, at once."""

    def __init__(self, *, threaded: bool) -> None:
        self._queue: queue.Queue[Callable[[], None] | None] = queue.Queue(LONGEST_QUEUE)
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._run, name="elpd-backroom", daemon=True)
            self._thread.start()

    def answer(self, job: Job, work: Callable[[], Result]) -> None:
        """Answer *job* with what *work* returns or raises. Raises ``BusyError`` if too much waits."""
        self.do(lambda: job.finish(answer_of(work)))

    def do(self, work: Callable[[], None]) -> None:
        """Do *work*, which raises nothing. Raises ``BusyError`` if too much waits."""
        if self._thread is None:
            work()
            return
        try:
            self._queue.put_nowait(work)
        except queue.Full:
            raise BusyError(f"{LONGEST_QUEUE} requests for pictures or runs wait already; try again") from None

    def also(self, work: Callable[[], None]) -> None:
        """Do *work* if there is room for it: something that whoever comes later would do as well."""
        with suppress(BusyError):
            self.do(work)

    def close(self) -> None:
        """Finish what waits, then end."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        while (work := self._queue.get()) is not None:
            work()


def answer_of(work: Callable[[], Result]) -> Answer:
    """Return what *work* returns, or its error, as an answer: whatever happens, there is one."""
    try:
        return Answer(work())
    except ElpdError as error:
        return Answer(error=error_body(error))
    except OSError as error:
        return Answer(error=ErrorBody(kind="UsageError", message=f"{error.filename or 'disk'}: {error.strerror}"))
    except Exception as error:
        log.exception("request failed")
        return Answer(error=ErrorBody(kind="InternalError", message=f"{type(error).__name__}: {error}; see the log"))
