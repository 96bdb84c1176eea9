"""Every message of the socket in one place: methods with what they take and answer, and who may call which.

JSON is made with ``model_dump_json`` alone: it turns what JSON cannot hold (NaN) into ``null``.
"""

from __future__ import annotations

import hashlib
import json
from typing import Final

from elpd.service.answered import (
    PROTOCOL,
    CancelAnswer,
    ClearAnswer,
    ErrorBody,
    Fault,
    FocusAnswer,
    HelloAnswer,
    Holder,
    HomeAnswer,
    LeaseAnswer,
    MapAnswer,
    MetricsAnswer,
    ModeAnswer,
    MoveAnswer,
    PhaseDuration,
    Preset,
    PresetAnswer,
    RecordAnswer,
    Result,
    RoiAnswer,
    RunAnswer,
    RunsAnswer,
    RunSummary,
    StateName,
    StopAnswer,
    SubscribeAnswer,
    TemperatureAnswer,
)
from elpd.service.asked import (
    EventName,
    FocusParams,
    JogParams,
    LeaseParams,
    MapParams,
    ModeName,
    ModeParams,
    MoveParams,
    Name,
    Params,
    PresetParams,
    RecordParams,
    RoiBox,
    RoiParams,
    RunParams,
    RunsParams,
    SubscribeParams,
    TemperatureParams,
)
from elpd.service.status import (
    ApertureStatus,
    CameraStatus,
    Counters,
    Latency,
    LensStatus,
    Status,
    Warned,
)
from elpd.service.told import (
    DroppedEvent,
    Event,
    FaultEvent,
    PhaseEvent,
    PositionEvent,
    ResultEvent,
    SampleEvent,
    StateEvent,
)

__all__ = [
    "ANSWERS",
    "LEASE_FREE",
    "METHODS",
    "OBSERVING",
    "PROTOCOL",
    "ApertureStatus",
    "CameraStatus",
    "CancelAnswer",
    "ClearAnswer",
    "Counters",
    "DroppedEvent",
    "ErrorBody",
    "Event",
    "EventName",
    "Fault",
    "FaultEvent",
    "FocusAnswer",
    "FocusParams",
    "HelloAnswer",
    "Holder",
    "HomeAnswer",
    "JogParams",
    "Latency",
    "LeaseAnswer",
    "LeaseParams",
    "LensStatus",
    "MapAnswer",
    "MapParams",
    "MetricsAnswer",
    "ModeAnswer",
    "ModeName",
    "ModeParams",
    "MoveAnswer",
    "MoveParams",
    "Name",
    "Params",
    "PhaseDuration",
    "PhaseEvent",
    "PositionEvent",
    "Preset",
    "PresetAnswer",
    "PresetParams",
    "RecordAnswer",
    "RecordParams",
    "Result",
    "ResultEvent",
    "RoiAnswer",
    "RoiBox",
    "RoiParams",
    "RunAnswer",
    "RunParams",
    "RunSummary",
    "RunsAnswer",
    "RunsParams",
    "SampleEvent",
    "StateEvent",
    "StateName",
    "Status",
    "StopAnswer",
    "SubscribeAnswer",
    "SubscribeParams",
    "TemperatureAnswer",
    "TemperatureParams",
    "Warned",
    "operates",
    "schema_digest",
]

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
