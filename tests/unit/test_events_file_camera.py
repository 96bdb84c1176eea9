"""The file camera: a recording played on a clock that we hold."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from elpd_drivers.cameras.file import open_camera
from elpd_drivers.formats.raw import write_raw

from elpd.errors import CameraError, ConfigError
from elpd.events.evt3_encode import Evt3Encoder
from elpd.records import CameraPacket, Geometry
from elpd.vision.elp import ElpWindows

EVENT = [("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1")]


class HeldClock:
    """A clock on which time passes only by waiting."""

    def __init__(self) -> None:
        self.ns = 1_000_000_000

    def now_ns(self) -> int:
        return self.ns

    def sleep_until(self, when: int) -> None:
        self.ns = max(self.ns, when)


def events(n: int, seed: int = 5, span_us: int = 40_000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    data = np.zeros(n, EVENT)
    data["t"] = 7_000 + np.sort(rng.integers(0, span_us, n))
    data["x"], data["y"], data["p"] = rng.integers(0, 64, n), rng.integers(0, 48, n), rng.integers(0, 2, n)
    return data


@pytest.fixture(params=["raw", "npy"])
def recording(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / f"r.{request.param}"
    data = events(3000)
    if request.param == "npy":
        np.save(path, data)
    else:
        encoder = Evt3Encoder(64)
        words = [
            encoder.encode(*(data[name] for name in "txyp")).copy(),
            encoder.encode_trigger(47_500, 1, rising=True),
        ]
        write_raw(path, Geometry(64, 48), words, {})
    return path


def play(camera: Any, timeout_s: float = 1.0) -> list[CameraPacket]:
    packets = []
    camera.start()
    try:
        while True:
            packet = camera.read(timeout_s)
            if packet is not None:
                packets.append(replace(packet, data=packet.data.copy()))
    except CameraError:
        return packets
    finally:
        camera.stop()


def test_packets_appear_when_their_time_has_come(recording: Path) -> None:
    clock = HeldClock()
    camera = open_camera({"path": recording, "packet_us": 2000}, clock)
    begun = clock.ns
    packets = play(camera)
    promised = [packet for packet in packets if packet.complete_until_us is not None]
    received = np.array([packet.received_ns - begun for packet in promised]) / 1000
    until = np.array([packet.complete_until_us for packet in promised])
    assert np.allclose(np.diff(received), np.diff(until))
    assert set(np.diff(until)) <= {0, 2000}


def test_the_end_of_the_recording_is_told(recording: Path) -> None:
    camera = open_camera({"path": recording, "packet_us": 1_000_000}, HeldClock())
    camera.start()
    assert camera.read(10.0) is not None
    assert camera.read(10.0).data.size == 0
    with pytest.raises(CameraError, match=r"r\.(raw|npy) has ended"):
        camera.read(10.0)
    camera.stop()


def test_half_the_pace_takes_twice_the_time(recording: Path) -> None:
    spans = []
    for pace in (1.0, 0.5, 0):
        clock = HeldClock()
        begun = clock.ns
        play(open_camera({"path": recording, "pace": pace}, clock))
        spans.append(clock.ns - begun)
    assert spans[1] == 2 * spans[0]
    assert spans[2] == 0


def test_a_timeout_returns_nothing_and_loses_nothing(recording: Path) -> None:
    clock = HeldClock()
    camera = open_camera({"path": recording, "packet_us": 5000}, clock)
    camera.start()
    begun = clock.ns
    assert camera.read(0.0001) is None
    assert clock.ns == begun + 100_000
    camera.stop()
    hurried = play(open_camera({"path": recording, "packet_us": 5000}, HeldClock()))
    patient = play(open_camera({"path": recording, "packet_us": 5000}, HeldClock()), timeout_s=0.0003)
    assert [len(packet.data) for packet in hurried] == [len(packet.data) for packet in patient]


@pytest.mark.parametrize("packet_us", [100, 1000, 7777])
def test_windows_do_not_depend_on_the_packets(recording: Path, packet_us: int) -> None:
    data = events(3000)
    weights = np.random.default_rng(2).integers(-9, 10, (48, 64))
    camera = open_camera({"path": recording, "packet_us": packet_us, "width": 64, "height": 48}, HeldClock())
    meter = ElpWindows(weights, window_us=500, origin_us=7000)
    rows = [row for packet in play(camera) for row in meter.feed(packet).tolist()]
    signed = -np.where(data["p"] == 1, 1, -1) * weights[data["y"], data["x"]]
    expected = np.bincount((data["t"] - 7000) // 500, signed, minlength=80).astype(int)
    assert [row[2] for row in rows][:80] == expected.tolist()
    assert meter.counters["late"] == 0


def test_triggers_come_with_their_packet(tmp_path: Path) -> None:
    encoder = Evt3Encoder(64)
    words = [encoder.encode_trigger(t, 0, rising=rising).copy() for t, rising in ((9_500, True), (12_000, False))]
    write_raw(tmp_path / "r.raw", Geometry(64, 48), words, {})
    packets = play(open_camera({"path": tmp_path / "r.raw"}, HeldClock()))
    edges = [(edge.t_us, edge.rising, packet.complete_until_us) for packet in packets for edge in packet.triggers]
    assert [edge[:2] for edge in edges] == [(9_500, True), (12_000, False)]
    assert edges[0][2] == 10_000


def test_a_file_that_does_not_say_its_size_is_measured(tmp_path: Path) -> None:
    np.save(tmp_path / "r.npy", np.array([[1, 20, 30, 1], [2, 5, 40, 0]]))
    assert open_camera({"path": tmp_path / "r.npy"}, HeldClock()).geometry == Geometry(21, 41)


def test_it_can_be_started_again_and_must_be_started(recording: Path) -> None:
    camera = open_camera({"path": recording}, HeldClock())
    with pytest.raises(CameraError, match="call start first"):
        camera.read(0.1)
    assert [len(p.data) for p in play(camera)] == [len(p.data) for p in play(camera)]
    camera.stop()
    camera.stop()


@pytest.mark.parametrize("settings", [{}, {"path": "x", "pace": -1}, {"path": "x", "packet_us": 0}])
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        open_camera(settings, HeldClock())
