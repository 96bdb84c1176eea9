"""What every phase of a cycle stands on: whose fault it is when nothing comes."""

import numpy as np
import pytest
from scripted_rig import GEOMETRY

from elpd.errors import CameraError
from elpd.focus.stage import SILENCE_MS, Stage
from elpd.ports import RigParts
from elpd.records import CameraPacket, Encoding
from elpd.scale import LensScale
from elpd.units import NS_PER_MS, HostNs, after_ms


class Clock:
    def __init__(self) -> None:
        self.now = HostNs(10**10)

    def now_ns(self) -> HostNs:
        return self.now

    def sleep_until(self, when: HostNs) -> None:
        self.now = max(self.now, when)


class Camera:
    """Hands out packets that waited, then nothing."""

    geometry = GEOMETRY

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.waiting: list[CameraPacket] = []

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def read(self, timeout_s: float) -> CameraPacket | None:
        if self.waiting:
            return self.waiting.pop(0)
        self.clock.sleep_until(after_ms(self.clock.now, 1e3 * timeout_s))
        return None


class Lens:
    def poll(self) -> None: ...


def stage() -> tuple[Stage, Clock, Camera]:
    clock = Clock()
    camera = Camera(clock)
    parts = RigParts(clock, camera, Lens(), None, LensScale(1.0))  # type: ignore[arg-type]  # all that is asked of it
    return Stage(parts), clock, camera


def test_a_camera_is_not_silent_because_nobody_read_it() -> None:
    """What gathered while this side was busy is old when it is read; the camera may have more in a moment."""
    one, clock, camera = stage()
    old = HostNs(clock.now)
    clock.now = after_ms(old, 3 * SILENCE_MS)
    camera.waiting = [CameraPacket(np.zeros(1, np.uint16), Encoding.EVT3, old)]
    assert one.read() is not None
    assert one.read() is None
    behind_ns = clock.now
    with pytest.raises(CameraError, match=r"no data for 20[12] ms"):
        one.wait_ms(10 * SILENCE_MS)
    assert clock.now - behind_ns < (SILENCE_MS + 5) * NS_PER_MS


def test_a_camera_that_never_spoke_is_silent() -> None:
    one, clock, _ = stage()
    begun_ns = clock.now
    with pytest.raises(CameraError, match=r"no data for 20[12] ms"):
        one.wait_ms(10 * SILENCE_MS)
    assert clock.now - begun_ns < (SILENCE_MS + 5) * NS_PER_MS
