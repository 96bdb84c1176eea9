"""An engine for the socket's tests: it moves nothing, remembers everything, and answers when it is told to."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from elpd.errors import BusyError
from elpd.service.engine_port import Answer, Caller, ClientCounts, Request
from elpd.service.messages import (
    CameraStatus,
    CancelAnswer,
    ClearAnswer,
    Counters,
    FocusAnswer,
    LeaseAnswer,
    LensStatus,
    MetricsAnswer,
    MoveAnswer,
    Params,
    Result,
    Status,
    StopAnswer,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.service.messages import Event

MOVES = frozenset({"focus", "home", "move", "jog"})


def focus_answer(outcome: str = "FOCUSED") -> FocusAnswer:
    return FocusAnswer(
        outcome=outcome, reason="so it was told", reversals=0, focus_um=812.5, sigma_um=0.4, stop_um=830.0,
        final_um=812.6, stop_latency_us=900, duration_ms=103.0, phases=[], events=1234, lost=0, run="20260101-1",
    )  # fmt: skip


@dataclass
class FakeTicket:
    request: Request
    answer: Answer | None = None
    done: list[Callable[[Answer], None]] = field(default_factory=list)

    def cancel(self) -> bool:
        return self.finish(Answer(focus_answer("CANCELLED")))

    def add_done_callback(self, done: Callable[[Answer], None], /) -> None:
        self.done.append(done)
        if self.answer is not None:
            done(self.answer)

    def finish(self, answer: Answer) -> bool:
        if self.answer is not None:
            return False
        self.answer = answer
        for done in self.done:
            done(answer)
        return True


class FakeEngine:
    """Answers ``metrics`` at once; a motion is accepted if none runs, and ends when the test says so."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.requests: list[Request] = []
        self.accepted: list[FakeTicket] = []
        self.waiting: list[FakeTicket] = []
        self.departed: list[Caller] = []
        self.changes: dict[str, Any] = {}
        """What the status says otherwise than usual."""
        self.answers: dict[str, Result] = {}
        """What is answered to methods by name."""
        self.patient = False
        """Whether to answer nothing before the test says so."""
        self.beats = 0
        self.counts = ClientCounts()
        self.listeners: list[Callable[[Event], None]] = []
        self._changed = threading.Condition()

    def status(self) -> Status:
        status = Status(
            state="READY", mode="one-shot", phase=None, fault=None, lens=LensStatus(driver="fake"),
            camera=CameraStatus(driver="fake"), aperture=None, roi=None, lease=LeaseAnswer(holder=None, until_s=0.0),
            last=None, warnings=[], counters=Counters(clients=self.counts.clients), latency={}, ticks={}, uptime_s=1.0,
            rss_mb=1.0, version="0", rig="fake",
        )  # fmt: skip
        return status.model_copy(update=self.changes)

    def submit(self, request: Request) -> FakeTicket:
        ticket = FakeTicket(request)
        self.requests.append(request)
        if request.method in MOVES:
            if any(other.answer is None for other in self.accepted):
                raise BusyError("something runs")
            self.accepted.append(ticket)
        elif self.patient:
            self.waiting.append(ticket)
        elif request.method in self.answers:
            ticket.finish(Answer(self.answers[request.method]))
        else:
            ticket.finish(Answer(MetricsAnswer(text="elpd_up 1\n")))
        self._note(request.method)
        return ticket

    def stop(self) -> StopAnswer:
        self._note("stop")
        return StopAnswer(was_moving=self.cancel().cancelled)

    def cancel(self) -> CancelAnswer:
        cancelled = CancelAnswer(cancelled=sum(ticket.cancel() for ticket in self.accepted) > 0)
        self._note("cancel")
        return cancelled

    def clear(self) -> ClearAnswer:
        return ClearAnswer(cleared=None, state="READY")

    def listen(self, listener: Callable[[Event], None]) -> Callable[[], None]:
        self.listeners.append(listener)
        return lambda: self.listeners.remove(listener)

    def gone(self, caller: Caller) -> None:
        self.departed.append(caller)
        self._note("gone")

    def beat(self, loop: str) -> None:
        assert loop == "api"
        self.beats += 1
        self._note("beat")

    def note_clients(self, counts: ClientCounts) -> None:
        self.counts = counts
        self._note("counted")

    def begin(self, method: str) -> None:
        """Let something run that no client has asked for."""
        self.submit(Request(method, Params(), Caller(0, 0, 0, "")))

    # --- for the test ---------------------------------------------------------------------------------------------

    def tell(self, event: Event) -> None:
        for listener in self.listeners:
            listener(event)

    def finish(self, outcome: str = "FOCUSED") -> None:
        ticket = self.accepted[-1]
        moved = MoveAnswer(position_um=10.0, sigma_um=0.1)
        ticket.finish(Answer(focus_answer(outcome) if ticket.request.method == "focus" else moved))

    def finish_all(self) -> None:
        """Answer what was asked and waits, in that order."""
        for ticket in self.waiting:
            ticket.finish(Answer(MetricsAnswer(text="elpd_up 1\n")))

    def heard(self, what: Callable[[], bool], limit_s: float = 30.0) -> None:
        """Wait until the engine has heard what the test waits for."""
        with self._changed:
            assert self._changed.wait_for(what, limit_s), f"not heard within {limit_s:g} s"

    def _note(self, what: str) -> None:
        with self._changed:
            self.calls.append(what)
            self._changed.notify_all()
