"""What is known now: mutable behind one lock, read as one immutable ``Status``; whoever listens hears the changes.

Writers are the focus thread (lens, camera, results), the socket's thread (leases, regions) and the supervisor. Nobody
holds the lock while doing anything slow, and no listener is called under it.
"""

from __future__ import annotations

import os
import resource
import threading
import time
from typing import TYPE_CHECKING, Any

from elpd import __version__
from elpd.service.latency import Stages
from elpd.service.messages import (
    ApertureStatus,
    CameraStatus,
    Counters,
    Fault,
    FaultEvent,
    LeaseAnswer,
    LensStatus,
    PositionEvent,
    ResultEvent,
    StateEvent,
    Status,
    Warned,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.config import Config
    from elpd.service.messages import Event, FocusAnswer, ModeName, RoiBox, StateName

POSITION_EVERY_S = 0.1
"""How often listeners hear of a moving lens, at most."""


class Situation:
    """The engine's knowledge of itself and its rig.

    Parameters
    ----------
    config
        For the names of the drivers.
    now_s
        The engine's time.
    """

    def __init__(self, config: Config, now_s: Callable[[], float]) -> None:
        self._lock = threading.RLock()
        self._now_s = now_s
        self._begun_s = now_s()
        self._listeners: list[Callable[[Event], None]] = []
        self._ready = self._stopping = self._focusing = False
        self._fault: Fault | None = None
        self._mode: ModeName = config.modes.start
        self._phase: str | None = None
        self._roi: RoiBox | None = None
        self._last: FocusAnswer | None = None
        self._warnings: dict[str, Warned] = {}
        self._told: tuple[StateName, ModeName] = ("STARTING", self._mode)
        self._position_told_s = float("-inf")
        self._told_moving: bool | None = None
        self.stages = Stages()
        """Durations by stage."""
        self.configured(config)
        self._counters = Counters()

    def configured(self, config: Config) -> None:
        """Take the names of the drivers from a configuration."""
        simulated = config.rig == "sim"
        with self._lock:
            self._rig = config.rig
            self._lens = LensStatus(driver=f"sim {config.sim.board}" if simulated else config.lens.driver)
            self._camera = CameraStatus(driver=f"sim {config.sim.camera}" if simulated else config.camera.driver)
            aperture = config.aperture.driver
            self._aperture = None if aperture == "none" else ApertureStatus(driver=aperture)

    # --- reading -----------------------------------------------------------------------------------------------------

    @property
    def state(self) -> StateName:
        """The one word for all of it."""
        if self._stopping:
            return "STOPPING"
        if self._fault is not None:
            return "FAULT"
        if not self._ready:
            return "STARTING"
        return "FOCUSING" if self._focusing else "READY"

    @property
    def fault(self) -> Fault | None:
        """What is latched."""
        return self._fault

    @property
    def lens(self) -> LensStatus:
        """The lens as it was last known."""
        return self._lens

    @property
    def camera(self) -> CameraStatus:
        """The camera as it was last known."""
        return self._camera

    @property
    def last(self) -> FocusAnswer | None:
        """How the last cycle ended."""
        return self._last

    def snapshot(self, lease: LeaseAnswer, ticks: dict[str, float]) -> Status:
        """Return everything, as it is at one instant."""
        with self._lock:
            return Status(
                state=self.state,
                mode=self._mode,
                phase=self._phase,
                fault=self._fault,
                lens=self._lens,
                camera=self._camera,
                aperture=self._aperture,
                roi=self._roi,
                lease=lease,
                last=self._last,
                warnings=list(self._warnings.values()),
                counters=self._counters,
                latency=self.stages.summary(),
                ticks=ticks,
                uptime_s=self._now_s() - self._begun_s,
                rss_mb=_rss_mb(),
                version=__version__,
                rig=self._rig,
            )

    # --- writing -----------------------------------------------------------------------------------------------------

    def began(self) -> None:
        """Say that everything is open and compiled."""
        with self._lock:
            self._ready = True
        self._tell_state()

    def stopping(self) -> None:
        """Say that the daemon is going down."""
        with self._lock:
            self._stopping = True
        self._tell_state()

    def focusing(self, *, on: bool) -> None:
        """Say whether a cycle is under way."""
        with self._lock:
            self._focusing = on
        self._tell_state()

    def set_mode(self, mode: ModeName) -> None:
        """Another mode."""
        with self._lock:
            self._mode = mode
        self._tell_state()

    def set_phase(self, phase: str | None) -> None:
        """Say what is being done."""
        with self._lock:
            self._phase = phase

    def set_roi(self, roi: RoiBox | None) -> None:
        """Another default region."""
        with self._lock:
            self._roi = roi

    def latch(self, kind: str, message: str) -> bool:
        """Latch a fault; the first one stays. Says whether this was it."""
        with self._lock:
            if self._fault is not None:
                return False
            self._fault = Fault(kind=kind, message=message, at_s=time.time())
            self._counters = self._counters.model_copy(update={"faults": self._counters.faults + 1})
        self.tell(FaultEvent(kind=kind, message=message))
        self._tell_state()
        return True

    def clear(self) -> Fault | None:
        """Forget the fault; return it."""
        with self._lock:
            fault, self._fault = self._fault, None
        if fault is not None:
            self.tell(FaultEvent(kind=None))
            self._tell_state()
        return fault

    def update_lens(self, **known: Any) -> None:
        """Take what is known of the lens; listeners hear of its place."""
        with self._lock:
            self._lens = lens = self._lens.model_copy(update=known)
            now_s = self._now_s()
            came_to_rest = self._told_moving is True and lens.moving is False
            if not came_to_rest and (not lens.moving or now_s - self._position_told_s < POSITION_EVERY_S):
                return
            self._position_told_s, self._told_moving = now_s, lens.moving
        self.tell(PositionEvent(position_um=lens.position_um, moving=lens.moving))

    def update_camera(self, **known: Any) -> None:
        """Take what is known of the camera."""
        with self._lock:
            self._camera = self._camera.model_copy(update=known)

    def heard(self, events: int, lost: int, **known: Any) -> None:
        """Count events and losses, and take what else is known of the camera."""
        with self._lock:
            camera = self._camera
            counts = {"events": camera.events + events, "lost": camera.lost + lost}
            self._camera = camera.model_copy(update={**counts, **known})

    def ended(self, last: FocusAnswer) -> None:
        """Count and tell the end of a cycle."""
        with self._lock:
            self._last = last
            counters = self._counters
            if last.outcome == "FOCUSED":
                self._counters = counters.model_copy(update={"focused": counters.focused + 1})
            else:
                others = {**counters.not_focused, last.outcome: counters.not_focused.get(last.outcome, 0) + 1}
                self._counters = counters.model_copy(update={"not_focused": others})
        self.tell(ResultEvent(**dict(last)))

    def count(self, **more: int) -> None:
        """Add to counters."""
        with self._lock:
            counters = self._counters
            self._counters = counters.model_copy(update={key: getattr(counters, key) + by for key, by in more.items()})

    def set_counts(self, **counts: int) -> None:
        """Replace counters that somebody else keeps."""
        with self._lock:
            self._counters = self._counters.model_copy(update=counts)

    def warn(self, code: str, text: str) -> None:
        """Say that something is odd, until ``unwarn``."""
        with self._lock:
            self._warnings[code] = Warned(code=code, text=text)

    def unwarn(self, code: str) -> None:
        """Take a warning back."""
        with self._lock:
            self._warnings.pop(code, None)

    # --- listeners ---------------------------------------------------------------------------------------------------

    def listen(self, listener: Callable[[Event], None]) -> Callable[[], None]:
        """Tell *listener* what happens from now on; returns what ends it."""
        with self._lock:
            self._listeners = [*self._listeners, listener]

        def leave() -> None:
            with self._lock:
                self._listeners = [one for one in self._listeners if one is not listener]

        return leave

    def tell(self, event: Event) -> None:
        """Tell everybody."""
        for listener in self._listeners:
            listener(event)

    def _tell_state(self) -> None:
        with self._lock:
            now = (self.state, self._mode)
            if now == self._told:
                return
            self._told = now
        self.tell(StateEvent(state=now[0], mode=now[1]))


def _rss_mb() -> float:
    """Return the resident set now (Linux), else its peak."""
    try:
        with open("/proc/self/statm", "rb") as file:  # noqa: PTH123  (asked ten times a second)
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
