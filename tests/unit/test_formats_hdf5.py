"""HDF5 files: Prophesee's layout with and without ECF, columns of others, the index, and damage."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from elpd_drivers.formats import hdf5, hdf5_child, hdf5_library
from elpd_drivers.formats.hdf5 import FORMAT
from event_files import GEOMETRY, edge, event_columns, many, packet, peak_bytes, read_all, write_all
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from streams import cuts

from elpd.cli.decode import summarise
from elpd.errors import FormatError
from elpd.events.stream import open_recording
from elpd.records import Geometry

h5py = pytest.importorskip("h5py")

EDGES = [edge(5010, 0), edge(5500, 1, rising=False), edge(99_000, 0)]
EVENTS = [[5, 6, 90], [1, 2, 300], [4, 5, 6], [1, 0, 1]]


class Here:
    """The library without its own process, which takes a third of a second to start: for tests with many files."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content: Any = None

    def ask(self, **question: Any) -> Any:
        try:
            self.content = self.content or hdf5_child.Content(str(self.path))
            return self.content.answer(question)
        except (OSError, RuntimeError, KeyError, ValueError, LookupError) as error:
            raise FormatError(hdf5_library.told(self.path, str(error))) from error

    def close(self) -> None:
        if self.content is not None:
            self.content.close()


@pytest.fixture
def child() -> Any:
    """Ask for the library in its own process, as it is in use."""
    return hdf5_library.Library


@pytest.fixture(autouse=True)
def _library(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "child" not in request.fixturenames:
        monkeypatch.setattr(hdf5, "Library", Here)


words = st.sampled_from(sorted(FORMAT.writes))


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(word=words, columns=event_columns(largest_step_us=30_000), cuts=cuts, chunk=st.integers(1, 2000))
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, word: str, columns: Any, cuts: list[int], chunk: int
) -> None:
    path = tmp_path_factory.mktemp("hdf5") / "r.hdf5"
    write_all(FORMAT.create(path, word, GEOMETRY, {"serial_number": "7"}), columns, cuts)
    assert read_all(path, chunk)[0] == columns
    with closing(open_recording(path)) as reader:
        assert (reader.geometry, reader.notes["format"], reader.notes["warnings"]) == (GEOMETRY, "HDF5", [])
        assert reader.notes["header"] == {"serial_number": "7"}


@pytest.mark.usefixtures("child")
@pytest.mark.parametrize("word", FORMAT.writes)
def test_long_files_and_edges_come_back(tmp_path: Path, word: str) -> None:
    path = tmp_path / "r.hdf5"
    columns = many(40_000, geometry=Geometry(1280, 720))
    with closing(FORMAT.create(path, word, Geometry(1280, 720), {})) as writer:
        for begin in range(0, 40_000, 7000):
            piece = [column[begin : begin + 7000] for column in columns]
            writer.write(packet(piece, triggers=EDGES if begin == 0 else []))
    assert read_all(path, 5000) == ([column.tolist() for column in columns], EDGES, [])


def test_deflated_tables_are_read_by_h5py_alone(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    columns = many(20_000)
    write_all(FORMAT.create(path, "hdf5-deflate", GEOMETRY, {}), [column.tolist() for column in columns])
    with h5py.File(path) as file:
        table = file["CD/events"][:]
        assert file.attrs["geometry"] == "64x48"
    for ours, name in zip(columns, "txyp", strict=True):
        assert (ours == table[name]).all()


def naive_index(t: list[int]) -> list[tuple[int, int]]:
    """Return the index as Prophesee's software makes it, event by event."""
    entries, current, before = [], (0, -1), (0, -1)
    for at, time in enumerate(t):
        while (time - t[0]) // 2000 + 1 > len(entries):
            if at != current[0]:
                before = current
            entries.append(before)
            current = (at, time - t[0])
    return [*entries, current] if t else []


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(columns=event_columns(largest_step_us=9000), cuts=cuts)
def test_the_index_is_as_their_software_makes_it(
    tmp_path_factory: pytest.TempPathFactory, columns: Any, cuts: list[int]
) -> None:
    path = tmp_path_factory.mktemp("hdf5") / "r.hdf5"
    write_all(FORMAT.create(path, "hdf5", GEOMETRY, {}), columns, cuts)
    with h5py.File(path) as file:
        index = file["CD/indexes"]
        assert [tuple(entry) for entry in index[:].tolist()] == naive_index(columns[0])
        if columns[0]:
            assert index.attrs["offset"] == str(-columns[0][0])


def test_a_silence_of_days_is_refused(tmp_path: Path) -> None:
    with (
        closing(FORMAT.create(tmp_path / "r.hdf5", "hdf5", GEOMETRY, {})) as writer,
        pytest.raises(FormatError, match="more than a day"),
    ):
        writer.write(packet([[5, 10**12], [1, 1], [1, 1], [1, 1]]))


def test_a_sensor_that_ecf_cannot_say_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="11-bit"):
        FORMAT.create(tmp_path / "r.hdf5", "hdf5", Geometry(3000, 5), {})


def columns_of(**more: Any) -> dict[str, Any]:
    return {"t": EVENTS[0], "x": EVENTS[1], "y": EVENTS[2], "p": EVENTS[3]} | more


@pytest.mark.parametrize("options", [{}, {"compression": "gzip"}, {"compression": "lzf"}, {"chunks": (2,)}])
@pytest.mark.parametrize("prefix", ["events/", "CD/events/", ""])
def test_columns_of_their_own_are_read(tmp_path: Path, prefix: str, options: Any) -> None:
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        for name, column in columns_of().items():
            kind = np.uint32 if name == "t" else np.uint16
            file.create_dataset(prefix + (name if prefix else f"{name}s"), data=np.array(column, kind), **options)
        file.attrs["width"], file.attrs["height"] = 640, 480
    assert read_all(path, 32)[0] == EVENTS
    with closing(open_recording(path)) as reader:
        assert reader.geometry == Geometry(640, 480)


def test_dsecs_offset_is_added(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "r.h5", "w") as file:
        for name, column in columns_of().items():
            file[f"events/{name}"] = np.array(column, np.uint32)
        file["t_offset"] = 49_599_000_000
    assert read_all(tmp_path / "r.h5")[0][0] == [t + 49_599_000_000 for t in EVENTS[0]]


def test_a_table_of_events_is_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "r.h5", "w") as file:
        rows = list(zip(*EVENTS, strict=True))
        file["events"] = np.array(rows, [("timestamp", "i8"), ("x", "u2"), ("y", "u2"), ("polarity", "i1")])
    assert read_all(tmp_path / "r.h5")[0] == EVENTS


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "no /CD/events and no columns"),
        ({"events": np.zeros(3, [("t", "i8"), ("x", "u2")])}, "must have fields"),
        ({"events/t": [1, 2], "events/x": [1], "events/y": [1], "events/p": [1]}, "equally long"),
        ({"ts": [0.25], "xs": [1], "ys": [1], "ps": [1]}, "whole numbers"),
    ],
)
def test_files_without_events_are_named(tmp_path: Path, content: Any, message: str) -> None:
    with h5py.File(tmp_path / "r.h5", "w") as file:
        for name, value in content.items():
            file[name] = value
    with pytest.raises(FormatError, match=message):
        read_all(tmp_path / "r.h5")


def test_a_filter_that_is_not_installed_is_named(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk((4,))
        plan.set_filter(32_001, h5py.h5z.FLAG_OPTIONAL)  # Blosc
        for name in "txyp":
            space = h5py.h5s.create_simple((4,))
            data = h5py.h5d.create(file.id, name.encode(), h5py.h5t.NATIVE_UINT32, space, plan)
            data.write_direct_chunk((0,), bytes(16))
    if h5py.h5z.filter_avail(32_001):
        pytest.skip("Blosc is installed")
    with pytest.raises(FormatError, match="pip install hdf5plugin"):
        read_all(path)


@pytest.mark.usefixtures("child")
def test_without_h5py_the_message_says_how_to_have_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_all(FORMAT.create(tmp_path / "r.hdf5", "hdf5", GEOMETRY, {}), EVENTS[:0] or [[5], [1], [1], [1]])
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(FormatError, match="pip install h5py"):
        open_recording(tmp_path / "r.hdf5")
    assert FORMAT.can_write("hdf5") == hdf5.NO_H5PY


def test_a_damaged_chunk_is_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    path = tmp_path / "r.hdf5"
    write_all(FORMAT.create(path, "hdf5", GEOMETRY, {}), [column.tolist() for column in many(40_000)])
    with h5py.File(path) as file:
        where = file["CD/events"].id.get_chunk_info(1)
    content = bytearray(path.read_bytes())
    content[where.byte_offset + 14 : where.byte_offset + 64] = bytes(50)
    path.write_bytes(content)
    with closing(open_recording(path)) as reader:
        summary = summarise(reader)
    assert (summary["events"], summary["lost"]) == (40_000 - 16_384, 16_384)
    assert "events 16384 to 32767" in summary["lost_reason"][0]


@pytest.mark.usefixtures("child")
@pytest.mark.parametrize("size", [8, 100, 3000])
def test_a_file_cut_short_is_told_through_the_pipe(tmp_path: Path, size: int) -> None:
    path = tmp_path / "r.hdf5"
    write_all(FORMAT.create(path, "hdf5", GEOMETRY, {}), [column.tolist() for column in many(3000)])
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(FormatError, match="cannot be read as events: Unable to"):
        open_recording(path)


@pytest.mark.usefixtures("child")
@pytest.mark.parametrize(
    ("program", "message"),
    [
        ("import os, signal, sys; sys.stdin.readline(); os.kill(os.getpid(), signal.SIGSEGV)", "crashed on it"),
        ("import sys; sys.stdin.readline(); sys.stdin.read()", "was still searching it after 0.2 s"),
        ("import sys; sys.stdin.readline(); sys.stdout.buffer.write(bytes(3))", "crashed on it"),
        ("import sys; sys.stdin.readline(); sys.stdout.buffer.write(bytes([255] * 8))", "one piece of it has"),
    ],
)
def test_a_file_that_the_library_does_not_survive_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, message: str
) -> None:
    path = tmp_path / "r.hdf5"
    write_all(FORMAT.create(path, "hdf5", GEOMETRY, {}), [[5], [1], [1], [1]])
    (tmp_path / "child.py").write_text(program)
    monkeypatch.setattr(hdf5_child, "__file__", str(tmp_path / "child.py"))
    if "searching" in message:
        monkeypatch.setattr(hdf5_library, "PATIENCE_S", 0.2)
    with pytest.raises(FormatError, match=message):
        open_recording(path)


@pytest.mark.parametrize("word", FORMAT.writes)
def test_a_file_cut_short_is_an_error_or_read_in_part(tmp_path: Path, word: str) -> None:
    path = tmp_path / "r.hdf5"
    write_all(FORMAT.create(path, word, GEOMETRY, {}), [column.tolist() for column in many(3000)])
    whole = path.read_bytes()
    for size in range(8, len(whole), len(whole) // 60):
        path.write_bytes(whole[:size])
        with pytest.raises(FormatError):
            read_all(path)


def test_memory_stays_bounded(tmp_path: Path) -> None:
    path = tmp_path / "r.hdf5"
    columns = many(200_000, geometry=Geometry(1280, 720), step_us=3)
    with closing(FORMAT.create(path, "hdf5", Geometry(1280, 720), {})) as writer:
        for k in range(5):
            writer.write(packet([columns[0] + k * 1_000_000, *columns[1:]]))

    def read() -> None:
        with closing(open_recording(path)) as reader:
            assert summarise(reader)["events"] == 1_000_000

    assert peak_bytes(read) < 4_000_000
