"""A live camera's bytes as packets: whole words, dates, losses, and a clock that must not jump."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from elpd_drivers.cameras.words import STEP_BACK_US, WordStream
from hypothesis import given, settings
from hypothesis import strategies as st

from elpd.errors import CameraError
from elpd.records import Encoding

MS = 1_000_000


def words_at(t_us: int, events: int = 3) -> bytes:
    time_words = [0x8000 | t_us >> 12 & 0xFFF, 0x6000 | t_us & 0xFFF]
    return np.array([*time_words, 0x0005, *(0x2800 | x for x in range(events))], "<u2").tobytes()


def test_words_that_a_packet_cuts_apart_are_whole_in_the_next() -> None:
    stream, body = WordStream(Encoding.EVT3), words_at(5000) + words_at(6000)
    packets = [stream.captured(body[at : at + 5], 0) for at in range(0, len(body), 5)]
    assert b"".join(np.asarray(packet.data).tobytes() for packet in packets) == body
    assert sum(packet.events for packet in packets) == 6
    assert [packet.complete_until_us for packet in packets][-1] == 6000 - STEP_BACK_US


def test_after_a_loss_half_a_word_belongs_to_nothing() -> None:
    stream = WordStream(Encoding.EVT3)
    stream.captured(words_at(5000) + b"\x01", 0)
    packet = stream.captured(words_at(6000), 0, gap_before=True)
    assert np.asarray(packet.data).tobytes() == words_at(6000)
    assert packet.gap_before


def test_time_goes_on_over_the_turns_of_the_sensor_s_clock() -> None:
    """Twenty-four bits turn over every 16.78 s; a packet a second keeps count for ever."""
    stream = WordStream(Encoding.EVT3)
    for second in range(1, 60):
        packet = stream.captured(words_at(second * 1_000_000), second * 1000 * MS)
        assert packet.complete_until_us == second * 1_000_000 - STEP_BACK_US


def test_a_step_back_of_some_microseconds_is_the_encoding_s_own() -> None:
    stream = WordStream(Encoding.EVT3)
    assert stream.captured(words_at(5_000_011), 0).complete_until_us == 5_000_011 - STEP_BACK_US
    assert stream.captured(words_at(5_000_000), 0).complete_until_us == 5_000_011 - STEP_BACK_US


@pytest.mark.parametrize(("then_us", "later_ms"), [(20, 10), (4_000_000, 10), (9_000_000, 500)])
def test_a_clock_that_jumps_either_way_is_another_epoch(then_us: int, later_ms: int) -> None:
    stream = WordStream(Encoding.EVT3)
    stream.captured(words_at(5_000_000), 0)
    with pytest.raises(CameraError, match=r"its clock jumped by [+-]\d+\.\d{3} s where 0\.\d+ s had passed"):
        stream.captured(words_at(then_us), later_ms * MS)


def test_a_host_that_slept_is_no_jump() -> None:
    stream = WordStream(Encoding.EVT3)
    stream.captured(words_at(1_000_000), 0)
    assert stream.captured(words_at(4_000_000), 3500 * MS).complete_until_us == 4_000_000 - STEP_BACK_US
    assert stream.captured(words_at(4_100_000), 9000 * MS).complete_until_us == 4_100_000 - STEP_BACK_US


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.binary(max_size=300), st.booleans()), max_size=12))
def test_no_bytes_break_it(pieces: list[tuple[bytes, bool]]) -> None:
    stream, until_us = WordStream(Encoding.EVT3), 0
    for data, gap in pieces:
        try:
            packet: Any = stream.captured(data, 0, gap_before=gap)
        except CameraError as error:
            assert "its clock jumped" in str(error)  # noqa: PT017  (either end is right; the other one goes on)
            return
        assert len(packet.data) <= (len(data) + 1) // 2
        assert packet.events <= 12 * len(packet.data)
        if packet.complete_until_us is not None:
            assert packet.complete_until_us >= until_us
            until_us = packet.complete_until_us
