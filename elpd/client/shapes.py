"""What the daemon answers and tells, as types.

Written by ``tools/schema.py``; change ``elpd/service/messages.py`` and run that.
"""

from __future__ import annotations

from typing import Any, Literal, TypedDict


class HelloAnswer(TypedDict):
    """``hello``."""

    protocol: int
    version: str
    role: Literal["observe", "operate"]
    methods: list[str]
    schema_digest: str


class Fault(TypedDict):
    """Broken machinery, latched until ``clear``. *at_s* is the wall clock's, seconds since 1970."""

    kind: str
    message: str
    at_s: float


class LensStatus(TypedDict):
    """The lens as the engine last knew it."""

    driver: str
    position_um: float | None
    sigma_um: float | None
    moving: bool | None
    referenced: bool | None
    limits_um: list[float] | None
    connected: bool


class CameraStatus(TypedDict):
    """The camera as the engine last knew it. *events*, *lost* count since the daemon began."""

    driver: str
    width: int | None
    height: int | None
    has_frames: bool | None
    connected: bool
    events: int
    events_per_s: float | None
    lost: int
    backlog: int
    temperature_c: float | None


class ApertureStatus(TypedDict):
    """The aperture."""

    driver: str


class RoiBox(TypedDict):
    """A rectangle of sensor pixels, as JSON has it; as an answer, cut to the sensor."""

    x: int
    y: int
    width: int
    height: int


class Holder(TypedDict):
    """Who holds the lease."""

    pid: int
    uid: int
    name: str


class LeaseAnswer(TypedDict):
    """``lease``. *until_s* is how many seconds it still holds, 0 without a holder."""

    holder: Holder | None
    until_s: float


class PhaseDuration(TypedDict):
    """How long a phase of a cycle took."""

    name: str
    ms: float


class FocusAnswer(TypedDict):
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
    warnings: list[str]
    depths_um: list[float]
    details: dict[str, Any]
    truth: dict[str, float | None] | None
    run: str | None


class Warned(TypedDict):
    """Something odd that keeps nothing from working. *code* is a stable word."""

    code: str
    text: str


class Counters(TypedDict):
    """What happened since the daemon began. The last three are the socket's."""

    requests: int
    focused: int
    not_focused: dict[str, int]
    faults: int
    cancelled: int
    refused: int
    clients: int
    dropped_clients: int
    dropped_events: int


class Latency(TypedDict):
    """A stage's durations."""

    p50_us: float
    p99_us: float
    max_us: float


class Status(TypedDict):
    """Everything at a glance; a snapshot, made whole."""

    state: Literal["STARTING", "READY", "FOCUSING", "FAULT", "STOPPING"]
    mode: Literal["one-shot", "continuous", "manual", "scheduled"]
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


class CancelAnswer(TypedDict):
    """``cancel``."""

    cancelled: bool


class StopAnswer(TypedDict):
    """``stop``: the bytes have left. *was_moving* is ``None`` where the lens did not know."""

    stopped: bool
    was_moving: bool | None


class HomeAnswer(TypedDict):
    """``home``."""

    position_um: float


class MoveAnswer(TypedDict):
    """``move``, ``jog``: at rest, where it was sent or, *outcome* ``CANCELLED``, where it was stopped."""

    position_um: float
    sigma_um: float | None
    outcome: Literal["OK", "CANCELLED"]


class ClearAnswer(TypedDict):
    """``clear``: the fault that was latched, and the state now."""

    cleared: Fault | None
    state: Literal["STARTING", "READY", "FOCUSING", "FAULT", "STOPPING"]


class RoiAnswer(TypedDict):
    """``roi``: the default (``None``: proposed for each cycle) and those with names."""

    roi: RoiBox | None
    named: dict[str, RoiBox]


class Preset(TypedDict):
    """A place to come back to. *saved_at* is ISO 8601, UTC."""

    name: str
    position_um: float
    roi: RoiBox | None
    approach: Literal[-1, 0, 1]
    saved_at: str


class PresetAnswer(TypedDict):
    """``preset``; *position_um* is where the lens rests after apply."""

    presets: list[Preset]
    position_um: float | None


class ModeAnswer(TypedDict):
    """``mode``. *hold* says what the mode waits for, in numbers."""

    mode: Literal["one-shot", "continuous", "manual", "scheduled"]
    period_s: float | None
    hold: dict[str, Any]


class TemperatureAnswer(TypedDict):
    """``temperature``: the reading, and what the table makes of it from the temperature at the last focus."""

    celsius: float
    offset_um: float | None


class MapAnswer(TypedDict):
    """``map``. *sensor* has the full size; *position_um* is where the lens was."""

    kind: Literal["map", "frame", "events"]
    format: Literal["jpeg", "png", "png16"]
    width: int
    height: int
    sensor: dict[str, int]
    image: str
    age_s: float
    position_um: float | None


class SubscribeAnswer(TypedDict):
    """``subscribe``."""

    subscribed: list[Literal["sample", "phase", "result", "fault", "state", "position"]]


class RecordAnswer(TypedDict):
    """``record``."""

    path: str
    bytes: int
    events: int


class RunSummary(TypedDict):
    """One run of many. *at* is ISO 8601, UTC; *outcome* is ``None`` where an error ended it; *final_um* is at rest."""

    name: str
    at: str | None
    outcome: str | None
    reason: str | None
    focus_um: float | None
    sigma_um: float | None
    final_um: float | None
    duration_ms: float | None
    kept: bool


class RunsAnswer(TypedDict):
    """``runs``, newest first."""

    runs: list[RunSummary]


class RunAnswer(TypedDict):
    """``run``. *samples* are (position_um, elp, score, t_us), at most 2000."""

    name: str
    result: dict[str, Any] | None
    error: dict[str, Any] | None
    samples: list[list[float | int | None]]
    config: dict[str, Any]
    files: list[str]


class MetricsAnswer(TypedDict):
    """``metrics``: Prometheus' text exposition."""

    text: str


class SampleEvent(TypedDict):
    """One window of the sweep."""

    event: Literal["sample"]
    t_us: int
    position_um: float | None
    elp: int
    score: float | None
    events: int
    seq: int


class PhaseEvent(TypedDict):
    """A phase began; *progress* 0 to 1 where there is one."""

    event: Literal["phase"]
    phase: str
    progress: float | None
    seq: int


class ResultEvent(TypedDict):
    """A cycle ended, whoever asked for it."""

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
    warnings: list[str]
    depths_um: list[float]
    details: dict[str, Any]
    truth: dict[str, float | None] | None
    run: str | None
    event: Literal["result"]
    seq: int


class FaultEvent(TypedDict):
    """A fault was latched, or (``kind`` null) cleared."""

    event: Literal["fault"]
    kind: str | None
    message: str | None
    seq: int


class StateEvent(TypedDict):
    """State or mode changed."""

    event: Literal["state"]
    state: Literal["STARTING", "READY", "FOCUSING", "FAULT", "STOPPING"]
    mode: Literal["one-shot", "continuous", "manual", "scheduled"]
    seq: int


class PositionEvent(TypedDict):
    """Where the lens is; at most ten a second while it moves, and once when it has come to rest."""

    event: Literal["position"]
    position_um: float | None
    moving: bool | None
    seq: int


class DroppedEvent(TypedDict):
    """So many events were thrown away because this client did not read; the socket's own."""

    event: Literal["dropped"]
    count: int
    seq: int


class Reconnected(TypedDict):
    """The client's own: the daemon had gone, and what happened meanwhile was not told."""

    event: Literal["reconnected"]
    seq: int


Event = SampleEvent | PhaseEvent | ResultEvent | FaultEvent | StateEvent | PositionEvent | DroppedEvent | Reconnected
"""What `events` yields."""
