"""The ring between the capture process and the controller: what goes in comes out, or is counted."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
import pytest
from elpd_drivers.cameras.ring import Captured, RingMemory, RingReader, RingWriter
from hypothesis import given
from hypothesis import strategies as st

from elpd.records import Frame, ImuSample, Trigger
from elpd.units import SensorUs

if TYPE_CHECKING:
    from collections.abc import Iterator

    from elpd_drivers.cameras.ring import Taken


class Pair:
    def __init__(self, slots: int, capacity: int) -> None:
        self.memory, descriptor = RingMemory.make(slots, capacity)
        self.semaphore = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_SEMAPHORE)
        self.other = RingMemory(descriptor, slots, self.memory.capacity)
        os.close(descriptor)
        self.writer = RingWriter(self.other, self.semaphore)
        self.reader = RingReader(self.memory, self.semaphore)

    def close(self) -> None:
        os.close(self.semaphore)
        self.memory.close()
        self.other.close()


@pytest.fixture
def pair() -> Iterator[Pair]:
    made = Pair(slots=8, capacity=4096)
    yield made
    made.close()


def captured(number: int, size: int, events: int = 1) -> Captured:
    data = np.random.default_rng(number).integers(0, 256, size, np.uint8)
    return Captured(data, received_ns=number, complete_until_us=number if number % 2 else None, events=events)


def test_everything_a_packet_says_arrives(pair: Pair) -> None:
    frames = tuple(
        Frame(SensorUs(5), SensorUs(6), 7, np.arange(15, dtype=kind).reshape(3, 5)) for kind in (np.uint8, np.uint16)
    )
    edges = (Trigger(SensorUs(-3), 6, rising=True), Trigger(SensorUs(1 << 40), 0, rising=False))
    samples = (
        ImuSample(SensorUs(-7), (1.5, -2.25, 9.75), (0.125, 0.0, -0.5), 30.5),
        ImuSample(SensorUs(9), (0.0, 0.0, 0.0), (1e-3, 2e-3, 3e-3), -4.0),
    )
    sent = Captured(b"words", 11, 12, 13, frames, edges, gap_before=True, lost_events=14, backlog=15, imu=samples)
    assert pair.writer.publish(sent, generation=16)
    taken = pair.reader.take()
    assert taken is not None
    assert bytes(taken.data) == b"words"
    assert (taken.received_ns, taken.complete_until_us, taken.events, taken.generation) == (11, 12, 13, 16)
    assert (taken.gap_before, taken.lost_events, taken.backlog) == (True, 14, 15)
    assert taken.triggers == edges
    assert taken.imu == samples
    for frame, was in zip(taken.frames, frames, strict=True):
        assert (frame.t_us, frame.available_us, frame.exposure_us) == (5, 6, 7)
        assert frame.pixels.dtype == was.pixels.dtype
        np.testing.assert_array_equal(frame.pixels, was.pixels)
    assert pair.reader.take() is None


def test_what_does_not_fit_is_dropped_whole_and_told_with_the_next(pair: Pair) -> None:
    sent = [pair.writer.publish(captured(number, 900, events=10), 1) for number in range(7)]
    assert sent == [True] * 4 + [False] * 3
    assert pair.reader.waiting == 4
    assert (pair.writer.dropped_packets, pair.writer.dropped_events) == (3, 30)
    first = pair.reader.take()
    assert first is not None
    assert not first.gap_before
    assert not pair.writer.publish(captured(7, 900, events=10), 1), "a packet in the reader's hands keeps its place"
    for _ in range(3):
        pair.reader.take()
    pair.reader.take()
    assert pair.writer.publish(captured(8, 900), 1)
    after = pair.reader.take()
    assert after is not None
    assert (after.gap_before, after.lost_events) == (True, 40)


def test_a_delivery_begins_without_the_gaps_of_the_one_before(pair: Pair) -> None:
    for number in range(6):
        pair.writer.publish(captured(number, 900), 1)
    pair.writer.restart()
    while pair.reader.take() is not None:
        pass
    pair.writer.publish(captured(9, 10), 2)
    taken = pair.reader.take()
    assert taken is not None
    assert not taken.gap_before


def test_more_packets_than_places(pair: Pair) -> None:
    assert [pair.writer.publish(captured(number, 0), 1) for number in range(9)] == [True] * 8 + [False]


def test_a_packet_larger_than_the_ring_is_dropped_and_the_ring_goes_on(pair: Pair) -> None:
    assert not pair.writer.publish(captured(0, 5000), 1)
    assert pair.writer.publish(captured(1, 4096), 1)
    taken = pair.reader.take()
    assert taken is not None
    assert taken.gap_before


def test_notes_are_read_whole(pair: Pair) -> None:
    assert pair.reader.notes() == {}
    pair.writer.note({"usb_packets_dropped": 3})
    pair.writer.beat(99)
    assert pair.reader.notes() == {"usb_packets_dropped": 3}
    assert pair.reader.heartbeat_ns == 99


@given(st.lists(st.one_of(st.integers(0, 1500), st.none()), max_size=60))
def test_whatever_is_not_dropped_arrives_in_order_and_whole(steps: list[int | None]) -> None:
    """A number sends a packet of that size, ``None`` takes one; at the end the rest is taken."""
    pair = Pair(slots=8, capacity=4096)
    expected: list[tuple[int, bool, int]] = []
    lost, seen = 0, []

    def take() -> Taken | None:
        taken = pair.reader.take()
        if taken is not None:
            same = bytes(taken.data) == captured(taken.received_ns, len(taken.data)).data.tobytes()  # type: ignore[union-attr]
            assert same
            seen.append((taken.received_ns, taken.gap_before, taken.lost_events))
        return taken

    for number, step in enumerate(steps):
        if step is None:
            take()
        elif pair.writer.publish(captured(number, step, events=3), 1):
            expected.append((number, lost > 0, lost))
            lost = 0
        else:
            lost += 3
    while take() is not None:
        pass
    assert seen == expected
    pair.close()
