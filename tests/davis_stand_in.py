"""A camera of dv-processing that is not there: it hands out what it was given, in the library's own types."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

import pytest
from elpd_drivers.cameras.davis import DavisSettings, DavisSource

if TYPE_CHECKING:
    from collections.abc import Iterable

dv = pytest.importorskip("dv_processing")

EPOCH_US = 1_795_388_665_467_217


class Camera:
    """Whatever is set is noted; whatever is asked for next is what the test put there."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self.said: dict[str, Any] = {}
        self.batches: dict[str, deque[Any]] = {name: deque() for name in ("Event", "Frame", "Imu", "Trigger")}
        self.running = True

    def __getattr__(self, name: str) -> Any:
        if name.startswith("set") and hasattr(self._model, name):
            return lambda *values: self.said.update({name.removeprefix("set"): values})
        kind = name.removeprefix("getNext").removesuffix("Batch")
        if kind in self.batches:
            return lambda: self.batches[kind].popleft() if self.batches[kind] else None
        answers = {
            "isRunning": lambda: self.running,
            "getEventResolution": lambda: (346, 260),
            "getCameraName": lambda: "DAVIS346_00000499",
            "getSerialNumber": lambda: "00000499",
            "getDavis346BiasCoarseFine": lambda _: (4, 39),
        }
        if name not in answers:
            raise AttributeError(name)
        return answers[name]


def source(model: Any = dv.io.camera.DAVIS, **settings: Any) -> tuple[DavisSource, Camera]:
    """Open a stand-in for one of the library's cameras, which can be told what that one can be told."""
    camera = Camera(model)
    return DavisSource(camera, dv, DavisSettings.model_validate(settings)), camera


def store(events: Iterable[tuple[int, int, int, bool]]) -> Any:
    made = dv.EventStore()
    for event in events:
        made.push_back(*event)
    return made
