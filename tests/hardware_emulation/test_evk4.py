"""The unmodified neuromorphic-drivers, its camera emulated on the USB, our backend over it: from bytes to events."""

from __future__ import annotations

import hashlib
import itertools
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest
from elpd_drivers.cameras import neuromorphic
from elpd_drivers.cameras.words import STEP_BACK_US
from hardware_emulation import plugged
from hardware_emulation.evk4 import BIAS_DIFF_ON, DIGITAL_MASK, RATE_ENABLE, RATE_EVENTS, ROI_X, ROI_Y, Evk4
from hardware_emulation.plugged import PATIENCE_S, PATIENT, Plugged, on_a_bus
from shared import RECORDINGS, needs_shared

from elpd.errors import CameraError, ConfigError, UsageError
from elpd.events.evt3 import Evt3Decoder
from elpd.ports import Biases, Counters, HardwareRoi, PixelMask, RateLimit, Reopens, Temperature, TriggerInput
from elpd.records import BiasSet, Encoding, Geometry, Roi
from elpd.timebase import MonotonicClock

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hardware_emulation import usbfs
    from numpy.typing import NDArray

    from elpd.records import CameraPacket

pytest.importorskip("neuromorphic_drivers")
pytestmark = plugged.marks

AFTER_THE_RECORDING_US = 22_000_000
TURN_US = 1 << 24
WIDTH, HEIGHT = 1280, 720
SETTINGS = {
    "serial": "00050567",
    "usb_packets": 48,
    **PATIENT,
    "rate_limit_mev_s": 20.0,
    "biases": {"expose": {"diff_on": 7}, "focus": {"diff_on": 3}},
}


class Rig(Plugged):
    """An emulated EVK4, plugged in and open."""

    def __init__(self, bus: usbfs.Bus) -> None:
        self.evk4, self.now_us = Evk4(), AFTER_THE_RECORDING_US
        super().__init__(bus, self.evk4, SETTINGS)

    def later(self) -> int:
        """Return a time of the sensor's clock after all before: tests may run in any order."""
        self.now_us += 200_000
        return self.now_us

    def packets(self, last_us: int) -> Iterator[CameraPacket]:
        """Yield what is delivered until the events of *last_us* have come."""

        def over(packet: CameraPacket) -> bool:
            until_us = packet.complete_until_us
            return until_us is not None and (until_us + STEP_BACK_US - last_us) % TURN_US < TURN_US // 2

        return self.read_until(over, f"{last_us} us")

    def streamed(self, pieces: Iterator[bytes]) -> Iterator[CameraPacket]:
        """Send piece after piece, each when the one before has arrived, and yield what comes."""
        on_its_way, until = 0, time.monotonic() + PATIENCE_S
        for piece in pieces:
            self.evk4.send(piece)
            on_its_way += len(piece)
            while on_its_way > 1:  # half a word waits for the other half
                assert time.monotonic() < until, f"{on_its_way} bytes did not come within {PATIENCE_S:g} s"
                packet = self.camera.read(0.02)
                if packet is not None:
                    on_its_way -= packet.data.nbytes
                    yield packet


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    """Open the emulated camera once: its driver sleeps through 2.5 s of that."""
    with on_a_bus(Rig) as made:
        yield made


@pytest.fixture
def started(rig: Rig) -> Iterator[Rig]:
    rig.camera.start()
    yield rig
    rig.camera.stop()


def words_at(t_us: int, count: int = 50) -> bytes:
    """Return *count* events of one microsecond as EVT3."""
    time_words = [0x8000 | t_us >> 12 & 0xFFF, 0x6000 | t_us & 0xFFF]
    return np.array([*time_words, 0x0005, *(0x2800 | x for x in range(count))], "<u2").tobytes()


def test_it_is_what_was_plugged_in(rig: Rig) -> None:
    camera = rig.camera
    assert (camera.model, camera.serial, camera.geometry) == ("Prophesee EVK4", "00050567", Geometry(WIDTH, HEIGHT))
    assert isinstance(camera, (HardwareRoi, Biases, PixelMask, Temperature, Counters, Reopens))
    assert not isinstance(camera, (TriggerInput, RateLimit)), "the library sets these when it opens, not later"
    assert camera.min_latency_us == neuromorphic.USB3_LATENCY_US + STEP_BACK_US
    assert rig.evk4.registers[RATE_ENABLE] & 1
    assert rig.evk4.registers[RATE_EVENTS] == 4000, "20 million a second, in periods of 200 us"
    assert rig.evk4.registers[BIAS_DIFF_ON] & 0xFF == 3
    assert camera.temperature_c() == pytest.approx(39.0)


@needs_shared
def test_a_real_recording_arrives_bit_for_bit_in_packets_of_any_size(started: Rig) -> None:
    content = (RECORDINGS / "evk4_10s.raw").read_bytes()
    body = b"".join(itertools.dropwhile(lambda line: line.startswith(b"%"), content.splitlines(keepends=True)))
    if started.now_us > AFTER_THE_RECORDING_US:  # its clock would jump back
        started.camera.close()
        started.camera.start()
    decoder = Evt3Decoder(Geometry(WIDTH, HEIGHT))
    received, columns, until_us = hashlib.sha256(), [], 0
    for packet in started.streamed(pieces(body)):
        assert packet.encoding is Encoding.EVT3
        assert (packet.gap_before, packet.lost_events) == (False, 0)
        received.update(packet.data)
        columns.append([column.copy() for column in decoder.feed(packet.data)])
        assert packet.complete_until_us is not None
        assert packet.complete_until_us >= until_us
        until_us = packet.complete_until_us
    assert received.hexdigest() == hashlib.sha256(body).hexdigest()
    t, x, y, on = (np.concatenate(column) for column in zip(*columns, strict=True))
    assert t.size == 1_218_618
    assert (t[0], x[0], y[0], on[0]) == (11_200_224, 484, 315, 1)
    digests = [digest(column, kind) for column, kind in ((t, "<u8"), (x, "<u2"), (y, "<u2"), (on, "u1"))]
    assert digests == ["5844f7335f33", "436762030fbc", "e7793490007f", "7829ba15f633"]
    counters = started.camera.counters
    assert (counters["usb_packets_dropped"], counters["rate_controller_dropped"]) == (0, 0)


def pieces(body: bytes) -> Iterator[bytes]:
    """Cut *body* anywhere: at odd places, too, and some pieces fill more than a buffer."""
    draws, at = np.random.default_rng(3), 0
    while at < len(body):
        size = int(draws.integers(1, 1 << 18))
        yield body[at : at + size]
        at += size


def digest(column: NDArray[np.generic], kind: str) -> str:
    return hashlib.sha3_224(np.ascontiguousarray(column.astype(kind)).tobytes()).hexdigest()[:12]


def test_windows_masks_and_biases_reach_the_registers(started: Rig) -> None:
    registers, camera = started.evk4.registers, started.camera
    assert isinstance(camera, HardwareRoi)
    camera.set_window(Roi(100, 20, 33, 10))
    # A bit of these registers switches a column or a row of the words off; they say nothing beyond the sensor.
    started.wait_for(lambda: open_lines(registers, ROI_X, WIDTH) == list(range(100, 133)))
    started.wait_for(lambda: open_lines(registers, ROI_Y, HEIGHT) == list(range(20, 30)))
    camera.set_window(None)
    started.wait_for(lambda: open_lines(registers, ROI_X, WIDTH) == list(range(WIDTH)))
    started.wait_for(lambda: open_lines(registers, ROI_Y, HEIGHT) == list(range(HEIGHT)))
    assert isinstance(camera, Biases)
    camera.apply_biases(BiasSet.EXPOSE)
    started.wait_for(lambda: registers[BIAS_DIFF_ON] & 0xFF == 7)
    camera.apply_biases(BiasSet.FOCUS)
    started.wait_for(lambda: registers[BIAS_DIFF_ON] & 0xFF == 3)
    assert isinstance(camera, PixelMask)
    assert camera.set_mask([(1026, 55)] * 70) == 64
    started.wait_for(lambda: registers.get(DIGITAL_MASK + 4 * 63, 0) == 1 << 31 | 55 << 16 | 1026)
    with pytest.raises(UsageError, match="pixel 1280,0 lies outside the sensor of 1280x720"):
        camera.set_mask([(1280, 0)])


def open_lines(registers: dict[int, int], first: int, count: int) -> list[int]:
    return [line for line in range(count) if not registers[first + 4 * (line // 32)] >> (line % 32) & 1]


def test_what_the_usb_loses_is_a_gap_and_counted(started: Rig) -> None:
    """The library is busy with a register while packets pour in: its ring of 48 overflows, ours is never reached."""
    evk4, camera = started.evk4, started.camera
    begin_us = started.later()
    evk4.send(words_at(begin_us))
    assert len(list(started.packets(begin_us))) == 1
    evk4.answering.clear()
    for number in range(200):
        evk4.send(words_at(begin_us + 100 + 10 * number))
    evk4.answer_when_sent()
    assert isinstance(camera, Temperature)
    assert camera.temperature_c() == pytest.approx(39.0)
    # The requests that found no room throw away what they bring before they are of use again.
    further = (words_at(begin_us + 10_000 + 500 * number) for number in range(200))
    gaps, seen = 0, 0
    while gaps == 0:
        evk4.send(next(further))
        packet = camera.read(0.01)
        if packet is not None:
            gaps, seen = gaps + packet.gap_before, seen + 1
    started.wait_for(lambda: camera.counters["usb_overflows"] > 0)
    assert 100 <= camera.counters["usb_packets_dropped"] < 300
    assert seen < 200
    evk4.forget()
    camera.close()  # with what is still on its way


def test_events_that_the_rate_controller_held_back_are_lost_events(started: Rig) -> None:
    pair = np.array([0xE014, 0xF064, 0xF000, 0x7000, 0xE016, 0xF03C, 0xF000, 0x7000], "<u2").tobytes()
    at_us = started.later()
    started.evk4.send(words_at(at_us) + pair)
    packets = list(started.packets(at_us))
    assert [(packet.gap_before, packet.lost_events) for packet in packets] == [(True, 40)]
    started.wait_for(lambda: started.camera.counters["rate_controller_dropped"] == 40)


def test_trigger_edges_come_with_their_packet(started: Rig) -> None:
    edges = np.array([0xA601, 0xA600], "<u2").tobytes()
    at_us = started.later()
    started.evk4.send(words_at(at_us) + edges)
    (packet,) = started.packets(at_us)
    # A stream that begins in the middle of the clock's turn counts turns from there.
    assert [(edge.t_us % TURN_US, edge.id, edge.rising) for edge in packet.triggers] == [
        (at_us % TURN_US, 6, True),
        (at_us % TURN_US, 6, False),
    ]


def test_unplugged_and_plugged_in_again(started: Rig) -> None:
    camera = started.camera
    before = camera.counters["reopened"]
    started.bus.unplug()
    with pytest.raises(CameraError, match=r"unplugged \(no device\)"):
        started.wait_for(lambda: False)
    with pytest.raises(CameraError, match="none found"):
        camera.start()
    started.evk4.registers.clear()
    started.bus.plug(started.evk4)
    started.reopen()
    at_us = started.later()
    started.evk4.send(words_at(at_us))
    (packet,) = started.packets(at_us)
    assert not packet.gap_before
    assert camera.counters["reopened"] == before + 1


def test_a_stalled_endpoint_is_a_lost_camera(started: Rig) -> None:
    started.evk4.stall()
    with pytest.raises(CameraError, match="its USB endpoint stalled; unplug it and plug it in again"):
        started.wait_for(lambda: False)


@pytest.mark.parametrize(
    ("settings", "error", "reason"),
    [
        ({"serial": "00000001"}, CameraError, r"none found \(asked for: 00000001; plugged in: prophesee evk4 00050567"),
        ({"model": "davis346"}, CameraError, r"asked for: davis346"),
        ({"biases": {"focus": {"on": 3}}}, ConfigError, r"camera\.biases\.focus\.on: this camera has no such bias"),
    ],
)
def test_a_table_that_does_not_fit_the_camera_says_so(
    rig: Rig, settings: dict[str, object], error: type[Exception], reason: str
) -> None:
    rig.camera.close()
    with pytest.raises(error, match=reason):
        neuromorphic.open_camera(settings, MonotonicClock())
