"""What the engine tells, passed on to those who wanted it: a bounded queue between its threads and the socket's loop.

The engine's threads leave events and answers here and never wait; the loop passes on a few a turn, in the order in
which they came. Past the bound samples and positions are dropped and counted, answers and results never.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from elpd.service.desk import answer_line
from elpd.service.messages import PhaseEvent, PositionEvent, ResultEvent, SampleEvent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from elpd.service.connection import Connection
    from elpd.service.engine_port import Answer
    from elpd.service.lines import Number
    from elpd.service.messages import Event

EVENTS_A_TURN = 32
MOST_EVENTS_WAITING = 4096


class Telling:
    """The queue, and what is done with it.

    Parameters
    ----------
    connections
        Those there are, at any time.
    soon, at_once
        Have something done in a later turn of the loop: from the loop itself, from any thread.
    answered
        Hears, on the loop, that a connection has been given an answer.
    """

    def __init__(
        self,
        connections: Callable[[], Iterable[Connection]],
        soon: Callable[[Callable[[], None]], None],
        at_once: Callable[[Callable[[], None]], None],
        answered: Callable[[], None],
    ) -> None:
        self._connections, self._soon, self._at_once, self._answered = connections, soon, at_once, answered
        self._waiting: deque[Event | tuple[Connection, Number, Answer]] = deque()
        self._woken = False
        self.dropped = 0
        """How many events nobody was told."""

    def event(self, event: Event) -> None:
        """Take an event, from any thread."""
        if len(self._waiting) >= MOST_EVENTS_WAITING and isinstance(event, SampleEvent | PositionEvent):
            self.dropped += 1
            return
        self._wake(event)

    def answer(self, connection: Connection, number: Number, answer: Answer) -> None:
        """Take an answer, from any thread."""
        self._wake((connection, number, answer))

    def _wake(self, item: Event | tuple[Connection, Number, Answer]) -> None:
        self._waiting.append(item)
        if not self._woken:
            self._woken = True
            self._at_once(self._tell)

    def _tell(self) -> None:
        """Pass on a few events and answers, in the order in which they came."""
        self._woken = False
        for _ in range(min(EVENTS_A_TURN, len(self._waiting))):
            item = self._waiting.popleft()
            if isinstance(item, tuple):
                connection, number, answer = item
                connection.in_flight.remove(number)
                self._answered()
                connection.send(answer_line(number, answer))
            else:
                self._spread(item)
        if self._waiting and not self._woken:
            self._woken = True
            self._soon(self._tell)

    def _spread(self, event: Event) -> None:
        body = ""
        for connection in self._connections():
            if event.event not in connection.wanted:
                continue
            for late in _samples_before(connection, event):
                _send_event(connection, late.model_dump_json(), droppable=True)
            if isinstance(event, SampleEvent):
                continue
            body = body or event.model_dump_json()
            _send_event(connection, body, droppable=isinstance(event, PositionEvent))


def _samples_before(connection: Connection, event: Event) -> list[SampleEvent]:
    """Return what the client is told of samples now: some of those there are, and the last one before a phase ends."""
    if connection.decimator is None:
        return []
    if isinstance(event, SampleEvent):
        return connection.decimator.take(event)
    return connection.decimator.held() if isinstance(event, PhaseEvent | ResultEvent) else []


def _send_event(connection: Connection, body: str, *, droppable: bool) -> None:
    """Send an event, numbered for this client: a number that is missing was dropped."""
    connection.told += 1
    line = f'{{"seq":{connection.told},{body[1:]}\n'.encode()
    connection.send(line, droppable=droppable, seq=connection.told)
