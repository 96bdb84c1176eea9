"""Real recordings: digests, agreement with another decoder, and what damage to them does."""

from typing import Any

import evt3
import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shared import RECORDINGS, needs_shared
from streams import opened, read_columns

from elpd.cli.decode import summarise
from elpd.events.evt3 import Evt3Decoder
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs
from elpd.vision.elp import ElpWindows

pytestmark = needs_shared

DIGESTS = {
    "evk4_10s.raw": (1_218_618, "5844f7335f33", "436762030fbc", "e7793490007f", "7829ba15f633"),
    "gen41_dense_vectors.raw": (219_596, "40fc435b407b", "c88bf5a9cd91", "2581d0ac206d", "9966c5454695"),
    "gen3_evt2.raw": (521_252, "9855ba39c1ba", "93fc6cff19b4", "07cfaef58e5f", "d2b5e9c4047f"),
    "evt3_with_triggers.raw": (82_469, "7cb9a0ca5219", "e76da4524482", "d13202d153b1", "2073c1baa64b"),
    "evk4_aperture_opening.raw": (929_421, "16904b9449ad", "467c46c1622d", "0fab904b7bf4", "d36aa327c3dd"),
}
HD = Geometry(1280, 720)


def summary_of(name: str) -> dict[str, Any]:
    with opened(RECORDINGS / name) as reader:
        return summarise(reader)


def payload(name: str) -> np.ndarray:
    with opened(RECORDINGS / name) as reader:
        return next(reader.packets(1 << 25)).data.copy()


@pytest.mark.parametrize("name", DIGESTS)
def test_the_digests_are_those_of_the_field(name: str) -> None:
    events, *digests = DIGESTS[name]
    summary = summary_of(name)
    assert summary["events"] == events
    assert list(summary["digest"].values()) == digests
    assert (summary["width"], summary["height"]) == ((640, 480) if name == "gen3_evt2.raw" else (1280, 720))
    assert (summary["lost"], summary["lost_reason"], summary["warnings"]) == (0, [], [])


def test_trigger_edges_are_found() -> None:
    summary = summary_of("evt3_with_triggers.raw")
    assert summary["triggers"] == [
        {"t_us": 14547491, "id": 0, "rising": False},
        {"t_us": 14549491, "id": 0, "rising": True},
    ]


def test_the_rate_controller_counted_every_event_and_dropped_none() -> None:
    assert summary_of("evk4_10s.raw")["rate_controller"] == {
        "before": 1_218_618,
        "after": 1_218_618,
    }


def test_one_word_at_a_time_gives_the_same_events() -> None:
    words = payload("evt3_with_triggers.raw")[:3000]
    decoder = Evt3Decoder(HD)
    t = [one for begin in range(words.size) for one in decoder.feed(words[begin : begin + 1]).t.tolist()]
    assert t == Evt3Decoder(HD).feed(words).t.tolist()


def test_the_size_of_the_pieces_does_not_matter() -> None:
    assert read_columns(RECORDINGS / "gen3_evt2.raw", 1 << 12)[0].size == DIGESTS["gen3_evt2.raw"][0]


@pytest.mark.parametrize("name", ["evt3_with_triggers.raw", "gen41_dense_vectors.raw"])
def test_the_evt3_package_agrees(name: str) -> None:
    words = payload(name)
    ours, theirs = Evt3Decoder(HD).feed(words), evt3.Decoder(1280, 720).feed(words.tobytes())
    for one, other in zip(ours, (theirs.t, theirs.x, theirs.y, theirs.p), strict=True):
        assert (one == np.asarray(other)).all()


@settings(max_examples=12)
@given(
    name=st.sampled_from(["evt3_with_triggers.raw", "gen41_dense_vectors.raw", "evk4_10s.raw"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_damaged_recording_decodes_as_its_twin_says(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    words = payload(name)
    begin = int(rng.integers(0, words.size - 6000))
    words = words[begin : begin + 6000]
    hit = rng.integers(0, words.size, 60)
    words[hit] ^= rng.integers(0, 0xFFFF, 60, np.uint16, endpoint=True)
    words = np.delete(words, rng.integers(0, words.size, 20))
    items, odd, _ = naive.decode_evt3(words, 1280, 720)
    decoder = Evt3Decoder(HD)
    events = [np.concatenate(column) for column in zip(*(
        [column.copy() for column in decoder.feed(piece)] for piece in np.array_split(words, 7)
    ), strict=True)]  # fmt: skip
    assert list(zip(*(column.tolist() for column in events), strict=True)) == [i[1:] for i in items if i[0] == "event"]
    assert {name: count for name, count in decoder.counters.items() if count} == {k: v for k, v in odd.items() if v}


@pytest.mark.parametrize("name", ["evt3_with_triggers.raw", "gen3_evt2.raw"])
def test_fused_windows_equal_windows_over_the_decoded_arrays(name: str) -> None:
    path = RECORDINGS / name
    t, x, y, p = read_columns(path)
    with opened(path) as reader:
        geometry = reader.geometry
        weights = np.random.default_rng(1).integers(-1020, 1021, (geometry.height, geometry.width))
        fused, plain = (ElpWindows(weights, window_us=500, origin_us=int(t[0]) - 5) for _ in range(2))
        by_words = [row for packet in reader.packets(77_776) for row in fused.feed(packet).tolist()]
    packed = np.rec.fromarrays([t, x, y, p], names="t,x,y,p")
    by_arrays = plain.feed(CameraPacket(packed, Encoding.ARRAY, HostNs(0))).tolist()
    assert len(by_arrays) > 150
    assert by_words[: len(by_arrays)] == by_arrays
