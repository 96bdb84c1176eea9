"""Writing RAW files: what is encoded decodes to the same, in our reader and in others'."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from elpd_drivers.formats.raw import FORMAT
from event_files import GEOMETRY, edge, event_columns, in_pieces, many, packet, read_all, write_all
from hypothesis import given
from hypothesis import strategies as st
from streams import cuts, evt2_words, evt3_words, evt21_words

from elpd.errors import FormatError, UsageError
from elpd.events.evt2 import Evt2Decoder, Evt21Decoder
from elpd.events.evt2_encode import Evt2Encoder, Evt21Encoder
from elpd.events.stream import open_recording
from elpd.ports import WritableFormat
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs

words = st.sampled_from(sorted(FORMAT.writes))


@pytest.mark.parametrize(("encoder", "decoder"), [(Evt2Encoder, Evt2Decoder), (Evt21Encoder, Evt21Decoder)])
@given(columns=event_columns(), cuts=cuts)
def test_evt2_encoding_is_undone_by_decoding(encoder: Any, decoder: Any, columns: Any, cuts: list[int]) -> None:
    encodes, decodes = encoder(), decoder(GEOMETRY)
    found: list[list[int]] = [[], [], [], []]
    for piece in in_pieces(columns, cuts):
        for column, more in zip(found, decodes.feed(encodes.encode(*piece)), strict=True):
            column += more.tolist()
    assert found == columns


@pytest.mark.parametrize(("encoder", "decoder"), [(Evt2Encoder, Evt2Decoder), (Evt21Encoder, Evt21Decoder)])
@given(times=st.lists(st.integers(0, 2**37), max_size=6).map(sorted))
def test_long_silences_and_turns_of_the_clock_are_bridged(encoder: Any, decoder: Any, times: list[int]) -> None:
    t = np.array(times, np.int64)
    encoded = encoder().encode(t, t % 64, t % 48, t % 2)
    assert decoder(GEOMETRY).feed(encoded).t.tolist() == times


def test_evt21_gathers_a_row_of_pixels_in_one_word() -> None:
    x = np.arange(40)
    encoded = Evt21Encoder().encode(np.full(40, 70), x, np.full(40, 9), np.ones(40))
    assert [f"{word:016x}" for word in encoded.tolist()] == ["8000000100000000", "11800009ffffffff", "11810009000000ff"]


@pytest.mark.parametrize("t", [[-1], [2**34 + 1, 2**34 - 100], [2**34 - 64, 0]])
def test_times_that_evt2_cannot_say_are_refused(t: list[int]) -> None:
    with pytest.raises(UsageError, match="EVT2"):
        Evt2Encoder().encode(*np.array([t, [0] * len(t), [0] * len(t), [0] * len(t)]))


@given(word=words, columns=event_columns(), cuts=cuts, chunk=st.integers(1, 200))
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, word: str, columns: Any, cuts: list[int], chunk: int
) -> None:
    path = tmp_path_factory.mktemp("raw") / "r.raw"
    write_all(FORMAT.create(path, word, GEOMETRY, {}), columns, cuts)
    assert read_all(path, chunk)[0] == columns
    with closing(open_recording(path)) as reader:
        assert (reader.geometry, reader.notes["warnings"]) == (GEOMETRY, [])


@pytest.mark.parametrize("word", FORMAT.writes)
def test_trigger_edges_come_back_in_their_place(tmp_path: Path, word: str) -> None:
    path = tmp_path / "r.raw"
    edges = [edge(4000, 1), edge(5500, 1, rising=False), edge(5500, 0), edge(99_000, 3)]
    writer = FORMAT.create(path, word, GEOMETRY, {})
    columns = [column.tolist() for column in many(100)]
    writer.write(packet(columns, triggers=edges))
    writer.write(packet([[]] * 4, triggers=[edge(99_500, 2)]))
    writer.close()
    assert read_all(path) == (columns, [*edges, edge(99_500, 2)], [])


@given(kind=st.sampled_from(["evt3", "evt2", "evt2.1", "evt2.1-legacy"]), data=st.data())
def test_a_cameras_own_words_are_written_as_they_are(
    tmp_path_factory: pytest.TempPathFactory, kind: str, data: Any
) -> None:
    path = tmp_path_factory.mktemp("raw") / "r.raw"
    strategy, dtype, encoding = {
        "evt3": (evt3_words(), np.uint16, Encoding.EVT3),
        "evt2": (evt2_words(), np.uint32, Encoding.EVT2),
    }.get(kind, (evt21_words(), np.uint64, Encoding.EVT21))
    stream = np.array(data.draw(strategy), dtype)
    writer = FORMAT.create(path, kind, GEOMETRY, {})
    for piece in np.array_split(stream, 3):
        writer.write(CameraPacket(piece, encoding, HostNs(0)))
    writer.close()
    with closing(open_recording(path)) as reader:
        assert [word for one in reader.packets(64) for word in one.data.tolist()] == stream.tolist()


def test_the_header_keeps_what_is_known_and_nothing_can_end_it_early(tmp_path: Path) -> None:
    path = tmp_path / "r.raw"
    facts = {"serial_number": "7\n% end\nx", "evt": "9.9", "geometry": "1x1", "a b": "c", "Date": "2020-09-25 07:48:29"}
    write_all(FORMAT.create(path, "evt3", GEOMETRY, facts), [[5], [1], [2], [1]])
    with closing(open_recording(path)) as reader:
        header = reader.notes["header"]
        assert (reader.geometry, header["serial_number"], header["date"]) == (GEOMETRY, "7 % end x", facts["Date"])
        assert header["complete"] == "yes"
    assert read_all(path)[0] == [[5], [1], [2], [1]]


def test_an_unfinished_file_is_readable_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "r.raw"
    writer = FORMAT.create(path, "evt3", GEOMETRY, {})
    writer.write(packet([[5], [1], [2], [1]]))
    assert read_all(path)[0] == [[5], [1], [2], [1]]
    writer.close(complete=False)
    writer.close()
    with closing(open_recording(path)) as reader:
        assert "was not finished" in reader.notes["warnings"][0]


@pytest.mark.parametrize(
    ("word", "columns", "message"),
    [
        ("evt3", [[5], [64], [2], [1]], "outside the sensor of 64x48"),
        ("evt2", [[5], [1], [48], [1]], "outside the sensor of 64x48"),
        ("evt3", [[17_000_000, 16_000_000], [1, 1], [1, 1], [1, 1]], "EVT3 cannot say"),
        ("evt3", [[-5], [1], [1], [1]], "from 0 to one day"),
        ("evt2.1", [[-5], [1], [1], [1]], "begin at zero"),
    ],
)
def test_what_cannot_be_said_is_refused(tmp_path: Path, word: str, columns: Any, message: str) -> None:
    with (
        closing(FORMAT.create(tmp_path / "r.raw", word, GEOMETRY, {})) as writer,
        pytest.raises(FormatError, match=message),
    ):
        writer.write(packet(columns))


def test_a_file_holds_words_or_events(tmp_path: Path) -> None:
    evt3, evt2 = (np.array([0x8001], np.uint16), Encoding.EVT3), (np.array([8], np.uint32), Encoding.EVT2)
    with closing(FORMAT.create(tmp_path / "r.raw", "evt3", GEOMETRY, {})) as writer:
        writer.write(packet([[5], [1], [2], [1]]))
        for (data, encoding), message in ((evt3, "not both"), (evt2, "holds evt3 words")):
            with pytest.raises(FormatError, match=message):
                writer.write(CameraPacket(data, encoding, HostNs(0)))


def test_a_sensor_of_too_many_columns_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="11-bit addresses"):
        FORMAT.create(tmp_path / "r.raw", "evt3", Geometry(2049, 10), {})
    assert isinstance(FORMAT, WritableFormat)
