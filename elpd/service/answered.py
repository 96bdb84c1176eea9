"""What is answered on the socket.

Answers may grow; whoever reads them ignores what it does not know. Lengths in um on the lens's ruler, times in the unit
that the name says, ``None`` where something is unknown.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from elpd.service.asked import EventName, ModeName, RoiBox  # noqa: TC001  (pydantic asks for them at run time)

PROTOCOL = 1


class Result(BaseModel):
    """What a method answers, or a part of it."""

    model_config = ConfigDict(frozen=True)


class ErrorBody(Result):
    """Why a request was not done. *kind* is a stable word; *message* says what, measured value, limit, next step."""

    kind: str
    message: str


class HelloAnswer(Result):
    """``hello``."""

    protocol: int = PROTOCOL
    version: str
    role: Literal["observe", "operate"]
    methods: list[str]
    schema_digest: str


class PhaseDuration(Result):
    """How long a phase of a cycle took."""

    name: str
    ms: float


class FocusAnswer(Result):
    """How a cycle ended: what `elpd focus --json` prints. *run* is the run's name, *truth* a simulator's."""

    outcome: str
    reason: str
    reversals: int
    focus_um: float | None
    sigma_um: float | None
    stop_um: float | None
    final_um: float | None
    stop_latency_us: int | None
    duration_ms: float
    phases: list[PhaseDuration]
    events: int
    lost: int
    warnings: list[str] = []
    depths_um: list[float] = []
    details: dict[str, Any] = {}
    truth: dict[str, float | None] | None = None
    run: str | None = None


class CancelAnswer(Result):
    """``cancel``."""

    cancelled: bool


class StopAnswer(Result):
    """``stop``: the bytes have left. *was_moving* is ``None`` where the lens did not know."""

    stopped: bool = True
    was_moving: bool | None


class HomeAnswer(Result):
    """``home``."""

    position_um: float


class MoveAnswer(Result):
    """``move``, ``jog``: at rest, where it was sent or, *outcome* ``CANCELLED``, where it was stopped."""

    position_um: float
    sigma_um: float | None
    outcome: Literal["OK", "CANCELLED"] = "OK"


class Fault(Result):
    """Broken machinery, latched until ``clear``. *at_s* is the wall clock's, seconds since 1970."""

    kind: str
    message: str
    at_s: float


StateName = Literal["STARTING", "READY", "FOCUSING", "FAULT", "STOPPING"]


class ClearAnswer(Result):
    """``clear``: the fault that was latched, and the state now."""

    cleared: Fault | None
    state: StateName


class RoiAnswer(Result):
    """``roi``: the default (``None``: proposed for each cycle) and those with names."""

    roi: RoiBox | None
    named: dict[str, RoiBox]


class Preset(Result):
    """A place to come back to. *saved_at* is ISO 8601, UTC."""

    name: str
    position_um: float
    roi: RoiBox | None = None
    approach: Literal[-1, 0, 1] = 0
    """From which side the lens came to it: towards smaller positions, unknown, towards larger ones."""
    saved_at: str


class PresetAnswer(Result):
    """``preset``; *position_um* is where the lens rests after apply."""

    presets: list[Preset]
    position_um: float | None = None


class ModeAnswer(Result):
    """``mode``. *hold* says what the mode waits for, in numbers."""

    mode: ModeName
    period_s: float | None
    hold: dict[str, Any]


class TemperatureAnswer(Result):
    """``temperature``: the reading, and what the table makes of it from the temperature at the last focus."""

    celsius: float
    offset_um: float | None


class Holder(Result):
    """Who holds the lease."""

    pid: int
    uid: int
    name: str


class LeaseAnswer(Result):
    """``lease``. *until_s* is how many seconds it still holds, 0 without a holder."""

    holder: Holder | None
    until_s: float


class MapAnswer(Result):
    """``map``. *sensor* has the full size; *position_um* is where the lens was."""

    kind: Literal["map", "frame", "events"]
    format: Literal["jpeg", "png", "png16"]
    width: int
    height: int
    sensor: dict[Literal["width", "height"], int]
    image: str
    age_s: float
    position_um: float | None


class SubscribeAnswer(Result):
    """``subscribe``."""

    subscribed: list[EventName]


class RecordAnswer(Result):
    """``record``."""

    path: str
    bytes: int
    events: int


class RunSummary(Result):
    """One run of many. *at* is ISO 8601, UTC; *outcome* is ``None`` where an error ended it; *final_um* is at rest."""

    name: str
    at: str | None
    outcome: str | None
    reason: str | None
    focus_um: float | None
    sigma_um: float | None
    final_um: float | None = None
    duration_ms: float | None
    kept: bool


class RunsAnswer(Result):
    """``runs``, newest first."""

    runs: list[RunSummary]


class RunAnswer(Result):
    """``run``. *samples* are (position_um, elp, score, t_us), at most 2000."""

    name: str
    result: dict[str, Any] | None
    error: dict[str, Any] | None = None
    samples: list[tuple[float | None, int, float | None, int]]
    config: dict[str, Any]
    files: list[str]


class MetricsAnswer(Result):
    """``metrics``: Prometheus' text exposition."""

    text: str
