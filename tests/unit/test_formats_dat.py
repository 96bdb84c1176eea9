"""DAT files: old and new layouts, the turning clock, damage, and other people's readers."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from elpd_drivers.formats.dat import FORMAT
from event_files import GEOMETRY, event_columns, many, packet, read_all, write_all
from hypothesis import given
from hypothesis import strategies as st
from streams import cuts

from elpd.errors import FormatError
from elpd.events.stream import open_recording
from elpd.records import Geometry

HEAD = "% Data file containing CD events.\n% Version 2\n% Date 2017-01-01 00:00:00\n% Height 240\n% Width 304\n"


def dat_file(folder: Path, header: str, kind: int, rows: Any, size: int = 8) -> Path:
    path = folder / "r.dat"
    events = np.zeros((len(rows), size // 4), "<u4")
    events[:, :2] = rows
    path.write_bytes(header.encode() + bytes([kind, size]) + events.tobytes())
    return path


@given(columns=event_columns(largest_step_us=2**31 - 1), cuts=cuts, chunk=st.integers(1, 200))
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, columns: Any, cuts: list[int], chunk: int
) -> None:
    if columns[0] and columns[0][0] >= 2**32:
        return
    path = tmp_path_factory.mktemp("dat") / "r.dat"
    write_all(FORMAT.create(path, "dat", GEOMETRY, {}), columns, cuts)
    assert read_all(path, chunk)[0] == columns
    with closing(open_recording(path)) as reader:
        assert (reader.geometry, reader.notes["format"], reader.notes["warnings"]) == (GEOMETRY, "DAT", [])


@pytest.mark.parametrize("kind", [0x00, 0x0C])
def test_both_kinds_of_version_2_have_14_bits_for_each_address(tmp_path: Path, kind: int) -> None:
    path = dat_file(tmp_path, HEAD, kind, [[7, 1 << 28 | 200 << 14 | 300], [9, 5 << 14 | 6]])
    with closing(open_recording(path)) as reader:
        assert reader.geometry == Geometry(304, 240)
    assert read_all(path)[0] == [[7, 9], [300, 6], [200, 5], [1, 0]]


@pytest.mark.parametrize("version", ["% Version 1\n", ""])
def test_old_files_have_nine_bits_and_eight(tmp_path: Path, version: str) -> None:
    header = f"% Data file containing 2d events.\n{version}"
    path = dat_file(tmp_path, header, 0x00, [[7, 1 << 17 | 200 << 9 | 300], [9, 5 << 9 | 6]])
    assert read_all(path)[0] == [[7, 9], [300, 6], [200, 5], [1, 0]]
    with closing(open_recording(path)) as reader:
        assert [("version" in warning) for warning in reader.notes["warnings"]] == ([] if version else [True])


def test_a_file_without_a_version_is_new_if_its_bits_say_so(tmp_path: Path) -> None:
    path = dat_file(tmp_path, "% Data file containing CD events.\n", 0x0C, [[7, 1 << 28 | 200 << 14 | 300]])
    assert read_all(path)[0] == [[7], [300], [200], [1]]


def test_of_longer_events_the_addresses_are_read(tmp_path: Path) -> None:
    path = dat_file(tmp_path, HEAD, 0x28, [[7, 3 << 14 | 2], [9, 1 << 28]], size=28)
    assert read_all(path, 30)[0] == [[7, 9], [2, 0], [3, 0], [0, 1]]
    with closing(open_recording(path)) as reader:
        assert "optical flow" in reader.notes["warnings"][0]


def test_late_events_around_a_turn_of_the_clock_stay_on_their_side(tmp_path: Path) -> None:
    low = [2**32 - 50, 3, 2**32 - 2, 10, 5, 2**31, 2**32 - 1, 1]
    path = dat_file(tmp_path, HEAD, 0x0C, [[t, 0] for t in low])
    turns = [0, 1, 0, 1, 1, 1, 1, 2]
    expected = [t + turn * 2**32 for t, turn in zip(low, turns, strict=True)]
    assert read_all(path)[0][0] == expected
    assert read_all(path, 8)[0][0] == expected


@pytest.mark.parametrize(
    ("t", "message"),
    [([-1], "32 bits of DAT"), ([2**32], "32 bits of DAT"), ([5, 5 + 2**31], "32 bits"), ([2**31, 0], "32 bits")],
)
def test_times_that_32_bits_cannot_say_are_refused(tmp_path: Path, t: list[int], message: str) -> None:
    with (
        closing(FORMAT.create(tmp_path / "r.dat", "dat", GEOMETRY, {})) as writer,
        pytest.raises(FormatError, match=message),
    ):
        writer.write(packet([t, *[[0] * len(t)] * 3]))


def test_a_sensor_that_is_too_large_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="14-bit"):
        FORMAT.create(tmp_path / "r.dat", "dat", Geometry(20_000, 5), {})


def test_a_file_of_trigger_edges_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="holds trigger edges"):
        open_recording(dat_file(tmp_path, HEAD, 0x0E, [[1, 2]], size=16))


@pytest.mark.parametrize("cut", range(1, 40))
def test_a_file_cut_short_anywhere_is_read_as_far_as_it_goes(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "r.dat"
    write_all(FORMAT.create(path, "dat", GEOMETRY, {}), [[5, 6, 7, 8], [1] * 4, [2] * 4, [1] * 4])
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    if cut > 32:
        with pytest.raises(FormatError, match="in no format"):
            open_recording(path)
        return
    assert read_all(path)[0][0] == [5, 6, 7, 8][: 4 - -(-cut // 8)]
    with closing(open_recording(path)) as reader:
        list(reader.packets())
        assert reader.notes["lost"] == (1 if cut % 8 else 0)


@given(payload=st.binary(max_size=300), kind=st.sampled_from([0, 12, 40]), size=st.integers(8, 40))
def test_no_payload_makes_the_reader_fail(
    tmp_path_factory: pytest.TempPathFactory, payload: bytes, kind: int, size: int
) -> None:
    path = tmp_path_factory.mktemp("dat") / "r.dat"
    path.write_bytes(HEAD.encode() + bytes([kind, size]) + payload)
    t, x, y, _ = read_all(path, 64)[0]
    assert len(t) <= len(payload) // size
    assert all(value < 304 for value in x)
    assert all(value < 240 for value in y)


def test_what_other_people_write_is_read(tmp_path: Path) -> None:
    faery = pytest.importorskip("faery")
    path = tmp_path / "r.dat"
    columns = many(5000)
    rows = np.zeros(5000, [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), (("payload", "on"), "u1")])
    for column, name in zip(columns, ("t", "x", "y", "on"), strict=True):
        rows[name] = column
    with faery.dat.Encoder(
        path=str(path), version="dat2", event_type="cd", zero_t0=False, dimensions=(64, 48)
    ) as encoder:
        encoder.write(rows)
    assert read_all(path)[0] == [column.tolist() for column in columns]
