"""What the socket tells unasked, to whoever has subscribed. ``seq`` is added by the socket, per client."""

from __future__ import annotations

from typing import Literal

from elpd.service.answered import FocusAnswer, Result, StateName
from elpd.service.asked import ModeName  # noqa: TC001  (pydantic asks for it at run time)


class SampleEvent(Result):
    """One window of the sweep."""

    event: Literal["sample"] = "sample"
    t_us: int
    position_um: float | None
    elp: int
    score: float | None
    events: int


class PhaseEvent(Result):
    """A phase began; *progress* 0 to 1 where there is one."""

    event: Literal["phase"] = "phase"
    phase: str
    progress: float | None = None


class ResultEvent(FocusAnswer):
    """A cycle ended, whoever asked for it."""

    event: Literal["result"] = "result"


class FaultEvent(Result):
    """A fault was latched, or (``kind`` null) cleared."""

    event: Literal["fault"] = "fault"
    kind: str | None
    message: str | None = None


class StateEvent(Result):
    """State or mode changed."""

    event: Literal["state"] = "state"
    state: StateName
    mode: ModeName


class PositionEvent(Result):
    """Where the lens is; at most ten a second while it moves, and once when it has come to rest."""

    event: Literal["position"] = "position"
    position_um: float | None
    moving: bool | None


class DroppedEvent(Result):
    """So many events were thrown away because this client did not read; the socket's own."""

    event: Literal["dropped"] = "dropped"
    count: int


Event = SampleEvent | PhaseEvent | ResultEvent | FaultEvent | StateEvent | PositionEvent
"""What an engine tells its listeners. ``seq`` is the socket's, per client."""
