"""The socket under clients that do as they like: valid and invalid requests, floods, half-closed and dead connections.

What must hold, whatever they do: the server lives, nothing moves that was not validly asked for, every line that was
sent by a client that still reads gets exactly one answer, and one STOP is never kept waiting.
"""

from __future__ import annotations

import json
import socket
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
from fake_engine import MOVES, FakeEngine
from from_schema import ANY_JSON, SCHEMA, params
from hypothesis import HealthCheck, settings
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, initialize, invariant, precondition, rule
from sockets import Talker

from elpd.config import ApiSection
from elpd.service.api import ApiServer
from elpd.service.lines import RefusedLine, read_call
from elpd.service.messages import FaultEvent, PhaseEvent, SampleEvent

METHODS = sorted(SCHEMA["methods"])


class Client(Talker):
    """Counts what it has asked and what it was answered."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.asked: Counter[Any] = Counter()
        self.answered: Counter[Any] = Counter()
        self.number = 0
        self.motions: set[Any] = set()
        """Numbers whose answers may be long in coming."""

    def take(self) -> dict[str, Any]:
        """Read one line and count it."""
        heard = self.hear()
        assert heard is not None, "a client that did no wrong was dropped"
        if "event" not in heard:
            assert ("result" in heard) != ("error" in heard)
            self.answered[heard["id"]] += 1
            assert self.answered[heard["id"]] <= self.asked[heard["id"]], "more answers than requests"
        return heard

    def until(self, number: object) -> dict[str, Any]:
        """Read up to the answer of a number."""
        before = self.answered[number]
        while True:
            heard = self.take()
            if self.answered[number] > before:
                return heard


class Clients(RuleBasedStateMachine):
    clients: Bundle[Client] = Bundle("clients")

    @initialize()
    def begin(self) -> None:
        self.folder = tempfile.TemporaryDirectory()
        self.path = Path(self.folder.name) / "s"
        self.engine = FakeEngine()
        self.server = ApiServer(self.engine, ApiSection(socket=self.path))
        self.server.start()
        self.open: list[Client] = []
        self.moving_asked = 0

    @rule(target=clients)
    @precondition(lambda self: len(self.open) < 8)
    def connect(self) -> Client:
        client = Client(self.path)
        self.open.append(client)
        return client

    @rule(client=clients, method=st.sampled_from(METHODS), data=st.data())
    def ask_validly(self, client: Client, method: str, data: st.DataObject) -> None:
        client.number += 1
        line = json.dumps({"id": client.number, "method": method, "params": data.draw(params(method))}).encode()
        self._say(client, client.number, line)

    @rule(client=clients, method=st.sampled_from(METHODS), asked=ANY_JSON)
    def ask_amiss(self, client: Client, method: str, asked: Any) -> None:
        client.number += 1
        self._say(client, client.number, json.dumps({"id": client.number, "method": method, "params": asked}).encode())

    @rule(
        client=clients, line=st.binary(min_size=1, max_size=80).filter(lambda line: b"\n" not in line and line.strip())
    )
    def babble(self, client: Client, line: bytes) -> None:
        self._say(client, None, line)

    @rule(client=clients, size=st.sampled_from([70_000, 200_000]))
    def go_on_for_ever(self, client: Client, size: int) -> None:
        self._say(client, None, b"x" * size)

    @rule(client=clients, count=st.integers(1, 60))
    def flood(self, client: Client, count: int) -> None:
        first = client.number + 1
        client.number += count
        numbers = range(first, client.number + 1)
        self._say(
            client, None, *[json.dumps({"id": n, "method": "metrics"}).encode() for n in numbers], counted=numbers
        )

    @rule(client=clients)
    def listen(self, client: Client) -> None:
        client.number += 1
        self._say(client, client.number, json.dumps({"id": client.number, "method": "subscribe"}).encode())

    @rule(client=clients, count=st.integers(1, 30))
    def read(self, client: Client, count: int) -> None:
        waits = sum(client.answered[number] < client.asked[number] for number in client.motions)
        for _ in range(min(count, sum(client.asked.values()) - sum(client.answered.values()) - waits)):
            client.take()

    @rule(client=clients, urgent=st.sampled_from(["stop", "cancel"]))
    def stop(self, client: Client, urgent: str) -> None:
        client.number += 1
        client.asked[client.number] += 1
        client.say({"id": client.number, "method": urgent})
        answer = client.until(client.number)
        assert "result" in answer
        assert all(ticket.answer is not None for ticket in self.engine.accepted)

    @rule(client=consumes(clients), how=st.sampled_from(["close", "half", "reset"]))
    def die(self, client: Client, how: str) -> None:
        self.open.remove(client)
        if how == "half":
            client.socket.shutdown(socket.SHUT_WR)
        if how == "reset":
            client.socket.sendall(b'{"id": 1, "meth')
        client.close()

    @rule(tell=st.sampled_from([PhaseEvent(phase="sweep"), FaultEvent(kind=None)]), samples=st.integers(0, 30))
    def tell(self, tell: Any, samples: int) -> None:
        for number in range(samples):
            self.engine.tell(SampleEvent(t_us=1000 * number, position_um=None, elp=1, score=None, events=1))
        self.engine.tell(tell)

    @rule()
    def finish(self) -> None:
        if self.engine.accepted:
            self.engine.finish()

    @invariant()
    def nothing_moves_unasked(self) -> None:
        if hasattr(self, "engine"):
            assert len(self.engine.accepted) <= self.moving_asked

    def teardown(self) -> None:
        """Whatever happened: it still answers, and all that was asked by those who live is answered once."""
        if not hasattr(self, "server"):
            return
        with Client(self.path) as last:
            last.asked["last"] += 1
            last.say({"id": "last", "method": "stop"})
            assert last.until("last")["result"]["stopped"]
        for client in self.open:
            while client.answered != client.asked:
                client.take()
            client.close()
        self.server.stop()
        assert len(self.engine.departed) == len({caller.connection for caller in self.engine.departed})
        self.folder.cleanup()

    def _say(self, client: Client, number: object, *lines: bytes, counted: Any = None) -> None:
        for one in [number] if counted is None else counted:
            client.asked[one] += 1
        for line in lines:
            try:
                moves = read_call(line).method in MOVES
            except RefusedLine as refused:
                if number is not None and refused.number != number:
                    client.asked[number] -= 1
                    client.asked[refused.number] += 1
                continue
            if moves:
                self.moving_asked += 1
                client.motions.add(number)
        client.say(*lines)


Clients.TestCase.settings = settings(
    max_examples=25, stateful_step_count=25, deadline=None, suppress_health_check=list(HealthCheck)
)
TestClients = Clients.TestCase
