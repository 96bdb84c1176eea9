"""The encoder: what it writes decodes to what it was given, here and elsewhere."""

from typing import Any

import evt3
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.errors import UsageError
from elpd.events.evt3 import Evt3Decoder
from elpd.events.evt3_encode import WORDS_PER_EVENT, Evt3Encoder, encode, new_encoder_state
from elpd.records import Geometry

WIDTH, HEIGHT = 346, 260


def random_events(seed: int, n: int, span_us: int, *, by_row: bool) -> list[Any]:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, span_us, n))
    if by_row:
        t = t // 100 * 100
    x, y, p = rng.integers(0, WIDTH, n), rng.integers(0, 3 if by_row else HEIGHT, n), rng.integers(0, 2, n)
    if by_row:
        order = np.lexsort((x, p, y, t))
        t, x, y, p = t[order], x[order], y[order], p[order]
    return [t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8)]


@given(st.integers(0, 2**32 - 1), st.integers(0, 400), st.sampled_from([50, 3000, 10**7, 10**9]), st.data())
def test_encoding_and_decoding_give_the_events_back(seed: int, n: int, span_us: int, data: Any) -> None:
    events = random_events(seed, n, span_us, by_row=bool(seed % 2))
    cut = data.draw(st.integers(0, n))
    encoder, decoder = Evt3Encoder(WIDTH), Evt3Decoder(Geometry(WIDTH, HEIGHT))
    pieces = [[column[:cut] for column in events], [column[cut:] for column in events]]
    decoded = [[c.copy() for c in decoder.feed(encoder.encode(*piece))] for piece in pieces]
    for column, first, second in zip(events, *decoded, strict=True):
        assert np.concatenate((first, second)).tolist() == column.tolist()


def test_the_evt3_package_reads_what_we_write() -> None:
    events = random_events(3, 20_000, 4_000, by_row=True)
    words = Evt3Encoder(WIDTH).encode(*events)
    assert ((words >> 12) == 0x4).any()
    theirs = evt3.Decoder(WIDTH, HEIGHT).feed(words.tobytes())
    for ours, column in zip(events, (theirs.t, theirs.x, theirs.y, theirs.p), strict=True):
        assert (np.asarray(column).astype(np.int64) == ours).all()


def test_dense_rows_cost_far_less_than_a_word_per_event() -> None:
    n = 1280
    t, y, p = np.full(n, 100), np.full(n, 5, np.uint16), np.ones(n, np.uint8)
    words = Evt3Encoder(1280).encode(t, np.arange(n, dtype=np.uint16), y, p)
    assert words.size <= 4 + 1 + 3 * n // 32


def test_vectors_never_pass_the_width() -> None:
    n = 346
    t, y, p = np.full(n, 100), np.full(n, 5, np.uint16), np.ones(n, np.uint8)
    words = Evt3Encoder(346).encode(t, np.arange(n, dtype=np.uint16), y, p)
    bases = words[(words >> 12) == 0x3] & 0x7FF
    assert bases.max(initial=0) + 32 * ((words >> 12) == 0x5).sum() <= 346


def test_time_and_triggers_can_be_sent_alone() -> None:
    encoder, decoder = Evt3Encoder(64), Evt3Decoder(Geometry(64, 64))
    decoder.feed(encoder.encode_time(70_000_000))
    assert decoder.time_us == 70_000_000
    decoder.feed(encoder.encode_trigger(70_000_123, 6, rising=True))
    assert [(edge.t_us, edge.id, edge.rising) for edge in decoder.triggers] == [(70_000_123, 6, True)]


def test_a_full_output_is_told_and_never_passed() -> None:
    events = random_events(1, 50, 3000, by_row=False)
    out = np.full(50 * WORDS_PER_EVENT + 16, 7, np.uint16)
    for room in range(0, 50 * WORDS_PER_EVENT, 7):
        encode(*events, new_encoder_state(WIDTH), out[:room])
        assert (out[50 * WORDS_PER_EVENT :] == 7).all()
    assert encode(*events, new_encoder_state(WIDTH), out[:20]) == -1


@pytest.mark.parametrize("t", [[-1], [10**12]])
def test_times_that_evt3_cannot_carry_are_refused(t: list[int]) -> None:
    with pytest.raises(UsageError, match="one day"):
        Evt3Encoder(64).encode(np.array(t), np.array([0]), np.array([0]), np.array([1]))
