"""The unmodified neuromorphic-drivers, its DAVIS346 emulated on the USB: all that it sends, loss, unplugging."""

from __future__ import annotations

import time
from contextlib import closing
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from elpd_drivers.cameras import neuromorphic
from hardware_emulation import plugged
from hardware_emulation.davis346 import ADC_MHZ, EXPOSURE, FRAME_INTERVAL, MASKED_COLUMNS, MASKED_ROWS, RUN, Davis346
from hardware_emulation.davis346 import ON_THRESHOLD as ON_BIAS
from hardware_emulation.davis_words import ON, ROW, Encoder, Sample, frame_blocks
from hardware_emulation.plugged import PATIENCE_S, PATIENT, Plugged, on_a_bus
from shared import RECORDINGS, needs_shared

from elpd.errors import CameraError
from elpd.events.layout import event_columns
from elpd.events.stream import EventStream, open_recording
from elpd.ports import Biases, Counters, HardwareRoi, Inertial, PixelMask, Reopens, Temperature, TriggerInput
from elpd.records import BiasSet, Encoding, Geometry
from elpd.timebase import MonotonicClock

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from hardware_emulation import usbfs
    from numpy.typing import NDArray

    from elpd.records import CameraPacket, Frame, ImuSample, Trigger

pytest.importorskip("neuromorphic_drivers")
pytestmark = plugged.marks

WIDTH, HEIGHT = 346, 260
WORDS_OF_A_BUFFER = 1 << 16
G_M_S2, RAD_S = 4 * 9.80665 / 32768, np.radians(500.0) / 32768
"""What a step of the inertial sensor is worth at the full scales that the library sets."""

SETTINGS: dict[str, Any] = {
    "serial": "00000499",
    "model": "davis346",
    "usb_packets": 256,
    **PATIENT,
    "exposure_us": 700,
    "frame_interval_us": 20_000,
    "biases": {"expose": {"onbn": 1500}, "focus": {"onbn": 1600}},
}


class Heard:
    """What came, gathered from packets."""

    def __init__(self, packets: Iterable[CameraPacket]) -> None:
        columns: list[list[NDArray[Any]]] = []
        self.frames: list[Frame] = []
        self.imu: list[ImuSample] = []
        self.edges: list[Trigger] = []
        self.gaps = 0
        until_us = 0
        for packet in packets:
            assert packet.encoding is Encoding.ARRAY
            columns.append([column.copy() for column in event_columns(packet.data)])
            self.frames += packet.frames
            self.imu += packet.imu
            self.edges += packet.triggers
            self.gaps += packet.gap_before
            assert packet.complete_until_us is not None
            assert packet.complete_until_us >= until_us, "a promise is never taken back"
            assert columns[-1][0].min(initial=until_us) >= until_us, "what was promised complete stays so"
            until_us = packet.complete_until_us
        self.columns = [np.concatenate(column).tolist() for column in zip(*columns, strict=True)]


class Rig(Plugged):
    """An emulated DAVIS346, plugged in and open; its clock goes on from test to test."""

    def __init__(self, bus: usbfs.Bus) -> None:
        self.davis = Davis346()
        self.now_us, self.words, self.lost = 0, Encoder(), False
        super().__init__(bus, self.davis, SETTINGS)

    def later(self) -> int:
        """Return a time of the sensor's clock after all before."""
        self.now_us = max(self.now_us, self.words.now_us) + 200_000
        return self.now_us

    def begin_anew(self) -> None:
        """Deliver from a camera whose clock has just begun: so does the library's own."""
        self.lost = False
        self.now_us, self.words = 0, Encoder()
        self.camera.close()
        self.camera.start()

    def packets(self, last_us: int) -> Iterator[CameraPacket]:
        """Yield what is delivered until the camera has spoken of *last_us*."""
        return self.read_until(lambda packet: (packet.complete_until_us or -1) >= last_us, f"{last_us} us")

    def hear(self, *kinds: Any) -> Heard:
        """Let the camera say what was encoded, and that time went on; return what is delivered."""
        end_us = self.later()
        self.words.at(end_us)
        content = self.words.take()
        draws, at = np.random.default_rng(7), 0
        while at < len(content):  # packets of any size, also longer than a buffer: but the chip sends whole words
            size = 2 * int(draws.integers(1, 1 << 17))
            assert self.davis.send(content[at : at + size], *kinds)
            at += size
        return Heard(self.packets(end_us))


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    with on_a_bus(Rig) as made:
        yield made


@pytest.fixture
def started(rig: Rig) -> Iterator[Rig]:
    if rig.lost:
        rig.begin_anew()
    rig.camera.start()
    yield rig
    rig.camera.stop()


def random_events(begin_us: int, count: int) -> list[tuple[int, int, int, bool]]:
    """Return events over some turns of the 15-bit clock, bursts and silences among them."""
    draws = np.random.default_rng(3)
    t = (begin_us + np.cumsum(draws.choice([0, 0, 0, 1, 7, 200], count))).tolist()
    x, y, on = (draws.integers(0, most, count).tolist() for most in (WIDTH, HEIGHT, 2))
    return [(a, b, c, bool(d)) for a, b, c, d in zip(t, x, y, on, strict=True)]


def picture(seed: int) -> NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(0, 1024, (HEIGHT, WIDTH)).astype(np.uint16)


def test_it_is_what_was_plugged_in(rig: Rig) -> None:
    camera = rig.camera
    assert (camera.model, camera.serial, camera.geometry) == ("iniVation DAVIS 346", "00000499", Geometry(346, 260))
    assert isinstance(camera, (Biases, PixelMask, Inertial, Counters, Reopens))
    assert not isinstance(camera, (HardwareRoi, Temperature, TriggerInput))
    assert rig.davis.registers[EXPOSURE] == 700 * ADC_MHZ
    assert rig.davis.registers[FRAME_INTERVAL] == 20_000 * ADC_MHZ


def test_every_event_of_a_known_list_arrives(started: Rig) -> None:
    events = random_events(started.later(), 60_000)
    started.words.events(events)
    heard = started.hear("events")
    assert heard.columns == [list(column) for column in zip(*events, strict=True)]
    assert heard.gaps == 0
    counters = started.camera.counters
    assert (counters["usb_packets_dropped"], counters["usb_overflows"], counters["lost_events"]) == (0, 0, 0)


def test_frames_inertia_and_events_share_a_clock(started: Rig) -> None:
    words, t = started.words, started.later()
    words.inertia(t, Sample((8192, -100, 7), 334, (655, 0, -1)))
    words.events([(t + 1, 345, 259, True), (t + 1, 0, 259, False)])
    words.frame((t + 40_000, t + 41_000, t + 41_700, t + 50_000), picture(1))
    words.inertia(t + 51_000, Sample((0, 0, -8192), -334, (-32768, 32767, 0)))
    heard = started.hear("events", "frames", "imu")
    assert heard.columns == [[t + 1, t + 1], [345, 0], [259, 259], [True, False]]
    (frame,) = heard.frames
    assert (frame.t_us, frame.exposure_us, frame.available_us) == (t + 41_350, 700, t + 50_000)
    np.testing.assert_array_equal(frame.pixels, picture(1) << 6)
    first, second = heard.imu
    assert (first.t_us, second.t_us) == (t, t + 51_000)
    assert first.acceleration_m_s2 == pytest.approx((8192 * G_M_S2, -100 * G_M_S2, 7 * G_M_S2))
    assert first.rotation_rad_s == pytest.approx((655 * RAD_S, 0, -RAD_S))
    assert first.temperature_c == pytest.approx(22.0, abs=0.01)
    assert second.rotation_rad_s == pytest.approx((-32768 * RAD_S, 32767 * RAD_S, 0))
    assert isinstance(started.camera, Inertial)
    started.camera.enable_imu(on=False)
    words.inertia(started.now_us, Sample((0, 0, 0), 0, (0, 0, 0)))
    assert started.hear("imu").imu == []
    started.camera.enable_imu(on=True)


@needs_shared
def test_a_recordings_worth_arrives(started: Rig) -> None:
    """All events and inertial samples of a real DAVIS346's recording, and every sixth of its frames."""
    with closing(open_recording(RECORDINGS / "davis346_frames_events.aedat4")) as reader:
        chunks = list(EventStream(reader).chunks())
    columns = [np.concatenate([chunk[k] for chunk in chunks]) for k in range(4)]
    begin_us = int(columns[0][0]) - started.later() - 100_000
    events = [(t - begin_us, x, y, bool(p)) for t, x, y, p in zip(*(c.tolist() for c in columns), strict=True)]
    frames = [frame for chunk in chunks for frame in chunk.frames][::6]
    inertia = [one for chunk in chunks for one in chunk.imu]
    say_all(started.words, events, frames, inertia, begin_us)
    heard = started.hear("events", "frames", "imu")
    assert heard.gaps == 0
    assert sorted(zip(*heard.columns, strict=True)) == sorted(events)
    assert len(heard.frames) == len(frames) == 10
    for found, sent in zip(heard.frames, frames, strict=True):
        np.testing.assert_array_equal(found.pixels, sent.pixels.astype(np.uint16) << 8)
        assert found.exposure_us == sent.exposure_us
        assert found.t_us == sent.t_us - begin_us
    assert [one.t_us for one in heard.imu] == [one.t_us - begin_us for one in inertia]
    np.testing.assert_allclose(
        [one.acceleration_m_s2 for one in heard.imu], [one.acceleration_m_s2 for one in inertia], atol=0.51 * G_M_S2
    )
    np.testing.assert_allclose(
        [one.rotation_rad_s for one in heard.imu], [one.rotation_rad_s for one in inertia], atol=0.51 * RAD_S
    )


def say_all(words: Encoder, events: list[Any], frames: list[Frame], inertia: list[ImuSample], begin_us: int) -> None:
    """Put a recording into words, each thing at its time."""
    sayings: list[tuple[int, Callable[..., None], tuple[Any, ...]]] = [
        (one[0], words.events, ([one],)) for one in events
    ]
    for frame in frames:
        open_us = frame.t_us - frame.exposure_us // 2 - begin_us
        times_us = (open_us - 50, open_us, open_us + frame.exposure_us, frame.available_us - begin_us)
        blocks = frame_blocks(times_us, frame.pixels.astype(np.uint16) << 2)
        sayings += [(t_us, words.block, (t_us, block)) for t_us, block in blocks]
    for one in inertia:
        acceleration, rotation = (
            tuple(round(axis / step) for axis in axes)
            for axes, step in ((one.acceleration_m_s2, G_M_S2), (one.rotation_rad_s, RAD_S))
        )
        t_us = one.t_us - begin_us
        sayings.append((t_us, words.inertia, (t_us, Sample(acceleration, 0, rotation))))
    for _, say, arguments in sorted(sayings, key=itemgetter(0)):
        say(*arguments)


def test_biases_and_masks_reach_the_registers(started: Rig) -> None:
    registers, camera = started.davis.registers, started.camera
    normal = registers[ON_BIAS]
    assert isinstance(camera, Biases)
    camera.apply_biases(BiasSet.EXPOSE)
    started.wait_for(lambda: registers[ON_BIAS] != normal)
    camera.apply_biases(BiasSet.FOCUS)
    started.wait_for(lambda: registers[ON_BIAS] == normal)
    assert isinstance(camera, PixelMask)
    assert camera.set_mask([(300, 200), (0, 1)] * 5) == 8
    started.wait_for(lambda: started.davis.read(MASKED_COLUMNS) == [300, 0] * 4)
    started.wait_for(lambda: started.davis.read(MASKED_ROWS) == [200, 1] * 4)
    camera.set_mask([])
    started.wait_for(lambda: started.davis.read(MASKED_COLUMNS) == [WIDTH] * 8)
    assert registers[RUN["frames"]] == 1, "none of this stops the frames"


def test_the_library_reads_edges_but_leaves_their_detector_off(started: Rig) -> None:
    """Were they sent, they would arrive; a DAVIS346 sends none that is not told to, and this library never tells it."""
    assert not started.davis.send(b"", "edges")
    t = started.later()
    started.words.edge(t, rising=True)
    started.words.edge(t + 200, rising=False)
    heard = started.hear()
    assert [(edge.t_us, edge.id, edge.rising) for edge in heard.edges] == [(t, 0, True), (t + 200, 0, False)]


def test_what_the_usb_loses_is_a_gap_and_counted(rig: Rig) -> None:
    """With one buffer more than are under way, whole buffers of events come faster than they are decoded."""
    rig.lost = True
    rig.camera.close()
    with closing(neuromorphic.open_camera({**SETTINGS, "usb_packets": 33}, MonotonicClock())) as camera:
        camera.start()
        words, gaps, number = Encoder(), 0, 0
        burst = np.full(WORDS_OF_A_BUFFER - 1, ON | 5, "<u2")
        burst[0] = ROW | 7
        until = time.monotonic() + PATIENCE_S
        while gaps == 0 or not (camera.counters["usb_packets_dropped"] and camera.counters["usb_overflows"]):
            assert time.monotonic() < until, "nothing was lost"
            if rig.davis.unsent < 20:
                number += 1
                words.block(1000 * number, burst)
                rig.davis.send(words.take(), "events")
            packet = camera.read(0)
            gaps += packet is not None and packet.gap_before
    rig.davis.forget()


def test_a_camera_that_another_program_holds_says_so(rig: Rig) -> None:
    rig.lost = True
    rig.camera.close()
    rig.bus.claimed.set()
    try:
        with pytest.raises(CameraError, match=r"another program holds it; close that one first, `elpd check` names it"):
            neuromorphic.open_camera(SETTINGS, MonotonicClock())
    finally:
        rig.bus.claimed.clear()


def test_unplugged_and_plugged_in_again(started: Rig) -> None:
    """What comes back has its chip mounted another way round; pictures stand as they stood."""
    camera = started.camera
    before = camera.counters["reopened"]
    started.lost = True
    started.bus.unplug()
    with pytest.raises(CameraError, match=r"unplugged \(no device\)"):
        started.wait_for(lambda: False)
    with pytest.raises(CameraError, match="none found"):
        camera.start()
    started.davis = Davis346(aps_orientation=0b101)
    started.bus.plug(started.davis)
    started.reopen()
    started.now_us, started.words = 0, Encoder()
    started.words.frame((1000, 2000, 2700, 9000), picture(2), orientation=0b101)
    (frame,) = started.hear("frames").frames
    np.testing.assert_array_equal(frame.pixels, picture(2) << 6)
    assert camera.counters["reopened"] == before + 1


def test_a_stalled_endpoint_is_a_lost_camera(started: Rig) -> None:
    started.davis.stall()
    with pytest.raises(CameraError, match="its USB endpoint stalled; unplug it and plug it in again"):
        started.wait_for(lambda: False)
    started.begin_anew()
    started.words.events([(1000, 2, 3, True)])
    assert started.hear("events").columns == [[1000], [2], [3], [True]]
