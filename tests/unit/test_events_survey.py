"""Walking over words without decoding them: time, triggers, events, and what the rate controller held back."""

from contextlib import closing
from typing import Any

import naive
import numpy as np
import pytest
from elpd_drivers.formats import raw
from hypothesis import given, settings
from shared import RECORDINGS, needs_shared
from streams import cuts, evt2_words, evt3_words, evt21_words, pieces

from elpd.errors import UsageError
from elpd.events.evt2 import Evt2Decoder, Evt21Decoder
from elpd.events.survey import Survey
from elpd.records import Encoding, Geometry, Trigger


def taken(survey: Survey, words: Any, at: list[int]) -> tuple[Any, int, int, list[Trigger]]:
    each = [survey.take(piece) for piece in pieces(words, at)]
    edges = [edge for one in each for edge in one.triggers]
    return each[-1].time_us, sum(one.events for one in each), sum(one.dropped for one in each), edges


@settings(max_examples=300)
@given(evt3_words(), cuts)
def test_evt3_equals_its_twin_for_any_words_and_cuts(words: Any, at: list[int]) -> None:
    words = np.array(words, np.uint16)
    time_us, events, dropped, edges = taken(Survey(Encoding.EVT3), words, at)
    assert (time_us, events, dropped) == naive.survey_evt3(words)
    items, _, _ = naive.decode_evt3(words, 1, 1)
    assert edges == [Trigger(item[1], item[2], bool(item[3])) for item in items if item[0] == "trigger"]


@pytest.mark.parametrize("encoding", [Encoding.EVT2, Encoding.EVT21])
def test_the_older_encodings_agree_with_their_decoders(encoding: Encoding) -> None:
    decoder_type, strategy, dtype = {
        Encoding.EVT2: (Evt2Decoder, evt2_words(), np.uint32),
        Encoding.EVT21: (Evt21Decoder, evt21_words(), np.uint64),
    }[encoding]

    @settings(max_examples=150)
    @given(strategy, cuts)
    def agree(words: Any, at: list[int]) -> None:
        words = np.array(words, dtype)
        decoder = decoder_type(Geometry(2048, 2048))
        whole = decoder.feed(words)
        time_us, events, dropped, edges = taken(Survey(encoding), words, at)
        assert (time_us, events, dropped) == (decoder.time_us, whole.t.size, 0)
        assert edges == list(decoder.triggers)

    agree()


PAIR = [0xE014, 0xF064, 0xF000, 0x7000, 0xE016, 0xF03C, 0xF000, 0x7000]  # 100 came, 60 went


def test_what_the_rate_controller_drops_is_the_difference_of_its_counts() -> None:
    survey = Survey(Encoding.EVT3)
    words = np.array([0x8001, *PAIR, *PAIR], np.uint16)
    assert survey.take(words).dropped == 80
    assert survey.take(words[:9]).dropped == 40
    assert survey.take(words[:5]).dropped == 0, "half a pair says nothing yet"
    assert survey.take(words[5:9]).dropped == 40


def test_a_pair_that_a_loss_cut_apart_says_nothing() -> None:
    survey = Survey(Encoding.EVT3)
    survey.take(np.array([0x8001, *PAIR[:4]], np.uint16))
    survey.gap()
    assert survey.take(np.array([0x8001, *PAIR[4:], *PAIR], np.uint16)).dropped == 40


def test_arrays_are_refused() -> None:
    with pytest.raises(UsageError, match="not words"):
        Survey(Encoding.ARRAY)


@needs_shared
def test_a_real_recording_has_dropped_nothing() -> None:
    survey, events, dropped = Survey(Encoding.EVT3), 0, 0
    with closing(raw.FORMAT.open(RECORDINGS / "evk4_10s.raw")) as reader:
        for packet in reader.packets():
            one = survey.take(packet.data)
            events, dropped, time_us = events + one.events, dropped + one.dropped, one.time_us
    assert (events, dropped) == (1_218_618, 0)
    assert time_us is not None
    assert 0 <= time_us - 21_968_221 < 1_000
