"""Reading and writing recordings: headers in all their dialects, and files that are not what they claim to be."""

import functools
import operator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from elpd_drivers.formats import npy, raw
from event_files import GEOMETRY, event_columns, packet, read_all, write_all
from hypothesis import given
from hypothesis import strategies as st
from streams import cuts, opened, read_columns

from elpd.errors import FormatError
from elpd.events.evt3_encode import Evt3Encoder
from elpd.events.stream import EventStream, open_recording
from elpd.records import Encoding, Geometry

WORDS = np.array([0x8001, 0x0001, 0x2802, 0x6003, 0x2004], "<u2").tobytes()


def raw_file(folder: Path, header: str, payload: bytes = WORDS) -> Path:
    path = folder / "recording.raw"
    path.write_bytes(header.encode() + payload)
    return path


@pytest.mark.parametrize(
    ("header", "geometry"),
    [
        ("% evt 3.0\n% format EVT3;height=720;width=1280\n% geometry 1280x720\n% end\n", Geometry(1280, 720)),
        ("% format EVT3;width=346;height=260\n% end\n", Geometry(346, 260)),
        ("% Date 2020-09-25 07:48:29\n% evt 3.0\n% plugin_name hal_plugin_gen41_evk3\n", Geometry(1280, 720)),
        ("% evt 3.0\n% system_ID 49\n", Geometry(1280, 720)),
        ("% evt 3.0\n% sensor_generation 3.1\n% end\n", Geometry(640, 480)),
        ("% evt 3.0\n% end\n", None),
        ("% evt 3.0\n% geometry 99999x5\n% end\n", None),
    ],
)
def test_geometry_is_read_from_every_dialect(tmp_path: Path, header: str, geometry: Geometry | None) -> None:
    with opened(raw_file(tmp_path, header)) as reader:
        assert reader.geometry == geometry
        assert reader.notes["format"] == "EVT3"
        assert b"".join(packet.data.tobytes() for packet in reader.packets()) == WORDS


def test_an_old_header_ends_where_lines_stop_looking_like_lines(tmp_path: Path) -> None:
    payload = b"\x25\x01\x0a\x80" + WORDS
    with opened(raw_file(tmp_path, "% evt 3.0\n", payload)) as reader:
        assert b"".join(packet.data.tobytes() for packet in reader.packets()) == payload


@pytest.mark.parametrize("header", ["% evt 4.0\n% end\n", "% format EVT4;height=4;width=4\n% end\n", "% format EVT\n"])
def test_an_unknown_encoding_is_named(tmp_path: Path, header: str) -> None:
    with pytest.raises(FormatError, match=r"this reader knows EVT2, EVT2\.1 and EVT3"):
        open_recording(raw_file(tmp_path, header))


@pytest.mark.parametrize("size", range(1, 9))
def test_a_file_cut_in_mid_word_is_read_to_its_last_whole_one(tmp_path: Path, size: int) -> None:
    words = np.array([0x80000001, 0x10000802, 0x10000802], "<u4").tobytes()
    with opened(raw_file(tmp_path, "% evt 2.0\n% end\n", words[:size])) as reader:
        assert sum(packet.data.size for packet in reader.packets(4)) == size // 4
        assert reader.notes["lost"] == (1 if size % 4 else 0)
        assert len(reader.notes["lost_reason"]) == reader.notes["lost"]


@given(st.binary(max_size=300))
def test_no_payload_makes_the_reader_fail(tmp_path_factory: pytest.TempPathFactory, payload: bytes) -> None:
    path = raw_file(tmp_path_factory.mktemp("raw"), "% evt 3.0\n% geometry 64x48\n% end\n", payload)
    with opened(path) as reader:
        for chunk in EventStream(reader).chunks(64):
            assert (chunk.x < 64).all()
            assert (chunk.y < 48).all()


@given(st.binary(max_size=200))
def test_no_header_makes_the_reader_fail_in_another_way(tmp_path_factory: pytest.TempPathFactory, text: bytes) -> None:
    path = tmp_path_factory.mktemp("raw") / "x.raw"
    path.write_bytes(b"% evt 3.0\n% " + text)
    with opened(path) as reader:
        assert sum(chunk.t.size for chunk in EventStream(reader).chunks()) >= 0


@pytest.mark.parametrize("legacy", [True, False])
@pytest.mark.parametrize("stated", [True, False])
def test_both_word_orders_of_evt21_are_read(tmp_path: Path, *, legacy: bool, stated: bool) -> None:
    words = np.array([0x8000000100000000, 0x1140180500000003, 0x0180200600000005] * 5, "<u8")
    payload = ((words << np.uint64(32)) | (words >> np.uint64(32))) if legacy else words
    order = ";endianness=legacy" if legacy else ";endianness=little"
    header = f"% format EVT21;height=720;width=1280{order if stated else ''}\n% end\n"
    path = raw_file(tmp_path, header, payload.tobytes())
    t, x, y, p = read_columns(path)
    with opened(path) as reader:
        assert reader.notes["format"] == "EVT2.1"
    assert x.tolist()[:4] == [(0x11401805 >> 11) & 0x7FF, ((0x11401805 >> 11) & 0x7FF) + 1, 4, 6]
    assert y.tolist()[:4] == [5, 5, 6, 6]
    assert p.tolist()[:4] == [1, 1, 0, 0]
    assert t.tolist()[:4] == [64 + 5, 64 + 5, 64 + 6, 64 + 6]


def test_what_is_written_is_read(tmp_path: Path) -> None:
    t = np.arange(500) * 40
    events = [t, t % 64, t % 48, t // 40 % 2]
    path = tmp_path / "written.raw"
    size = raw.write_raw(path, Geometry(64, 48), [Evt3Encoder(64).encode(*events)], {"serial_number": "7"})
    assert path.stat().st_size == size
    with opened(path) as reader:
        assert (reader.geometry, reader.notes["header"]["serial_number"]) == (Geometry(64, 48), "7")
    assert [column.tolist() for column in read_columns(path)] == [column.tolist() for column in events]


# --- numpy ---------------------------------------------------------------------------------------------------------

T = [5, 6, 6, 90]
X, Y, P = [1, 2, 3, 300], [4, 5, 6, 7], [1, 0, 1, 0]


def structured(dtype: Any) -> np.ndarray:
    return np.array(list(zip(T, X, Y, P, strict=True)), dtype)


@pytest.mark.parametrize(
    ("suffix", "save"),
    [
        ("npy", lambda f: np.save(f, structured([("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "i2")]))),
        ("npy", lambda f: np.save(f, structured([("timestamp", "u4"), ("x", "i2"), ("y", "i2"), ("on", "?")]))),
        ("npy", lambda f: np.save(f, np.array([T, X, Y, P]).T)),
        ("npy", lambda f: np.save(f, np.asfortranarray(np.array([T, X, Y, P], np.float64).T))),
        ("npz", lambda f: np.savez(f, t=T, x=X, y=Y, p=P)),
        ("npz", lambda f: np.savez_compressed(f, t=np.array(T, ">f8"), x=X, y=Y, polarity=np.array(P, bool))),
    ],
)
@pytest.mark.parametrize("max_bytes", [1, 1 << 20])
def test_numpy_files_are_read_in_every_habit(tmp_path: Path, suffix: str, save: Any, max_bytes: int) -> None:
    path = tmp_path / f"events.{suffix}"
    save(path)
    reader = open_recording(path)
    assert reader.notes["format"] == suffix.upper()
    chunks = [[c.tolist() for c in chunk[:4]] for chunk in EventStream(reader).chunks(max_bytes)]
    assert [functools.reduce(operator.iadd, parts, []) for parts in zip(*chunks, strict=True)] == [T, X, Y, P]
    assert all(packet.encoding is Encoding.ARRAY for packet in reader.packets())
    reader.close()
    reader.close()


@pytest.mark.parametrize(
    ("suffix", "save", "message"),
    [
        ("npy", lambda f: np.save(f, np.zeros(5)), "rows of t, x, y, p"),
        ("npy", lambda f: np.save(f, np.zeros((5, 3))), "rows of t, x, y, p"),
        ("npy", lambda f: np.save(f, np.zeros(5, [("t", "i8"), ("x", "u2")])), "must have fields"),
        ("npy", lambda f: np.save(f, np.full((5, 4), 0.5)), "whole numbers"),
        ("npy", lambda f: np.save(f, np.full((5, 4), np.nan)), "whole numbers"),
        ("npy", lambda f: np.save(f, np.array([{}, 1], object), allow_pickle=True), "plain numbers"),
        ("npz", lambda f: np.savez(f, t=[1], x=[1], y=[1]), "four arrays"),
        ("npz", lambda f: np.savez(f, t=[1, 2], x=[1], y=[1], p=[1]), "equally long"),
        ("npz", lambda f: np.savez(f, t=[[1]], x=[1], y=[1], p=[1]), "one column"),
    ],
)
def test_arrays_that_are_not_events_are_refused(tmp_path: Path, suffix: str, save: Any, message: str) -> None:
    path = tmp_path / f"events.{suffix}"
    save(path)
    with pytest.raises(FormatError, match=message):
        read_columns(path)


@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_a_numpy_file_cut_short_at_any_byte_is_an_error_or_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"events.{suffix}"
    (np.save(path, np.array([T, X, Y, P]).T) if suffix == "npy" else np.savez(path, t=T, x=X, y=Y, p=P))
    whole = path.read_bytes()
    for size in range(1, len(whole), 7):
        path.write_bytes(whole[:size])
        with pytest.raises(FormatError):
            read_columns(path)


@given(word=st.sampled_from(["npy", "npz"]), columns=event_columns(), cuts=cuts, chunk=st.integers(1, 200))
def test_numpy_files_that_are_written_are_read(
    tmp_path_factory: pytest.TempPathFactory, word: str, columns: Any, cuts: list[int], chunk: int
) -> None:
    path = tmp_path_factory.mktemp("npy") / f"r.{word}"
    write_all(npy.FORMAT.create(path, word, GEOMETRY, {}), columns, cuts)
    assert read_all(path, chunk)[0] == columns
    loaded = np.load(path)
    assert [loaded[name].tolist() for name in "txyp"] == columns
    assert [one.name for one in path.parent.iterdir()] == [path.name]


def test_a_numpy_array_can_be_read_before_it_is_finished(tmp_path: Path) -> None:
    with closing(npy.FORMAT.create(tmp_path / "r.npy", "npy", GEOMETRY, {})) as writer:
        for k in range(12):
            writer.write(packet([[k], [1], [2], [1]]))
            assert np.load(tmp_path / "r.npy")["t"].tolist() == list(range(k + 1))


def test_an_address_beyond_two_bytes_does_not_wrap_into_the_sensor(tmp_path: Path) -> None:
    path = tmp_path / "events.npy"
    np.save(path, np.array([[1, 65536 + 3, 2, 1], [2, -1, 2, 1], [3, 3, 2, 1]]))
    with opened(path) as reader:
        stream = EventStream(reader, Geometry(10, 10))
        assert [chunk.x.tolist() for chunk in stream.chunks()] == [[3]]
    assert stream.counters == {"x_out_of_range": 2}


def test_an_archive_of_something_else_is_not_ours(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", weights=[1])
    assert not npy.FORMAT.recognises(tmp_path / "other.npz")
