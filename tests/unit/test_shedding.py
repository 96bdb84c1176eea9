"""What is let go while too much waits, and what is still known of it."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import evt2_words, evt3_stream, evt21_words, seeds

from elpd.events.evt2_encode import Evt2Encoder, Evt21Encoder
from elpd.events.evt3_encode import Evt3Encoder
from elpd.events.stream import DECODERS
from elpd.focus.shedding import MOST_PACKETS, PATIENCE, Shedding, _only_time
from elpd.records import CameraPacket, Encoding, Geometry, Roi
from elpd.vision.elp import ElpWindows

GEOMETRY = Geometry(64, 48)
ROI = Roi(16, 12, 32, 24)
SLICE_US = 500
ENCODERS = {
    Encoding.EVT3: lambda: Evt3Encoder(64).encode,
    Encoding.EVT2: lambda: Evt2Encoder().encode,
    Encoding.EVT21: lambda: Evt21Encoder().encode,
    Encoding.ARRAY: lambda: packed,
}


def packed(t: Any, x: Any, y: Any, p: Any) -> Any:
    return np.rec.fromarrays([t, x, y, p], names="t,x,y,p")


def slices(encoding: Encoding, backlogs: list[int], *, events: int = 200) -> Any:
    """Packets of 500 us with random events, and per packet how many of them are inside the ROI."""
    rng = np.random.default_rng(5)
    encode = ENCODERS[encoding]()
    packets, inside = [], []
    for k, backlog in enumerate(backlogs):
        t = np.sort(rng.integers(SLICE_US * k, SLICE_US * (k + 1), events))
        x, y, p = rng.integers(0, 64, events), rng.integers(0, 48, events), rng.integers(0, 2, events)
        inside.append(int(((x >= 16) & (x < 48) & (y >= 12) & (y < 36)).sum()))
        data = encode(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8)).copy()
        packets.append(CameraPacket(data, encoding, 0, complete_until_us=SLICE_US * (k + 1), backlog=backlog))
    return packets, inside


@pytest.mark.parametrize("encoding", list(Encoding))
def test_windows_of_what_was_heard_are_what_they_would_have_been(encoding: Encoding) -> None:
    packets, inside = slices(encoding, [0, 0, 300, 250, 150, 11, 10, 3, 0, 0])
    weights = np.random.default_rng(1).integers(-100, 100, (48, 64))
    member = np.zeros((48, 64), bool)
    member[12:36, 16:48] = True
    whole, shed = (ElpWindows(weights, member, window_us=SLICE_US, origin_us=0) for _ in range(2))
    shedding = Shedding(ROI)
    taken = [shedding.take(packet) for packet in packets]
    expected = [row for packet in packets for row in whole.feed(packet).tolist()]
    got = [row for packet in taken for row in shed.feed(packet).tolist()]
    assert [row[:2] for row in got] == [row[:2] for row in expected]
    lost = [packet.lost_events for packet in taken]
    let_go = [k for k, count in enumerate(lost) if count]
    assert let_go == [2, 3, 4, 5]  # until half the limit of 20 packets waits
    heard = {k for k in range(10) if k not in let_go}
    for k in heard - {6}:
        assert got[k] == expected[k]
    assert [got[k][2:] for k in let_go] == [(0, 0, 0, 0, 0)] * 4
    for k in let_go:
        assert abs(lost[k] - inside[k]) <= 12  # but for the events before the slice's first row
    assert [packet.gap_before for packet in taken] == [k in (2, 3, 4, 5, 6) for k in range(10)]
    assert shedding.shed_us == 4 * SLICE_US
    assert (shedding.within(0, 5000), shedding.within(1250, 1500), shedding.within(0, 1000)) == (2000, 250, 0)


def test_without_a_promise_packets_are_counted() -> None:
    shedding = Shedding(ROI)
    assert losses(shedding, [*[MOST_PACKETS + 1] * PATIENCE]) == [0] * PATIENCE
    backlogs = (MOST_PACKETS + 1, MOST_PACKETS // 2 + 1, MOST_PACKETS // 2, MOST_PACKETS)
    assert losses(shedding, backlogs) == [1, 1, 0, 0]
    assert shedding.shed_us == 0


def test_a_backlog_that_is_made_up_for_costs_nothing() -> None:
    shedding = Shedding(ROI)
    assert losses(shedding, range(9 * MOST_PACKETS, 0, -1)) == [0] * 9 * MOST_PACKETS


def losses(shedding: Shedding, backlogs: Iterable[int]) -> list[int]:
    word = np.array([0x8001, 0x0010, 0x2014], np.uint16)
    packets = (CameraPacket(word, Encoding.EVT3, 0, backlog=backlog) for backlog in backlogs)
    return [shedding.take(packet).lost_events for packet in packets]


@settings(max_examples=200)
@given(data=st.data(), encoding=st.sampled_from([Encoding.EVT3, Encoding.EVT2, Encoding.EVT21]), seed=seeds)
def test_the_time_that_is_handed_on_is_that_of_all_words(data: Any, encoding: Encoding, seed: int) -> None:
    if encoding is Encoding.EVT3:
        words = evt3_stream(seed, 200, 64, 48)
    elif encoding is Encoding.EVT2:
        words = np.array(data.draw(evt2_words()), np.uint32)
    else:
        words = np.array(data.draw(evt21_words()), np.uint64)
    cut = data.draw(st.integers(0, len(words)))
    whole, short = (DECODERS[encoding](GEOMETRY) for _ in range(2))
    whole.feed(words[:cut])
    short.feed(words[:cut])
    whole.feed(words[cut:])
    short.feed(_only_time(words[cut:], encoding))
    if encoding is Encoding.EVT3:
        assert (whole.time_us or 0) % 2**24 == (short.time_us or 0) % 2**24
    elif whole.time_us is not None:
        assert short.time_us is not None
        assert whole.time_us // 64 % 2**28 == short.time_us // 64 % 2**28
