"""A camera library for tests of the capture process: it does what its settings say, in real time."""

from __future__ import annotations

import os
import signal
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from elpd_drivers.cameras.ring import Captured
from elpd_drivers.cameras.source import SourceFacts, layout_of

from elpd.errors import CameraError, UsageError
from elpd.records import Encoding, Frame, Geometry, Trigger
from elpd.units import SensorUs

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

EVENTS = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
WHERE = "scripted_source:open_source"


def open_source(settings: dict[str, Any]) -> ScriptedSource:
    if settings.get("refuse"):
        raise CameraError(settings["refuse"])
    if settings.get("break_at_opening"):
        raise RuntimeError("Rusb(Access)")
    time.sleep(settings.get("opening_s", 0.0))
    return ScriptedSource(settings)


class ScriptedSource:
    """Delivers ``packets`` packets of ``events`` numbered events; if it has a trigger input, once that is enabled."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._settings = settings
        self._sent = 0
        self._calls: list[Any] = []
        self.facts = SourceFacts(
            geometry=Geometry(346, 260),
            encoding=Encoding.ARRAY,
            model="scripted",
            serial=settings.get("serial", "0001"),
            min_latency_us=120.0,
            layout=layout_of(EVENTS),
            abilities=tuple(settings.get("abilities", ())),
        )

    def read(self, timeout_s: float) -> Captured | None:
        settings, number = self._settings, self._sent
        if number == settings.get("ends_at", -1) and not os.path.exists(settings.get("once", "")):  # noqa: PTH110
            if "once" in settings:
                open(settings["once"], "w", encoding="utf-8").close()  # noqa: PTH123
            self._end(settings["how"])
        gated = "trigger" in self.facts.abilities and not any(call[0] == "enable_trigger" for call in self._calls)
        if gated or number >= settings.get("packets", 1 << 40):
            time.sleep(timeout_s)
            return None
        self._sent += 1
        time.sleep(settings.get("every_s", 0.0))
        return packet(number, settings.get("events", 10), time.monotonic_ns() - settings.get("late_ns", 0))

    def call(self, name: str, arguments: Sequence[Any]) -> Any:
        if name == "set_mask" and len(arguments[0]) > 3:
            raise UsageError("camera: no such pixel")
        if name == "apply_biases" and arguments[0] == "expose":
            raise CameraError("camera: gone while it was told")
        if name == "limit_rate":
            time.sleep(arguments[0])
        self._calls.append([name, *arguments])
        return len(arguments[0]) if name == "set_mask" else 31.5

    def notes(self) -> Mapping[str, float]:
        return {"usb_packets_dropped": 7, "calls": len(self._calls)}

    def close(self) -> None:
        if "closed" in self._settings:
            with open(self._settings["closed"], "w", encoding="utf-8") as file:  # noqa: PTH123
                file.write("closed")

    def _end(self, how: str) -> None:
        if how == "abort":
            sys.stderr.write("mutex is locked\n")
            os.abort()
        if how == "unplugged":
            raise CameraError("camera: unplugged (no device); plug it in again")
        if how == "library":
            raise RuntimeError("PropheseeEvk4(Usb(Rusb(Pipe)))")
        if how == "hang":
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
            time.sleep(60)


def packet(number: int, count: int, received_ns: int) -> Captured:
    """Return what the scripted camera sends as its packet of that number."""
    events = np.zeros(count, EVENTS)
    events["t"] = 1000 * number + np.arange(count)
    events["x"], events["on"] = number % 346, number % 2
    frames = ()
    if number % 5 == 0:
        pixels = np.full((3, 5), number % 65536, np.uint16)
        frames = (Frame(SensorUs(1000 * number), SensorUs(1000 * number + 9), 7, pixels),)
    edges = (Trigger(SensorUs(1000 * number), 6, rising=bool(number % 2)),) * (number % 3)
    return Captured(
        events,
        received_ns,
        complete_until_us=1000 * number + 999,
        events=count,
        frames=frames,
        triggers=edges,
    )
