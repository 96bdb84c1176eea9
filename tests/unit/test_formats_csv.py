"""Events as text: every order of columns, what names say, and lines that are not events."""

from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from elpd_drivers.formats.csv_text import FORMAT
from event_files import GEOMETRY, event_columns, many, peak_bytes, read_all, write_all
from hypothesis import given
from hypothesis import strategies as st
from streams import cuts

from elpd.errors import FormatError
from elpd.events.stream import open_recording
from elpd.records import Geometry

EVENTS = [[5, 6, 90], [1, 2, 300], [4, 5, 6], [1, 0, 1]]


def text_file(folder: Path, text: str | bytes) -> Path:
    path = folder / "r.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@given(word=st.sampled_from(["csv", "txt"]), columns=event_columns(), cuts=cuts, chunk=st.integers(1, 200))
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, word: str, columns: Any, cuts: list[int], chunk: int
) -> None:
    path = tmp_path_factory.mktemp("csv") / "r.csv"
    write_all(FORMAT.create(path, word, GEOMETRY, {}), columns, cuts)
    assert read_all(path, chunk)[0] == columns
    with closing(open_recording(path)) as reader:
        assert (reader.notes["format"], reader.notes["warnings"]) == ("CSV", [])


@pytest.mark.parametrize(
    "text",
    [
        "t,x,y,p\n5,1,4,1\n6,2,5,0\n90,300,6,1\n",
        "\ufeffx;y;polarity;timestamp\r\n1;4;1;5\r\n2;5;-1;6\r\n300;6;1;90\r\n",
        "5 1 4 1\n6   2 5 0\n90 300 6 1",
        "1,4,1,5\n2,5,0,6\n300,6,1,90\n",
        "%geometry:640,480\n1,4,1,5\n2,5,0,6\n300,6,1,90\n",
        "# events of a test\n#p t y x\n1 5 4 1\n0 6 5 2\n\n1 90 6 300\n",
        "frame, on, x, t_ns, y\n0, 1, 1, 5000, 4\n0, 0, 2, 6000, 5\n0, 1, 300, 90000, 6\n",
        "t_s\tx\ty\tp\n0.000005\t1\t4\t1\n6e-6\t2\t5\t0\n0.00009\t300\t6\t1\n",
        "t [ms],x,y,p\n0.005,1,4,1\n0.006,2,5,0\n0.09,300,6,1\n",
        "t,x,y,p\n5.0,1.0,4,1\n6.0,2,5.0,0\n# a remark\n90,300,6,1\n",
        "t,x,y,on\n5,1,4,True\n6,2,5,False\n90,300,6,TRUE\n",
    ],
)
@pytest.mark.parametrize("chunk", [1, 1 << 20])
def test_every_habit_of_the_field_is_read(tmp_path: Path, text: str, chunk: int) -> None:
    assert read_all(text_file(tmp_path, text), chunk)[0] == EVENTS


def test_what_had_to_be_guessed_is_told(tmp_path: Path) -> None:
    with closing(open_recording(text_file(tmp_path, "1,4,1,5\n2,5,0,6\n"))) as reader:
        assert "taken as x, y, p, t" in reader.notes["warnings"][0]
        assert reader.geometry is None
    with closing(open_recording(text_file(tmp_path, "%geometry:640,480\n1,4,1,5\n"))) as reader:
        assert (reader.notes["warnings"], reader.geometry) == ([], Geometry(640, 480))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x,y,p\n0.000005,1,4,1\n", "name the column t_s"),
        ("t,x,y,p\n5,1,4,1\nfive,1,4,1\n", "after line 1"),
        ("t,x,y,p\n5,1,4,1\n5,1\n5,1,4,1\n", "after line 1"),
        ("t_s,x,y,p\nnan,1,4,1\n", "not a number"),
        ("t,x,y,p\n5,0.5,4,1\n", "whole numbers"),
        ("t,x,y,p\n1e300,1,4,1\n", "whole numbers"),
    ],
)
def test_lines_that_are_not_events_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_all(text_file(tmp_path, text))


@pytest.mark.parametrize(
    "text",
    ["focus was at 12 mm\n", "1,2,3\n", "1,2,3,4,5\n", "1,2,3,4\n", "x,y\n1,2\n", "5,1,4,1\n\x00\x01", "# only\n"],
)
def test_other_texts_are_not_ours(tmp_path: Path, text: str) -> None:
    assert not FORMAT.recognises(text_file(tmp_path, text))
    with pytest.raises(FormatError, match="in no format"):
        open_recording(text_file(tmp_path, text))


@pytest.mark.parametrize("cut", range(1, 24))
def test_a_file_cut_short_anywhere_is_read_to_its_last_whole_line(tmp_path: Path, cut: int) -> None:
    whole = "t,x,y,p\n5,1,4,1\n6,2,5,0\n90,300,6,1\n"
    path = text_file(tmp_path, whole[:-cut])
    rows = whole[:-cut].split("\n")[1:]
    kept = [row for row in rows if row.count(",") == 3 and not row.endswith(",")]
    assert read_all(path)[0][0] == [int(row.split(",")[0]) for row in kept]
    with closing(open_recording(path)) as reader:
        list(reader.packets())
        assert reader.notes["lost"] == len([row for row in rows if row]) - len(kept)


@given(junk=st.binary(max_size=80))
def test_no_damage_makes_the_reader_fail_in_another_way(tmp_path_factory: pytest.TempPathFactory, junk: bytes) -> None:
    path = text_file(tmp_path_factory.mktemp("csv"), b"t,x,y,p\n5,1,4,1\n" + junk)
    try:
        events = read_all(path, 20)[0]
    except FormatError:
        return
    assert events[0][:1] == [5]


def test_memory_stays_bounded(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    columns = [column.tolist() for column in many(12_000)]

    def there_and_back() -> None:
        write_all(FORMAT.create(path, "csv", GEOMETRY, {}), columns, range(0, 12_000, 500))
        with closing(open_recording(path)) as reader:
            assert sum(len(one.data) for one in reader.packets(1 << 12)) == 12_000

    assert peak_bytes(there_and_back) < 600_000
