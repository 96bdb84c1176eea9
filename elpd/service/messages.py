"""Every message of the socket, as types: what may be asked, what is answered, what is told unasked.

Parameters refuse keys that they do not know: a misspelt ``dry_run`` must not move a lens. Answers may grow; whoever
reads them ignores what it does not know. Lengths in um on the lens's ruler, times in the unit that the name says,
``None`` where something is unknown. JSON is made with ``model_dump_json`` alone: it turns what JSON cannot hold (NaN)
into ``null``.
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

PROTOCOL: Final = 1

Name = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[\w.-]+( [\w.-]+)*$")]
"""A preset's or region's name: words of letters, digits, ``_.-``."""

Finite = Annotated[float, Field(allow_inf_nan=False)]


class Params(BaseModel):
    """What a method takes: nothing, unless a subclass says more."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Result(BaseModel):
    """What a method answers, or a part of it."""

    model_config = ConfigDict(frozen=True)


class RoiBox(Params):
    """A rectangle of sensor pixels, as JSON has it; as an answer, cut to the sensor."""

    x: int
    y: int
    width: int
    height: int


# --- what may be asked -------------------------------------------------------------------------------------------


class FocusParams(Params):
    """``focus``. A *preset* is where the lens starts from, and its region, unless *roi* is given."""

    roi: RoiBox | None = None
    reference: str | None = None
    preset: Name | None = None
    dry_run: bool = False
    on_disconnect: Literal["finish", "cancel"] = "finish"


class MoveParams(Params):
    """``move``: to a place, or to a fraction of the travel."""

    to_um: Finite | None = None
    fraction: Annotated[float, Field(ge=0, le=1)] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> MoveParams:
        if (self.to_um is None) == (self.fraction is None):
            raise ValueError("give to_um or fraction, one of both")
        return self


class JogParams(Params):
    """``jog``."""

    by_um: Finite


class RoiParams(Params):
    """``roi``: nothing given reads; *set* (``null``: proposed from then on) writes the default or the one of *name*."""

    set: RoiBox | None = None
    name: Name | None = None
    delete: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> RoiParams:
        if self.delete and (self.name is None or "set" in self.model_fields_set):
            raise ValueError("delete takes a name and nothing else")
        return self


class PresetParams(Params):
    """``preset``."""

    action: Literal["list", "save", "apply", "delete"]
    name: Name | None = None

    @model_validator(mode="after")
    def _named(self) -> PresetParams:
        if (self.action == "list") != (self.name is None):
            raise ValueError("save, apply and delete take a name, list takes none")
        return self


ModeName = Literal["one-shot", "continuous", "manual", "scheduled"]


class ModeParams(Params):
    """``mode``: nothing given reads. *period_s* is the scheduled mode's."""

    mode: ModeName | None = None
    period_s: Annotated[float, Field(ge=1, le=604_800)] | None = None


class TemperatureParams(Params):
    """``temperature``: what a sensor near the lens reads."""

    celsius: Annotated[float, Field(ge=-80, le=200)]


class LeaseParams(Params):
    """``lease``: *seconds* from now, for acquire and renew."""

    action: Literal["acquire", "renew", "release"]
    seconds: Annotated[float, Field(gt=0, le=3600)] = 30.0


class MapParams(Params):
    """``map``: a picture. ``latest`` is the newest of all kinds."""

    kind: Literal["latest", "map", "frame", "events"] = "latest"
    format: Literal["jpeg", "png", "png16"] = "jpeg"
    max_width: Annotated[int, Field(ge=16, le=8192)] | None = None


EventName = Literal["sample", "phase", "result", "fault", "state", "position"]


class SubscribeParams(Params):
    """``subscribe``. *rate_hz* bounds the samples alone."""

    events: tuple[EventName, ...] = ("sample", "phase", "result", "fault", "state", "position")
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 60.0


class RecordParams(Params):
    """``record``: events from the camera, the lens at rest."""

    seconds: Annotated[float, Field(gt=0, le=3600)]
    name: Name | None = None


class RunsParams(Params):
    """``runs``."""

    limit: Annotated[int, Field(ge=1, le=1000)] = 20


class RunParams(Params):
    """``run``."""

    name: Annotated[str, Field(pattern=r"^[\w-]{1,64}$")]


METHODS: Final[dict[str, type[Params]]] = {
    "hello": Params,
    "status": Params,
    "focus": FocusParams,
    "cancel": Params,
    "stop": Params,
    "home": Params,
    "move": MoveParams,
    "jog": JogParams,
    "clear": Params,
    "roi": RoiParams,
    "preset": PresetParams,
    "mode": ModeParams,
    "temperature": TemperatureParams,
    "lease": LeaseParams,
    "map": MapParams,
    "subscribe": SubscribeParams,
    "record": RecordParams,
    "runs": RunsParams,
    "run": RunParams,
    "metrics": Params,
}
"""Every method and what it takes."""

OBSERVING: Final = frozenset({"hello", "status", "map", "subscribe", "runs", "run", "metrics"})
"""Methods that whoever can open the socket may call. ``operates`` says which of the others are asked for what."""

LEASE_FREE: Final = frozenset({"cancel", "stop", "lease"})
"""Operating methods that a lease of somebody else never keeps back."""


def operates(method: str, params: Params) -> bool:
    """Say whether a call changes anything: reading a region, a mode or the presets does not."""
    if isinstance(params, RoiParams | ModeParams) and not params.model_fields_set:
        return False
    if isinstance(params, PresetParams) and params.action == "list":
        return False
    return method not in OBSERVING


# --- what is answered --------------------------------------------------------------------------------------------


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
    """One run of many. *at* is ISO 8601, UTC; *outcome* is ``None`` where an error ended it."""

    name: str
    at: str | None
    outcome: str | None
    reason: str | None
    focus_um: float | None
    sigma_um: float | None
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


# --- status ------------------------------------------------------------------------------------------------------


class LensStatus(Result):
    """The lens as the engine last knew it."""

    driver: str
    position_um: float | None = None
    sigma_um: float | None = None
    moving: bool | None = None
    referenced: bool | None = None
    limits_um: tuple[float, float] | None = None
    connected: bool = False


class CameraStatus(Result):
    """The camera as the engine last knew it. *events*, *lost* count since the daemon began."""

    driver: str
    width: int | None = None
    height: int | None = None
    has_frames: bool | None = None
    connected: bool = False
    events: int = 0
    events_per_s: float | None = None
    lost: int = 0
    backlog: int = 0
    temperature_c: float | None = None


class ApertureStatus(Result):
    """The aperture."""

    driver: str


class Warned(Result):
    """Something odd that keeps nothing from working. *code* is a stable word."""

    code: str
    text: str


class Counters(Result):
    """What happened since the daemon began. The last three are the socket's."""

    requests: int = 0
    focused: int = 0
    not_focused: dict[str, int] = {}
    faults: int = 0
    cancelled: int = 0
    refused: int = 0
    clients: int = 0
    dropped_clients: int = 0
    dropped_events: int = 0


class Latency(Result):
    """A stage's durations."""

    p50_us: float
    p99_us: float
    max_us: float


class Status(Result):
    """Everything at a glance; a snapshot, made whole."""

    state: StateName
    mode: ModeName
    phase: str | None
    fault: Fault | None
    lens: LensStatus
    camera: CameraStatus
    aperture: ApertureStatus | None
    roi: RoiBox | None
    lease: LeaseAnswer
    last: FocusAnswer | None
    warnings: list[Warned]
    counters: Counters
    latency: dict[str, Latency]
    ticks: dict[str, float]
    uptime_s: float
    rss_mb: float
    version: str
    rig: str


# --- what is told unasked ----------------------------------------------------------------------------------------


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


ANSWERS: Final[dict[str, type[Result]]] = {
    "hello": HelloAnswer,
    "status": Status,
    "focus": FocusAnswer,
    "cancel": CancelAnswer,
    "stop": StopAnswer,
    "home": HomeAnswer,
    "move": MoveAnswer,
    "jog": MoveAnswer,
    "clear": ClearAnswer,
    "roi": RoiAnswer,
    "preset": PresetAnswer,
    "mode": ModeAnswer,
    "temperature": TemperatureAnswer,
    "lease": LeaseAnswer,
    "map": MapAnswer,
    "subscribe": SubscribeAnswer,
    "record": RecordAnswer,
    "runs": RunsAnswer,
    "run": RunAnswer,
    "metrics": MetricsAnswer,
}
"""Every method and what it answers."""


def schema_digest() -> str:
    """Return a word that changes whenever a message's shape does."""
    told: tuple[type[Result], ...] = (
        SampleEvent, PhaseEvent, ResultEvent, FaultEvent, StateEvent, PositionEvent, DroppedEvent,
    )  # fmt: skip
    shapes = {
        "methods": {name: [METHODS[name].model_json_schema(), ANSWERS[name].model_json_schema()] for name in METHODS},
        "events": [model.model_json_schema() for model in told],
    }
    return hashlib.sha3_224(json.dumps(shapes, sort_keys=True).encode("ascii")).hexdigest()[:12]
