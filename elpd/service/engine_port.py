"""The seam between the socket and the engine: nothing on it waits.

The socket's thread calls the engine, the engine's threads call back; neither ever waits for the other. A request is
``submit``ted and either refused on the spot (an ``ElpdError`` is raised, and nothing more is heard of it) or accepted,
and then its ticket gets exactly one ``Answer``. ``stop`` is not queued: its bytes have left when it returns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from elpd.errors import BusyError, ConfigError, ElpdError, UsageError
from elpd.service.messages import ErrorBody, Result

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.service.messages import CancelAnswer, ClearAnswer, Event, Params, Status, StopAnswer


@dataclass(frozen=True, slots=True)
class Caller:
    """Who asks. ``connection`` is unique over the daemon's life: leases and disconnections go by it."""

    connection: int
    pid: int
    uid: int
    name: str


@dataclass(frozen=True, slots=True)
class Request:
    """A call whose parameters have been validated (``messages.METHODS``)."""

    method: str
    params: Params
    caller: Caller


@dataclass(frozen=True, slots=True)
class Answer:
    """The one terminal answer of a request: a result or an error."""

    result: Result | None = None
    error: ErrorBody | None = None

    @classmethod
    def failed(cls, error: ElpdError) -> Answer:
        """Answer with an error."""
        return cls(error=error_body(error))


class Ticket(Protocol):
    """A request that was accepted."""

    def cancel(self) -> bool:
        """End it early; it still gets its answer. ``False`` if it has one already or cannot be ended."""
        ...

    def add_done_callback(self, done: Callable[[Answer], None], /) -> None:
        """Call *done* once, from whichever thread answers, or at once if there is an answer. It must not block."""
        ...


@dataclass(frozen=True, slots=True)
class ClientCounts:
    """What the socket counts."""

    clients: int = 0
    dropped_clients: int = 0
    dropped_events: int = 0


class Engine(Protocol):
    """The rig's owner, as the socket sees it. Every method may be called from any thread and returns at once."""

    def status(self) -> Status:
        """Return a snapshot."""
        ...

    def submit(self, request: Request) -> Ticket:
        """Accept a request of any method but ``hello`` and ``subscribe``, which are the socket's own.

        Roles are the socket's business; leases, faults and conflicts are looked at here. Raises what ``error_body``
        knows: ``BusyError``, ``FaultLatchedError``, ``UnavailableError``, ``UsageError``, ``UnreferencedError``.
        """
        ...

    def stop(self) -> StopAnswer:
        """Stop the lens now, and end what runs as CANCELLED. The bytes have left when this returns."""
        ...

    def cancel(self) -> CancelAnswer:
        """End what runs as CANCELLED."""
        ...

    def clear(self) -> ClearAnswer:
        """Clear a latched fault."""
        ...

    def listen(self, listener: Callable[[Event], None]) -> Callable[[], None]:
        """Tell *listener* every event, from the engine's threads; it must not block. Returns what ends it."""
        ...

    def gone(self, caller: Caller) -> None:
        """Hear that a connection has ended: its lease ends, its requests go on or end as they asked to."""
        ...

    def beat(self, loop: str) -> None:
        """Hear that a loop outside the engine lives: the socket's beats as ``api``, at least once a second."""
        ...

    def note_clients(self, counts: ClientCounts) -> None:
        """Take over the socket's counts, for the status."""
        ...


def error_body(error: ElpdError) -> ErrorBody:
    """Return an error as the socket tells it."""
    if isinstance(error, UsageError) and not isinstance(error, ConfigError):
        return ErrorBody(kind="UsageError", message=str(error))
    if type(error) is BusyError:
        return ErrorBody(kind="Busy", message=str(error))
    return ErrorBody(kind=error.kind, message=str(error))
