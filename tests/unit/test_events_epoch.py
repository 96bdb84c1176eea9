"""A decoder that begins late knows which turn of the camera's clock it is in: EVT3's time turns over every 16.78 s."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from elpd.events.evt3_encode import Evt3Encoder
from elpd.events.stream import PacketDecoder
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs, SensorUs
from elpd.vision.elp import ElpWindows

if TYPE_CHECKING:
    from numpy.typing import NDArray

GEOMETRY = Geometry(32, 16)
TURN_US = 1 << 24


def packet(times_us: list[int], until_us: int) -> CameraPacket:
    """Return a packet of a camera that has been running since long before."""
    t = np.array(times_us, np.int64)
    x: NDArray[np.uint16] = np.full(t.size, 5, np.uint16)
    encoder = Evt3Encoder(GEOMETRY.width)
    if times_us[0] >= 4096:
        encoder.encode_time(times_us[0] // 4096 * 4096 - 1)
    words = encoder.encode(t, x, x, np.ones(t.size, np.uint8)).copy()
    words = np.concatenate([words, encoder.encode_time(until_us)])
    return CameraPacket(words, Encoding.EVT3, HostNs(0), complete_until_us=SensorUs(until_us))


@pytest.mark.parametrize("begin_us", [0, 7, TURN_US - 300, TURN_US - 1, TURN_US, 5 * TURN_US + 12_345, 90 * TURN_US])
def test_late_decoders_and_windows_agree_with_the_packets_promise(begin_us: int) -> None:
    times = [begin_us, begin_us + 100, begin_us + 400]
    one = packet(times, begin_us + 500)
    assert PacketDecoder(GEOMETRY).feed(one).t.tolist() == times
    windows = ElpWindows(np.ones((16, 32), np.int16), window_us=50)
    rows = windows.feed(one)
    assert rows["end_us"][-1] <= begin_us + 500
    assert rows["begin_us"][0] <= begin_us
    assert int((rows["n_on"] + rows["n_off"]).sum()) == 3


def test_later_packets_count_turns_as_before() -> None:
    decoder = PacketDecoder(GEOMETRY)
    decoder.feed(packet([3 * TURN_US - 5], 3 * TURN_US - 2))
    assert decoder.feed(packet([3 * TURN_US + 4100], 3 * TURN_US + 4200)).t.tolist() == [3 * TURN_US + 4100]


def test_a_stream_that_counts_its_turns_from_zero_is_not_put_off() -> None:
    encoder = Evt3Encoder(GEOMETRY.width)
    at = 3 * TURN_US + 77
    x = np.array([5], np.uint16)
    words = encoder.encode(np.array([at], np.int64), x, x, np.ones(1, np.uint8)).copy()
    one = CameraPacket(words, Encoding.EVT3, HostNs(0), complete_until_us=SensorUs(at + 100))
    assert PacketDecoder(GEOMETRY).feed(one).t.tolist() == [at]


def test_without_a_promise_time_begins_in_the_first_turn() -> None:
    one = packet([TURN_US + 5], TURN_US + 10)
    bare = CameraPacket(one.data, one.encoding, one.received_ns)
    assert PacketDecoder(GEOMETRY).feed(bare).t.tolist() == [5]
