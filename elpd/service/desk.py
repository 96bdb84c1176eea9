"""What is done with a call: whether this client may, who does it, and what line answers it.

Exactly one answer leaves for each line that came. `stop` and `cancel` go straight to the engine; what takes time gets a
ticket, and its answer later, in the order in which the engine tells things. Methods of the socket's own are `hello` and
`subscribe`.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, cast

import structlog

from elpd import __version__
from elpd.errors import BusyError, ElpdError, ForbiddenError
from elpd.service.decimate import Decimator
from elpd.service.engine_port import Request, error_body
from elpd.service.lines import RefusedLine, read_call, too_long
from elpd.service.messages import (
    METHODS,
    ErrorBody,
    HelloAnswer,
    SubscribeAnswer,
    SubscribeParams,
    operates,
    schema_digest,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.service.connection import Connection
    from elpd.service.engine_port import Answer, Engine
    from elpd.service.lines import Call, Number
    from elpd.service.messages import Result

MOVING = frozenset({"focus", "home", "move", "jog", "preset", "mode"})
"""What may set the lens in motion, now or by itself later: never begun after a STOP that was sent later."""

MOST_IN_FLIGHT = 8
"""Requests of one client that wait for their answers."""


class Desk:
    """Answers calls. Used in the server's thread alone.

    Parameters
    ----------
    engine
        Does what moves or measures.
    answered
        Called with (connection, number, answer) when a ticket is done, from whichever thread did it.

    """

    def __init__(self, engine: Engine, answered: Callable[[Connection, Number, Answer], None]) -> None:
        self._engine = engine
        self._answered = answered
        self._digest = schema_digest()
        self._log = structlog.get_logger()

    def take(self, connection: Connection, line: bytes | None, *, overtaken: bool) -> None:
        """Do what a waiting line asks for; nothing that moves the lens if a STOP has *overtaken* it."""
        try:
            if line is None:
                raise RefusedLine(None, too_long())
            call = read_call(line)
        except RefusedLine as refused:
            connection.send(error_line(refused.number, error_body(refused.error)))
            return
        if overtaken and call.method in MOVING:
            error = BusyError(f"{call.method}: a stop or cancel came after this and was done first; ask again")
            connection.send(error_line(call.number, error_body(error)))
            return
        self.do(connection, call)

    def do(self, connection: Connection, call: Call) -> None:
        """Answer *call*, or see to it that it will be answered."""
        try:
            self._allow(connection, call)
            result = self._at_once(connection, call)
            if result is None:
                self._submit(connection, call)
        except ElpdError as error:
            connection.send(error_line(call.number, error_body(error)))
        except Exception as error:  # noqa: BLE001  (the root of a request: whatever broke, it is answered, and the others go on)
            self._log.exception("request broke", method=call.method)
            body = ErrorBody(kind="Internal", message=f"{call.method}: {error!r}; this is a defect, see the log")
            connection.send(error_line(call.number, body))
        else:
            if result is not None:
                connection.send(result_line(call.number, result))

    def _allow(self, connection: Connection, call: Call) -> None:
        if connection.stop_only and call.method not in {"stop", "cancel"}:
            raise BusyError("all places for clients are taken; this connection may `stop` and `cancel` alone")
        if operates(call.method, call.params) and not connection.operates:
            raise ForbiddenError(
                f"{call.method}: this user may look, not operate; be the daemon's user or in the group api.operators"
            )

    def _at_once(self, connection: Connection, call: Call) -> Result | None:
        match call.method:
            case "stop":
                return self._engine.stop()
            case "cancel":
                return self._engine.cancel()
            case "clear":
                return self._engine.clear()
            case "status":
                return self._engine.status()
            case "hello":
                return HelloAnswer(
                    version=__version__,
                    role="operate" if connection.operates else "observe",
                    methods=list(METHODS),
                    schema_digest=self._digest,
                )
            case "subscribe":
                return _subscribe(connection, cast("SubscribeParams", call.params))
        return None

    def _submit(self, connection: Connection, call: Call) -> None:
        if len(connection.in_flight) >= MOST_IN_FLIGHT:
            raise BusyError(f"{MOST_IN_FLIGHT} requests of this client wait for their answers already; wait for one")
        assert connection.caller is not None
        ticket = self._engine.submit(Request(call.method, call.params, connection.caller))
        number = call.number
        connection.in_flight.append(number)
        ticket.add_done_callback(lambda answer: self._answered(connection, number, answer))


def result_line(number: Number, result: Result) -> bytes:
    """Return the line that answers with a result."""
    return f'{{"id":{json.dumps(number)},"result":{result.model_dump_json()}}}\n'.encode()


def error_line(number: Number, error: ErrorBody) -> bytes:
    """Return the line that answers with an error."""
    return f'{{"id":{json.dumps(number)},"error":{error.model_dump_json()}}}\n'.encode()


def answer_line(number: Number, answer: Answer) -> bytes:
    """Return the line of a ticket's answer."""
    if answer.error is not None:
        return error_line(number, answer.error)
    assert answer.result is not None
    return result_line(number, answer.result)


def _subscribe(connection: Connection, params: SubscribeParams) -> SubscribeAnswer:
    """Set what a client is told; asking again replaces it, and an empty list ends it."""
    connection.wanted = frozenset(params.events)
    connection.decimator = Decimator(params.rate_hz) if "sample" in connection.wanted else None
    return SubscribeAnswer(subscribed=list(params.events))
