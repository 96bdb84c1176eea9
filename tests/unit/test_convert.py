"""``elpd convert``: everything that a file holds in another format, or told what was left behind."""

from __future__ import annotations

import os
from contextlib import closing
from typing import TYPE_CHECKING

import numpy as np
import pytest
from command_line import Answer, caller
from elpd_drivers.formats.aedat4 import FORMAT as AEDAT4
from elpd_drivers.formats.raw import FORMAT as RAW
from event_files import GEOMETRY, edge, many, packet, peak_bytes, read_all, read_imu, sample
from shared import RECORDINGS, needs_shared

from elpd.cli.decode import summarise
from elpd.errors import UsageError
from elpd.events.stream import open_recording
from elpd.record.convert import Slice, convert
from elpd.record.files import appearing_whole, writable_formats
from elpd.records import CameraPacket, Encoding, Geometry, Roi
from elpd.units import HostNs

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

FIELDS = {
    *("out", "format", "width", "height", "events", "on", "first_us", "last_us", "triggers", "frames", "imu"),
    *("shift_us", "lost", "lost_reason", "warnings"),
}
EDGES = [edge(9000, 1), edge(12_000, 1, rising=False)]
COLUMNS = [column.tolist() for column in many(1000)]


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "in.raw"
    with closing(RAW.create(path, "evt3", GEOMETRY, {"serial_number": "7"})) as writer:
        writer.write(packet(COLUMNS, triggers=EDGES))
    return path


def test_the_answer_says_what_was_written(elpd: Callable[..., Answer], recording: Path, tmp_path: Path) -> None:
    answer = elpd("convert", str(recording), "out.raw", "--format", "evt2", "--json")
    assert (answer.code, answer.err) == (0, "")
    assert answer.json.keys() >= FIELDS
    assert [answer.json[name] for name in ("format", "width", "height", "events", "triggers", "lost")] == [
        *("evt2", 64, 48, 1000, 2, 0)
    ]
    assert (answer.json["first_us"], answer.json["last_us"]) == (COLUMNS[0][0], COLUMNS[0][-1])
    assert read_all(tmp_path / "out.raw") == (COLUMNS, EDGES, [])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.raw", "out.raw"]
    told = elpd("convert", str(recording), "out.raw", "--force")
    assert "out.raw: evt3, 64x48\nevents    1,000, " in told.out


def test_a_part_keeps_its_times_and_addresses(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.raw"
    convert(recording, out, part=Slice(Roi(10, 5, 20, 30), 8000, 12_000))
    t, x, y, p = map(np.array, COLUMNS)
    keep = (t >= 8000) & (t < 12_000) & (x >= 10) & (x < 30) & (y >= 5) & (y < 35)
    assert 0 < keep.sum() < 1000
    assert read_all(out) == ([column[keep].tolist() for column in (t, x, y, p)], EDGES[:1], [])


def test_a_part_that_begins_after_the_end_is_empty_and_says_so(recording: Path, tmp_path: Path) -> None:
    answer = convert(recording, tmp_path / "out.raw", part=Slice(from_us=10**9))
    assert (answer["events"], answer["first_us"]) == (0, None)
    assert answer["warnings"] == ["nothing of the recording is in this part"]


def test_a_cameras_own_words_stay_and_are_named_where_they_cannot(tmp_path: Path) -> None:
    words = np.array(
        [0x8001, 0xE014, 0xF009, 0xF000, 0x7000, 0xE016, 0xF004, 0xF000, 0x7000, 0xE0F1, 0x7001], np.uint16
    )
    with closing(RAW.create(tmp_path / "in.raw", "evt3", GEOMETRY, {})) as writer:
        writer.write(CameraPacket(words, Encoding.EVT3, HostNs(0)))
    same = convert(tmp_path / "in.raw", tmp_path / "same.raw")
    assert (tmp_path / "same.raw").read_bytes().endswith(words.tobytes())
    assert (same["lost"], same["warnings"]) == (5, ["the file holds no events"])
    other = convert(tmp_path / "in.raw", tmp_path / "other.raw", word="evt2")
    assert "not carried over: the rate controller's counts, 1 words of the camera about itself" in other["warnings"]


def test_inertial_samples_are_carried_cut_and_named_where_they_cannot_be(tmp_path: Path) -> None:
    samples = [sample(5000 + 1000 * k, k) for k in range(5)]
    with closing(AEDAT4.create(tmp_path / "in.aedat4", "aedat4", GEOMETRY, {})) as writer:
        writer.write(packet(many(300), imu=samples))
    whole = convert(tmp_path / "in.aedat4", tmp_path / "whole.aedat4")
    assert (whole["imu"], whole["warnings"]) == (5, [])
    assert read_imu(tmp_path / "whole.aedat4") == read_imu(tmp_path / "in.aedat4")
    part = convert(tmp_path / "in.aedat4", tmp_path / "part.aedat4", part=Slice(None, 6000, 8000))
    assert part["imu"] == 2
    assert [one.t_us for one in read_imu(tmp_path / "part.aedat4")] == [6000, 7000]
    other = convert(tmp_path / "in.aedat4", tmp_path / "out.csv")
    assert (other["imu"], other["warnings"]) == (0, ["not carried over: 5 IMU samples"])


def test_times_that_do_not_fit_are_moved_by_whole_seconds(tmp_path: Path) -> None:
    np.savez(tmp_path / "in.npz", t=[1_700_000_000_123_456, 1_700_000_000_123_460], x=[1, 2], y=[3, 4], p=[0, 1])
    answer = convert(tmp_path / "in.npz", tmp_path / "out.raw")
    assert answer["shift_us"] == 1_699_999_999_000_000
    assert read_all(tmp_path / "out.raw")[0] == [[1_123_456, 1_123_460], [1, 2], [3, 4], [0, 1]]
    assert any("were subtracted" in warning for warning in answer["warnings"])
    assert (answer["width"], answer["height"]) == (3, 5)
    assert any("--size" in warning for warning in answer["warnings"])


def test_the_size_can_be_given(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    np.savez(tmp_path / "in.npz", t=[1, 2], x=[1, 2], y=[3, 4], p=[0, 1])
    answer = elpd("convert", "in.npz", "out.raw", "--size", "640,480", "--json").json
    assert (answer["width"], answer["height"], answer["warnings"]) == (640, 480, [])


@pytest.mark.parametrize("verb", [["decode"], ["convert", "out.raw"]])
def test_a_pipe_is_refused_at_once_though_nobody_writes_to_it(
    elpd: Callable[..., Answer], tmp_path: Path, verb: list[str]
) -> None:
    os.mkfifo(tmp_path / "pipe")
    name, *rest = verb
    answer = elpd(name, "pipe", *rest, "--json")
    assert (answer.code, answer.json["error"]["kind"]) == (2, "FormatError")
    assert "pipe is a pipe or a device" in answer.json["error"]["message"]
    assert "write the stream to a file first" in answer.json["error"]["message"]


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        (["in.raw", "old.raw"], "UsageError", "old.raw exists; give another name, or --force"),
        (["in.raw", "in.raw", "--force"], "UsageError", "same file"),
        (["in.raw", "absent/out.raw"], "UsageError", "there is no folder"),
        (["in.raw", "."], "UsageError", "there is no suffix; known are ."),
        (["in.raw", "out.mp3"], "UsageError", "known are ."),
        (["in.raw", "out"], "UsageError", "there is no suffix"),
        (["in.raw", "out.raw", "--format", "evt9"], "UsageError", "'evt9' cannot be written; known are "),
        (["absent.raw", "out.raw"], "FormatError", "No such file or directory; check its name"),
        (["-", "out.raw"], "FormatError", "standard input is not read"),
        (["old.raw", "out.raw"], "FormatError", "in no format"),
        (["in.raw", "out.raw", "--roi", "60,0,20,20"], "UsageError", "does not fit the sensor of 64x48"),
        (["in.raw", "out.raw", "--from-us", "9", "--to-us", "9"], "UsageError", "must be later"),
        (["in.raw", "out.raw", "--size", "0,9"], "UsageError", "1 to 2048"),
        (["in.raw", "out.raw", "--size", "9"], "UsageError", "W,H"),
    ],
)
def test_what_cannot_be_done_is_told_and_leaves_nothing(
    elpd: Callable[..., Answer], recording: Path, tmp_path: Path, arguments: list[str], kind: str, message: str
) -> None:
    (tmp_path / "old.raw").write_text("old\n")
    before = recording.read_bytes()
    answer = elpd("convert", *arguments, "--json")
    assert (answer.code, answer.json["error"]["kind"]) == (2, kind)
    assert message in answer.json["error"]["message"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.raw", "old.raw"]
    assert ((tmp_path / "old.raw").read_text(), recording.read_bytes()) == ("old\n", before)


def test_a_source_that_fails_in_the_middle_leaves_nothing(tmp_path: Path) -> None:
    rows = [[5, 1, 1, 1]] * 200_000 + [[17_000_000, 1, 1, 1], [10, 1, 1, 1]]
    np.save(tmp_path / "in.npy", np.array(rows))
    with pytest.raises(UsageError, match="steps back from 17000000 to 10 us"):
        convert(tmp_path / "in.npy", tmp_path / "out.raw")
    assert [path.name for path in tmp_path.iterdir()] == ["in.npy"]


def test_a_file_that_came_into_being_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    def write_while_another_does() -> None:
        with appearing_whole(tmp_path / "out.raw", force=False) as partial:
            partial.write_text("ours")
            (tmp_path / "out.raw").write_text("theirs")

    with pytest.raises(UsageError, match="exists"):
        write_while_another_does()
    assert [path.read_text() for path in tmp_path.iterdir()] == ["theirs"]


WORDS = list(writable_formats())
HD = Geometry(1280, 720)


@pytest.mark.parametrize("word", [word for word in WORDS if word not in {"csv", "txt"}])  # text: see its own tests
def test_memory_stays_bounded_whatever_the_files_length(tmp_path: Path, word: str) -> None:
    columns = many(20_000, geometry=HD, step_us=3)

    def peak(times: int) -> int:
        source, out = tmp_path / f"{times}.raw", tmp_path / f"{times}.{word}"
        with closing(RAW.create(source, "evt3", HD, {})) as writer:
            for k in range(times):
                writer.write(packet([columns[0] + k * 100_000, *columns[1:]]))

        def there_and_back() -> None:
            convert(source, out, word=word, geometry=HD)
            with closing(open_recording(out)) as reader:
                assert summarise(reader)["events"] == times * 20_000

        return peak_bytes(there_and_back)

    short, long = peak(15), peak(45)
    assert (tmp_path / "45.raw").stat().st_size > 4_500_000
    assert long < 1.25 * short


@needs_shared
@pytest.mark.parametrize("name", ["gen3_evt2.raw", "gen41_dense_vectors.raw", "evt3_with_triggers.raw"])
@pytest.mark.parametrize("word", WORDS)
def test_real_recordings_keep_their_digests(tmp_path: Path, name: str, word: str) -> None:
    answer = convert(RECORDINGS / name, tmp_path / "r", word=word)
    with closing(open_recording(RECORDINGS / name)) as one, closing(open_recording(tmp_path / "r")) as other:
        source, written = summarise(one), summarise(other)
    assert written["digest"] == source["digest"]
    assert [written[key] for key in ("events", "on", "first_us", "last_us")] == [
        source[key] for key in ("events", "on", "first_us", "last_us")
    ]
    left_out = [warning for warning in answer["warnings"] if "trigger edges" in warning]
    assert written["triggers"] == ([] if left_out else source["triggers"])
    assert written["lost"] == 0
