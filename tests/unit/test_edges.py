"""Trigger edges, read off a stream beside its events, at whatever packet a reader comes in."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from elpd.events.edges import EdgeReader
from elpd.events.evt3_encode import HIGH_REPEAT_US, Evt3Encoder
from elpd.records import CameraPacket, Encoding, Trigger
from elpd.units import HostNs, SensorUs

SPAN_US = 1000


def stream(edges: list[Trigger], begin_us: int, packets: int) -> list[CameraPacket]:
    """Return packets of a millisecond each, with an event beside every edge."""
    encoder, made = Evt3Encoder(64), []
    at = np.zeros(1, np.uint16)
    for number in range(packets):
        end_us = begin_us + (number + 1) * SPAN_US
        words = [encoder.encode_time(end_us - SPAN_US).copy()]
        for edge in edges:
            if end_us - SPAN_US <= edge.t_us < end_us:
                words.append(encoder.encode(np.array([edge.t_us]), at, at, np.ones(1, np.uint8)).copy())
                words.append(encoder.encode_trigger(edge.t_us, edge.id, rising=edge.rising).copy())
        words.append(encoder.encode_time(end_us).copy())
        made.append(CameraPacket(np.concatenate(words), Encoding.EVT3, HostNs(0), SensorUs(end_us)))
    return made


@settings(max_examples=50, deadline=None)
@example([(4000, 0, False)], 5000, 4)
@example([(1001, 0, False), (1016, 0, True)], 5000, 1)
@given(
    st.lists(st.tuples(st.integers(0, 7999), st.integers(0, 3), st.booleans()), max_size=20),
    st.sampled_from([5000, (1 << 24) - 3500, 5 * (1 << 24) - 3500]),
    st.integers(0, 4),
)
def test_every_edge_is_read_once_with_the_streams_own_time(
    drawn: list[tuple[int, int, bool]], begin_us: int, first: int
) -> None:
    edges = [Trigger(SensorUs(begin_us + t), channel, rising) for t, channel, rising in sorted(drawn)]
    reader, read = EdgeReader(), []
    for packet in stream(edges, begin_us, 8)[first:]:
        read += reader.of(packet)
    came_us = begin_us + first * SPAN_US
    heard = [edge for edge in edges if edge.t_us >= came_us]
    # Who comes in later knows no time until the camera repeats it, so an edge before that has none.
    dated = [edge for edge in heard if first == 0 or edge.t_us >= came_us + HIGH_REPEAT_US]
    assert read[len(read) - len(dated) :] == dated
    assert [edge for edge in heard if edge in read] == read


def test_edges_that_travel_beside_an_array_are_handed_on() -> None:
    edge = Trigger(SensorUs(7), 0, rising=True)
    packet = CameraPacket(np.empty(0), Encoding.ARRAY, HostNs(0), SensorUs(10), triggers=(edge,))
    assert EdgeReader().of(packet) == (edge,)
