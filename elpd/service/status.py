"""The one answer that holds everything: where lens and camera are, what is latched, what was counted."""

from __future__ import annotations

from elpd.service.answered import Fault, FocusAnswer, LeaseAnswer, Result, StateName
from elpd.service.asked import ModeName, RoiBox  # noqa: TC001  (pydantic asks for them at run time)


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
    not_focused: dict[str, int] = {}  # noqa: RUF012  (pydantic copies it)
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
