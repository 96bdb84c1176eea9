"""A camera library in a process of its own: its packets, its ways to fail, its end."""

from __future__ import annotations

import os
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import scripted_source
from elpd_drivers.cameras.capture import CapturedCamera, open_captured
from elpd_drivers.cameras.source import CaptureSettings
from virtual import TestClock

from elpd.errors import CameraError, ConfigError, UsageError
from elpd.ports import (
    Biases,
    Closeable,
    Counters,
    HardwareRoi,
    Identified,
    Latency,
    PixelMask,
    RateLimit,
    Reopens,
    Temperature,
    TriggerInput,
)
from elpd.records import BiasSet, Roi
from elpd.timebase import MonotonicClock

if TYPE_CHECKING:
    from collections.abc import Iterator

    from elpd.records import CameraPacket

PATIENCE_S = 20.0
SHM = Path("/dev/shm")  # noqa: S108  (looked at, not written to)


@contextmanager
def opened(
    ring_mb: float = 4.0, max_delay_ms: float = 0.0, hang_ms: float = 10_000.0, **script: Any
) -> Iterator[CapturedCamera]:
    """Open a scripted camera; a machine that is too busy for it is no hang, unless the test is about hangs."""
    common = CaptureSettings(ring_mb=ring_mb, max_delay_ms=max_delay_ms, hang_ms=hang_ms)
    camera = open_captured(scripted_source.WHERE, script, common, MonotonicClock())
    try:
        yield camera
    finally:
        camera.close()


def begin(camera: CapturedCamera) -> None:
    """Start, and let the scripted camera send its packets only then."""
    camera.start()
    assert isinstance(camera, TriggerInput)
    camera.enable_trigger(on=True)


def next_packet(camera: CapturedCamera) -> CameraPacket:
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        packet = camera.read(0.05)
        if packet is not None:
            return packet
    raise AssertionError("no packet came")


def read_on(camera: CapturedCamera) -> None:
    while True:
        next_packet(camera)


def children() -> set[int]:
    """Return the processes that this one has started and not yet buried."""
    tasks = Path(f"/proc/{os.getpid()}/task").iterdir()
    return {int(pid) for task in tasks for pid in (task / "children").read_text().split()}


def test_packets_arrive_as_they_were_sent_and_views_live_until_the_next_read() -> None:
    with opened(packets=40, abilities=["trigger"]) as camera:
        begin(camera)
        for number in range(40):
            packet = next_packet(camera)
            sent = scripted_source.packet(number, 10, 0)
            np.testing.assert_array_equal(packet.data, sent.data)
            assert not packet.data.flags.writeable
            assert packet.complete_until_us == 1000 * number + 999
            assert packet.triggers == sent.triggers
            assert len(packet.frames) == len(sent.frames)
            assert not packet.gap_before
            assert 0 < packet.received_ns <= time.monotonic_ns()
        assert camera.read(0.0) is None
        assert camera.counters["packets"] == 40
        assert camera.counters["usb_packets_dropped"] == 7
        assert camera.counters["ring_dropped_packets"] == 0


def test_what_it_can_do_is_what_its_source_can() -> None:
    with opened(packets=0) as plain:
        assert isinstance(plain, (Latency, Identified, Counters, Reopens, Closeable))
        assert (plain.min_latency_us, plain.serial) == (120.0, "0001")
        assert not isinstance(plain, (HardwareRoi, Biases, PixelMask, TriggerInput, RateLimit, Temperature))
    every = ("window", "biases", "mask", "trigger", "rate_limit", "temperature")
    with opened(hang_ms=100.0, packets=0, abilities=every) as able:
        assert isinstance(able, (HardwareRoi, Biases, PixelMask, TriggerInput, RateLimit, Temperature))
        able.set_window(Roi(1, 2, 3, 4))
        able.set_window(None)
        able.apply_biases(BiasSet.FOCUS)
        assert able.set_mask([(1, 2), (3, 4)]) == 2
        able.enable_trigger(on=True)
        able.limit_rate(0.0)
        assert able.temperature_c() == 31.5
        with pytest.raises(UsageError, match="no such pixel"):
            able.set_mask([(0, 0)] * 4)
        with pytest.raises(UsageError, match="does not fit the sensor of 346x260"):
            able.set_window(Roi(340, 0, 10, 10))
        able.start()
        able.limit_rate(0.2)  # longer than it may be silent: what was asked for may take its time
        assert able.read(0.0) is None
        with pytest.raises(CameraError, match="gone while it was told"):
            able.apply_biases(BiasSet.EXPOSE)


def test_stop_and_start_deliver_nothing_old() -> None:
    with opened(every_s=0.001) as camera:
        camera.start()
        before = next_packet(camera).data["t"][0]
        camera.stop()
        camera.stop()
        with pytest.raises(CameraError, match="call start"):
            camera.read(0.0)
        camera.start()
        now_ns = time.monotonic_ns()
        after = next_packet(camera)
        assert after.data["t"][0] > before
        assert after.received_ns > now_ns - 50_000_000
        assert not after.gap_before


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("abort", r"its process was ended by SIGABRT \(mutex is locked Aborted, in File .*scripted_source\.py"),
        ("unplugged", r"unplugged \(no device\)"),
        ("library", r"its library failed: RuntimeError: PropheseeEvk4\(Usb\(Rusb\(Pipe\)\)\)"),
        ("hang", r"its library hangs, nothing for \d+ ms \(limit 50\)"),
    ],
    ids=["abort", "unplugged", "library", "hang"],
)
def test_a_lost_camera_is_an_error_at_once_and_leaves_nothing_behind(how: str, reason: str, tmp_path: Path) -> None:
    before, named = children(), set(SHM.iterdir())
    hang_ms = 50.0 if how == "hang" else 10_000.0
    with opened(hang_ms=hang_ms, ends_at=20, how=how, once=str(tmp_path / "once"), every_s=0.0005) as camera:
        mine = children() - before
        assert len(mine) == 1
        camera.start()
        with pytest.raises(CameraError, match=r"(?s)" + reason):
            read_on(camera)
        assert set(SHM.iterdir()) == named
        with pytest.raises(CameraError, match=r"(?s)" + reason):
            camera.read(0.0)
        camera.start()
        assert len(children() - before) == 1, "the one that was lost is buried"
        assert next_packet(camera).data.size == 10
        assert camera.counters["reopened"] == 1
    assert children() == before


def test_reopening_never_waits_and_grows_patient() -> None:
    with opened(ends_at=0, how="unplugged") as camera:
        camera.start()
        pauses_s = [camera._pause_s]
        for _ in range(3):
            with pytest.raises(CameraError, match="unplugged"):
                next_packet(camera)
            camera._next_try_s = 0.0
            while not camera.reopen():
                os.sched_yield()
            pauses_s.append(camera._pause_s)
            camera.start()
        assert pauses_s == [0.1, 0.2, 0.4, 0.8]
        with pytest.raises(CameraError, match="unplugged"):
            next_packet(camera)
        camera._next_try_s = time.monotonic() + 60
        assert not camera.reopen()
        with pytest.raises(CameraError, match=r"unplugged.*next attempt in"):
            camera.start()


def test_another_camera_in_its_place_is_refused() -> None:
    with opened(ends_at=5, how="library") as camera:
        camera.start()
        with pytest.raises(CameraError, match="library failed"):
            read_on(camera)
        camera._facts = replace(camera._facts, serial="0")
        with pytest.raises(CameraError, match=r"another one is plugged in \(scripted 0001, it was scripted 0\)"):
            camera.start()


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ({"refuse": "camera: no permission; add the udev rule"}, "add the udev rule"),
        ({"break_at_opening": True}, r"its library failed: RuntimeError: Rusb\(Access\)"),
    ],
)
def test_a_camera_that_cannot_be_opened_says_why(script: dict[str, Any], reason: str) -> None:
    before = children()
    with pytest.raises(CameraError, match=reason):
        open_captured(scripted_source.WHERE, script, CaptureSettings(), MonotonicClock())
    assert children() == before


def test_opening_has_a_deadline() -> None:
    before = children()
    with pytest.raises(CameraError, match=r"not open after .* s \(limit 0\.2\); .*open_timeout_s"):
        open_captured(scripted_source.WHERE, {"opening_s": 30}, CaptureSettings(open_timeout_s=0.2), MonotonicClock())
    assert children() == before


def test_a_backend_that_is_not_there_says_so() -> None:
    with pytest.raises(CameraError, match=r"its library failed: ModuleNotFoundError"):
        open_captured("no_such_backend:open_source", {}, CaptureSettings(), MonotonicClock())


def test_closing_lets_the_library_give_the_camera_back(tmp_path: Path) -> None:
    with opened(closed=str(tmp_path / "note"), packets=0) as camera:
        camera.close()
        assert (tmp_path / "note").read_text() == "closed"
        with pytest.raises(CameraError, match=r"it was closed; call start"):
            camera.read(0.0)
        camera.start()
        assert camera.read(0.0) is None


def test_a_reader_that_sleeps_loses_whole_packets_and_is_told() -> None:
    """1 MB of ring, 20 kB packets: some fifty fit, the others are counted."""
    with opened(ring_mb=1.0, events=1500, packets=100, abilities=["trigger"]) as camera:
        begin(camera)
        until = time.monotonic() + PATIENCE_S
        while camera.counters.get("ring_dropped_packets", 0) < 20 and time.monotonic() < until:
            os.sched_yield()
        seen = lost = gaps = 0
        while (packet := camera.read(0.1)) is not None:
            seen += packet.data.size
            lost += packet.lost_events
            gaps += packet.gap_before
        counts = camera.counters
        assert (counts["events"], counts["lost_events"], counts["gaps"]) == (seen, lost, gaps)
        assert seen + counts["ring_dropped_events"] == 100 * 1500
        assert counts["most_waiting"] >= 40


def test_stale_packets_give_way_to_the_newest() -> None:
    with opened(packets=50, late_ns=300_000_000, max_delay_ms=250.0, abilities=["trigger"]) as camera:
        begin(camera)
        until = time.monotonic() + PATIENCE_S
        while camera._process.reader.waiting < 20 and time.monotonic() < until:  # type: ignore[union-attr]
            os.sched_yield()
        packet = next_packet(camera)
        assert packet.gap_before
        assert packet.lost_events >= 10 * 19
        assert camera.counters["late_packets_dropped"] * 10 == packet.lost_events
        assert len(packet.frames) <= 2, "of the frames that were thrown away, the newest, and its own"


def test_a_live_camera_in_virtual_time_is_refused() -> None:
    with pytest.raises(ConfigError, match='rig = "hardware"'):
        open_captured(scripted_source.WHERE, {}, CaptureSettings(), TestClock())


def test_the_child_ends_with_its_controller() -> None:
    """Whatever becomes of the controller, its end of the line closes with it."""
    with opened(packets=0) as camera:
        process = camera._process
        assert process is not None
        process._control.close()
        assert process._child.wait(PATIENCE_S) == 0


def test_a_child_that_is_told_to_end_gives_the_camera_back(tmp_path: Path) -> None:
    with opened(closed=str(tmp_path / "note"), every_s=0.001) as camera:
        camera.start()
        process = camera._process
        assert process is not None
        process._child.terminate()
        with pytest.raises(CameraError, match=r"its process ended with status 0; start it again"):
            read_on(camera)
        assert (tmp_path / "note").read_text() == "closed"
