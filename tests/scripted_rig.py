"""A rig whose devices answer from a script: one list of answers, in the order in which they will be asked for."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from elpd.ports import RigParts
from elpd.records import (
    CameraPacket,
    CommandStamp,
    Encoding,
    Geometry,
    LensCapabilities,
    LensLimits,
    LensReport,
    PositionEstimate,
    StopMode,
)
from elpd.scale import LensScale

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from elpd.ports import RunSink

GEOMETRY = Geometry(64, 48)
LIMITS = LensLimits(-1000, 1000, 12800.0, 1e6)
CAPABILITIES = LensCapabilities(
    native_velocity=True,
    abrupt_stop=True,
    stop_on_command=True,
    homing=False,
    stop_onset_ms=1.25,
    stop_onset_sigma_ms=0.1,
)


class Script:
    """What the devices will say. An exception in it is raised."""

    def __init__(self, answers: Iterable[Any]) -> None:
        self.answers = deque(answers)

    def next(self, *_: Any) -> Any:
        answer = self.answers.popleft()
        if isinstance(answer, BaseException):
            raise answer
        return answer


class Clock:
    def __init__(self, script: Script) -> None:
        self.now_ns = self.sleep_until = script.next


class Camera:
    geometry = GEOMETRY

    def __init__(self, script: Script) -> None:
        self.start = self.read = self.stop = script.next


class AbleCamera(Camera):
    min_latency_us = 83.5

    def __init__(self, script: Script) -> None:
        super().__init__(script)
        self.set_window = self.apply_biases = self.set_mask = self.close = script.next


class EveryCamera(AbleCamera):
    """One that can all that a camera may be able to."""

    serial = "00000499"
    counters: ClassVar = {"packets": 7, "rate": float("inf")}
    remarks = ("use a port of its own",)

    def __init__(self, script: Script) -> None:
        super().__init__(script)
        self.limit_rate = self.temperature_c = self.reopen = script.next
        self.enable_trigger = self.enable_imu = lambda *, on: script.next(on)


class Lens:
    limits = LIMITS
    capabilities = CAPABILITIES

    def __init__(self, script: Script) -> None:
        self.home = self.move_to = self.run = self.stop = self.poll = self.position_at = script.next


class CloseableLens(Lens):
    def __init__(self, script: Script) -> None:
        super().__init__(script)
        self.close = script.next


class EveryLens(CloseableLens):
    """One that can all that a lens may be able to."""

    serial, mark_channel, outputs = "L7", 6, ("iris",)
    remarks = ("the adapter is slow",)

    def __init__(self, script: Script) -> None:
        super().__init__(script)
        self.mark = script.next
        self.set_output = lambda name, *, on: script.next(name, on)
        self._script = script

    def learn_stops(self, measured: Any) -> None:
        self.capabilities = self._script.next(measured)


class PacedClock(Clock):
    lag_s = 0.25

    def __init__(self, script: Script) -> None:
        super().__init__(script)
        self.close = script.next


class Aperture:
    opening_ms = 20.0

    def __init__(self, script: Script) -> None:
        self.open = self.close = self.transmittance = script.next


def scripted_rig(
    answers: Iterable[Any] = (),
    camera: type[Camera] = AbleCamera,
    lens: type[Lens] = CloseableLens,
    aperture: type[Aperture] | None = Aperture,
    clock: type[Clock] = Clock,
) -> RigParts:
    script = Script(answers)
    return RigParts(
        clock=clock(script),
        camera=camera(script),
        lens=lens(script),
        aperture=None if aperture is None else aperture(script),
        scale=LensScale(0.3125),
    )


def packet(seed: int, words: int = 200, **fields: Any) -> CameraPacket:
    """Return EVT3 words that need not decode to anything."""
    data = np.random.default_rng(seed).integers(0, 1 << 16, words).astype(np.uint16)
    return CameraPacket(data, Encoding.EVT3, received_ns=1_000_000 * seed, **fields)


def small_world(seed: int, turns: int = 20) -> list[Any]:
    """Return what a rig answers to ``small_cycle``; the same seed, the same world."""
    answers: list[Any] = [None, CommandStamp("run", 10, 20)]
    for turn in range(turns):
        answers += [
            packet(seed * 1000 + turn, complete_until_us=1000 * turn),
            LensReport(turn / 3, 5 * turn, 7 * turn),
            PositionEstimate(turn / 7, 0.5),
        ]
    return [*answers, CommandStamp("stop", 30, 40), None]


def small_cycle(
    parts: RigParts, sink: RunSink, turns: int = 20, cancelled: Callable[[], bool] = lambda: False
) -> dict[str, Any]:
    """Sweep, note one number per packet, stop: the shape of a cycle in a dozen lines."""
    parts.camera.start()
    sink.note("phase", name="sweep")
    parts.lens.run(100.0, 10**9)
    total = 0
    for turn in range(turns):
        if cancelled():
            break
        read = parts.camera.read(0.002)
        parts.lens.poll()
        where = parts.lens.position_at(1000 * turn)
        total += int(read.data.sum())
        sink.note("window", total=total, position_um=where.steps * parts.um_per_step, score=float("nan"))
    parts.lens.stop(StopMode.ABRUPT)
    parts.camera.stop()
    sink.note("phase", name="done")
    return {"outcome": "FOCUSED", "focus_um": total / 3.0, "phases": [{"name": "sweep", "ms": 1.5}]}
