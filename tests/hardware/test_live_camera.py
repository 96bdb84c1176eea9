"""A real camera, whichever is plugged in: `ELPD_HARDWARE="neuromorphic" pytest -m hardware tests/hardware`.

``ELPD_HARDWARE`` names the driver; ``ELPD_HARDWARE_SERIAL`` one of several cameras.
"""

from __future__ import annotations

import os
import time
from importlib import import_module

import numpy as np
import pytest

from elpd.events.stream import PacketDecoder
from elpd.ports import Biases, HardwareRoi, Inertial
from elpd.records import BiasSet, ImuSample, Roi
from elpd.timebase import MonotonicClock, SensorClock

DRIVER = os.environ.get("ELPD_HARDWARE", "")
pytestmark = [
    pytest.mark.hardware,
    pytest.mark.skipif(DRIVER not in {"neuromorphic", "davis", "metavision"}, reason="ELPD_HARDWARE names no camera"),
]


def test_a_live_camera_speaks_all_the_time_and_obeys_its_window() -> None:
    settings = {"serial": os.environ["ELPD_HARDWARE_SERIAL"]} if "ELPD_HARDWARE_SERIAL" in os.environ else {}
    camera = import_module(f"elpd_drivers.cameras.{DRIVER}").open_camera(settings, MonotonicClock())
    try:
        camera.start()
        decoder, clock, silences_ms = PacketDecoder(camera.geometry), SensorClock(camera.min_latency_us), []
        window = Roi(camera.geometry.width // 4, camera.geometry.height // 4, 64, 64)
        if isinstance(camera, Biases):
            camera.apply_biases(BiasSet.FOCUS)
        if isinstance(camera, HardwareRoi):
            camera.set_window(window)
        inertia: list[ImuSample] = []
        begun = before = time.monotonic()
        while time.monotonic() < begun + 3:
            packet = camera.read(0.1)
            if packet is None:
                continue
            now = time.monotonic()
            inertia += packet.imu
            silences_ms.append(1e3 * (now - before))
            before = now
            events = decoder.feed(packet)
            if packet.complete_until_us is not None:
                clock.saw(packet.complete_until_us, packet.received_ns)
            if now > begun + 1 and isinstance(camera, HardwareRoi) and events.t.size:
                assert window.x <= events.x.min()
                assert events.x.max() < window.x + window.width
                assert window.y <= events.y.min()
                assert events.y.max() < window.y + window.height
        print(f"{len(silences_ms)} packets, {np.percentile(silences_ms, [50, 99, 100])} ms apart")  # noqa: T201
        print(f"clock: {clock.drift_ppm:.1f} ppm, bound {clock.bound_us:.1f} us; {dict(camera.counters)}")  # noqa: T201
        if isinstance(camera, Inertial):
            felt = np.median([np.linalg.norm(one.acceleration_m_s2) for one in inertia])
            print(f"{len(inertia)} inertial samples, {felt:.2f} m/s^2")  # noqa: T201
            assert 8 < felt < 12, "a camera that rests feels gravity"
        assert max(silences_ms) < 50, "a sweep would have been ended"
        assert camera.counters["gaps"] == 0
    finally:
        camera.close()
