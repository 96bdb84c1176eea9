"""Virtual time and the camera's side of the wire: batching, latency, loss, faults, frames."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from elpd_drivers.sim.camera import CameraFaults
from elpd_drivers.sim.world import BIRTH_NS, SLICE_NS, World, random_stream
from sim_rigs import Ramp, Setup

from elpd.errors import CameraError, ConfigError, UsageError
from elpd.ports import Biases, Closeable, HardwareRoi, Latency, PixelMask
from elpd.records import BiasSet, Encoding, Roi
from elpd.units import HostNs


class Diary:
    def __init__(self) -> None:
        self.instants: list[int] = []

    def advance_to(self, when: HostNs) -> None:
        self.instants.append(when - BIRTH_NS)


def test_time_moves_only_when_somebody_waits_and_in_slices() -> None:
    world, diary = World(), Diary()
    world.add(diary)
    assert world.now_ns() == BIRTH_NS
    world.sleep_until(HostNs(BIRTH_NS + 600_000))
    world.sleep_until(HostNs(BIRTH_NS + 100))
    assert diary.instants == [SLICE_NS, 2 * SLICE_NS, 600_000]
    assert world.now_ns() == BIRTH_NS + 600_000
    assert world.lag_s == 0.0


def test_a_paced_world_never_runs_ahead_of_the_wall_clock() -> None:
    world = World(pace=10.0)
    world.sleep_until(HostNs(BIRTH_NS + 200_000_000))
    assert world.lag_s > -1e-6
    with pytest.raises(ConfigError, match=r"sim\.pace"):
        World(pace=-1)


def test_random_streams_are_independent_of_each_other() -> None:
    draws = {(s, n): random_stream(s, n).integers(2**60) for s in (1, 2) for n in ("noise", "motion")}
    assert len(set(draws.values())) == 4
    assert random_stream(1, "noise").integers(2**60) == draws[1, "noise"]


def _digest(setup: Setup, until_s: float) -> str:
    setup.camera.start()
    whole = hashlib.sha256()
    for packet in setup.packets(until_s):
        whole.update(f"{packet.received_ns} {packet.complete_until_us} {len(packet.frames)}".encode())
        whole.update(packet.data.tobytes())
        for frame in packet.frames:
            whole.update(frame.pixels.tobytes())
    return whole.hexdigest()


def test_the_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    def run(seed: int) -> str:
        return _digest(Setup(Ramp(), seed=seed, motion="shake", with_frames=True), 0.06)

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_events_do_not_depend_on_when_they_are_read() -> None:
    eager, late = (Setup(Ramp(), motion="violent") for _ in range(2))
    one = eager.run(0.06)
    late.camera.start()
    late.world.sleep_until(HostNs(BIRTH_NS + 60_000_000))
    two = late.run(0.061)
    np.testing.assert_array_equal(one[one["t"] < 59_000], two[two["t"] < 59_000])


def test_packets_come_every_flush_with_latency_in_order_and_sorted() -> None:
    setup = Setup(Ramp(begin_s=0.0))
    setup.camera.start()
    packets = setup.packets(0.05)
    assert len(packets) in {98, 99}
    last_us = 0
    for index, packet in enumerate(packets):
        assert packet.encoding is Encoding.ARRAY
        assert packet.complete_until_us == 10_690_000 + 500 * (index + 1)
        delay_ns = packet.received_ns - (BIRTH_NS + 500_000 * (index + 1))
        assert 150_000 <= delay_ns < 600_000
        t = packet.data["t"].astype(np.int64)
        if len(t):
            assert t[0] >= last_us
            assert (np.diff(t) >= 0).all()
            assert t[-1] < packet.complete_until_us
            last_us = t[-1]


def test_a_read_that_finds_nothing_takes_its_timeout() -> None:
    setup = Setup()
    setup.camera.start()
    assert setup.camera.read(0.0004) is None
    assert setup.world.now_ns() == BIRTH_NS + 400_000
    assert setup.camera.read(0.0) is None


def test_a_late_reader_sees_the_backlog_and_then_the_gap() -> None:
    setup = Setup(Ramp(begin_s=0.0), camera={"ring_packets": 20})
    reference = Setup(Ramp(begin_s=0.0))
    setup.camera.start()
    setup.world.sleep_until(HostNs(BIRTH_NS + 50_000_000))
    packets = setup.packets(0.08)
    assert packets[0].backlog == 19
    assert not any(packet.gap_before for packet in packets[:20])
    assert packets[20].gap_before
    delivered = sum(len(packet.data) for packet in packets)
    lost = sum(packet.lost_events for packet in packets)
    reference.camera.start()
    everything = sum(
        len(p.data) for p in reference.packets(0.08) if p.complete_until_us <= packets[-1].complete_until_us
    )
    assert lost == packets[20].lost_events > 0
    assert delivered + lost == everything


def test_faults_of_the_camera() -> None:
    with pytest.raises(CameraError, match="start"):
        Setup().camera.read(0.1)

    gone = Setup(camera={"faults": CameraFaults(vanishes_at_s=0.01)})
    gone.camera.start()
    with pytest.raises(CameraError, match=r"lost 0\.01 s after start"):
        gone.packets(0.05)

    silent = Setup(camera={"faults": CameraFaults(silent_from_s=0.01)})
    silent.camera.start()
    assert len(silent.packets(0.05)) == 19

    dropping = Setup(Ramp(begin_s=0.0), camera={"faults": CameraFaults(drops_from_s=0.01, drops_for_s=0.01)})
    dropping.camera.start()
    flagged = [packet for packet in dropping.packets(0.05) if packet.gap_before]
    assert len(flagged) == 1
    assert flagged[0].lost_events > 0


def test_the_camera_has_all_optional_abilities() -> None:
    camera = Setup().camera
    for ability in (HardwareRoi, Biases, PixelMask, Latency, Closeable):
        assert isinstance(camera, ability)
    assert camera.min_latency_us == 150
    with pytest.raises(UsageError, match=r"90,0,10,10 does not fit the sensor of 96x80"):
        camera.set_window(Roi(90, 0, 10, 10))
    assert camera.set_mask([(1, 1)] * 100) == 64
    camera.close()
    camera.close()


def test_changes_take_effect_no_earlier_than_asked() -> None:
    setup = Setup(Ramp(begin_s=0.0))
    setup.run(0.0302)
    setup.camera.set_window(Roi(0, 0, 20, 20))
    setup.camera.apply_biases(BiasSet.FOCUS)
    events = setup.run(0.06)
    wide = events[(events["x"] >= 20) | (events["y"] >= 20)]
    assert 30_000 < wide["t"].max() < 30_500


def test_a_camera_started_again_begins_at_rest() -> None:
    setup = Setup(Ramp(begin_s=0.0), sensor={"noise_hz": 0.0, "leak_hz": 0.0})
    setup.run(0.02)
    setup.camera.stop()
    setup.world.sleep_until(HostNs(BIRTH_NS + 300_000_000))
    assert len(setup.run(0.35)) == 0


def test_frames_show_the_scene_and_say_when() -> None:
    setup = Setup(Ramp(start_um=0.0, travel_um=0.0), with_frames=True, scene="camera", size=(160, 120))
    setup.camera.start()
    frames = [frame for packet in setup.packets(0.1) for frame in packet.frames]
    assert [frame.t_us - 10_690_000 for frame in frames] == [2_500, 22_500, 42_500, 62_500, 82_500]
    assert [frame.available_us - frame.t_us for frame in frames] == [6_500] * 5
    assert frames[0].pixels.dtype == np.uint8
    scene = setup.canvas[32:-32, 32:-32]
    assert np.corrcoef(frames[1].pixels.ravel(), scene.ravel())[0, 1] > 0.97
    assert 225 < np.percentile(frames[1].pixels, 99) < 255
    assert not np.array_equal(frames[1].pixels, frames[2].pixels)


def test_a_frame_is_not_delivered_before_it_is_read_out() -> None:
    setup = Setup(with_frames=True)
    setup.camera.start()
    for packet in setup.packets(0.1):
        for frame in packet.frames:
            assert packet.complete_until_us >= frame.available_us
