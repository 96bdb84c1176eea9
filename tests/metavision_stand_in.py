"""The Metavision hardware layer's Python bindings, as far as our backend knows them: their names and types."""

from __future__ import annotations

import types
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
from elpd_drivers.cameras import metavision
from elpd_drivers.cameras.metavision import MetavisionSettings, MetavisionSource

if TYPE_CHECKING:
    from collections.abc import Callable

EDGES = np.dtype({"names": ["p", "t", "id"], "formats": ["<i2", "<i8", "<i2"], "offsets": [0, 8, 16], "itemsize": 24})
HAL = types.SimpleNamespace(
    I_ROI=types.SimpleNamespace(Window=lambda *window: ("window", *window)),
    I_TriggerIn=types.SimpleNamespace(Channel=types.SimpleNamespace(MAIN="main")),
)


class Said:
    """A facility: what it is told is noted, what it is asked is answered from what the test gave."""

    def __init__(self, **answers: Any) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self._answers = answers

    def __getattr__(self, name: str) -> Any:
        if name in self._answers:
            return lambda *_: self._answers[name]
        return lambda *values: self.calls.append((name, *values))


class Device:
    """A buffer is (last time, events, edges); a number instead ends the stream."""

    def __init__(self, *buffers: Any, missing: tuple[str, ...] = ()) -> None:
        self.buffers, self.last_us = deque(buffers), 0
        self.listeners: dict[str, Callable[[Any], None]] = {}
        self.slots = [Said() for _ in range(3)]
        self.facilities: dict[str, Any] = {
            "roi": Said(),
            "ll_biases": Said(get_all_biases={"bias_diff_on": 10, "bias_fo": 20}),
            "digital_event_mask": Said(get_pixel_masks=self.slots),
            "trigger_in": Said(),
            "erc_module": Said(),
            "monitoring": Said(get_temperature=41),
            "geometry": Said(get_width=1280, get_height=720),
            "hw_identification": Said(get_serial="00050567", get_sensor_info=types.SimpleNamespace(name="IMX636")),
        } | dict.fromkeys(missing)

    def __getattr__(self, name: str) -> Any:
        return lambda: self.facilities[name.removeprefix("get_i_")]

    def get_i_events_stream(self) -> Any:
        return self

    def get_i_events_stream_decoder(self) -> Any:
        return self

    def get_i_event_cd_decoder(self) -> Any:
        return types.SimpleNamespace(add_event_buffer_callback=lambda heard: self.listeners.update(events=heard))

    def get_i_event_ext_trigger_decoder(self) -> Any:
        return types.SimpleNamespace(add_event_buffer_callback=lambda heard: self.listeners.update(edges=heard))

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def poll_buffer(self) -> int:
        return 0 if not self.buffers else -1 if isinstance(self.buffers[0], int) else 1

    def get_latest_raw_data(self) -> Any:
        return self.buffers.popleft()

    def decode(self, buffer: Any) -> None:
        self.last_us, events, edges = buffer
        for piece in events:
            self.listeners["events"](np.array(piece, metavision.EVENTS))
        if edges:
            self.listeners["edges"](np.array(edges, EDGES))

    def get_last_timestamp(self) -> int:
        return self.last_us


def source(device: Device, **settings: Any) -> MetavisionSource:
    return MetavisionSource(device, HAL, MetavisionSettings.model_validate(settings))
