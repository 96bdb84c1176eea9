"""``elpd record``: a camera's data in a file that is readable whatever ended it."""

from __future__ import annotations

import resource
import subprocess
import sys
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
from command_line import SMALL_RIG, Answer, caller
from event_files import GEOMETRY, edge, many, packet, read_all, read_imu, sample

from elpd.errors import CameraError, UsageError
from elpd.events.evt3_encode import Evt3Encoder
from elpd.events.stream import open_recording
from elpd.record import recorder
from elpd.record.recorder import record
from elpd.records import CameraPacket, Encoding, Frame
from elpd.units import HostNs, SensorUs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

FIELDS = {
    *("out", "format", "width", "height", "seconds", "ended", "truncated", "reason", "events", "on", "first_us"),
    *("last_us", "triggers", "frames", "imu", "lost", "lost_reason", "warnings"),
}
FREE = 10**15


class HeldClock:
    def __init__(self) -> None:
        self.ns = 0

    def now_ns(self) -> HostNs:
        return HostNs(self.ns)

    def sleep_until(self, when: HostNs) -> None:
        self.ns = max(self.ns, when)


class ScriptedCamera:
    """Sends a packet every 10 ms, and then nothing or its end."""

    geometry = GEOMETRY

    def __init__(self, clock: HeldClock, packets: list[CameraPacket], *, ends: bool = False) -> None:
        self.clock, self.packets, self.ends, self.running = clock, packets, ends, False

    def start(self) -> None:
        self.left, self.running = list(self.packets), True

    def read(self, timeout_s: float) -> CameraPacket | None:
        if self.left:
            self.clock.ns += 10_000_000
            return self.left.pop(0)
        if self.ends:
            raise CameraError("the cable was pulled")
        self.clock.ns += round(timeout_s * 1e9)
        return None

    def stop(self) -> None:
        self.running = False


def arrays(n: int, each: int = 100, *, frame: bool = False) -> list[CameraPacket]:
    columns = many(n * each)
    pictures = [Frame(SensorUs(6000), SensorUs(7000), 500, np.full((48, 64), 9, np.uint8))] if frame else []
    return [packet([column[k * each : (k + 1) * each] for column in columns],
                   triggers=[edge(5000 + k)] if k < 2 else [], frames=pictures if k == 1 else [],
                   imu=[sample(5000 + k)])
            for k in range(n)]  # fmt: skip


def words(n: int) -> list[CameraPacket]:
    encoder = Evt3Encoder(64)
    return [
        CameraPacket(encoder.encode(*(one.data[name] for name in "txyp")).copy(), Encoding.EVT3, HostNs(0))
        for one in arrays(n)
    ]


class Made(NamedTuple):
    answer: dict[str, Any]
    camera: ScriptedCamera


def made(folder: Path, packets: list[CameraPacket], name: str = "r", *, ends: bool = False, **options: Any) -> Made:
    clock = HeldClock()
    camera = ScriptedCamera(clock, packets, ends=ends)
    answer = record(camera, clock, folder / name, reserve_bytes=0, **({"seconds": 1.0} | options))
    assert not camera.running
    assert answer.keys() >= FIELDS
    return Made(answer, camera)


@contextmanager
def no_file_longer_than(size: int) -> Iterator[None]:
    """Let writing fail past *size*, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_words_are_written_as_they_came(tmp_path: Path) -> None:
    packets = words(20)
    answer = made(tmp_path, packets, facts={"serial_number": "7"}).answer
    assert (answer["out"], answer["format"], answer["ended"]) == (str(tmp_path / "r.raw"), "evt3", "time")
    assert (answer["events"], answer["truncated"], answer["warnings"]) == (2000, False, [])
    sent = b"".join(one.data.tobytes() for one in packets)
    assert (tmp_path / "r.raw").read_bytes().endswith(b"% complete yes\n% end\n" + sent)
    with closing(open_recording(tmp_path / "r.raw")) as reader:
        assert (reader.geometry, reader.notes["header"]["serial_number"]) == (GEOMETRY, "7")


def test_all_that_comes_with_arrays_goes_to_aedat4(tmp_path: Path) -> None:
    answer = made(tmp_path, arrays(20, frame=True)).answer
    assert [answer[name] for name in ("format", "events", "triggers", "frames", "imu")] == ["aedat4", 2000, 2, 1, 20]
    columns, edges, frames = read_all(tmp_path / "r.aedat4")
    assert columns == [column.tolist() for column in many(2000)]
    assert edges == [edge(5000), edge(5001)]
    assert (frames[0].pixels == 9).all()
    assert [one.t_us for one in read_imu(tmp_path / "r.aedat4")] == list(range(5000, 5020))


@pytest.mark.parametrize(
    ("name", "word", "form"),
    [("r.raw", None, "evt3"), ("r.raw", "evt2", "evt2"), ("r.csv", None, "csv"), ("r.npy", None, "npy"),
     ("r.dat", None, "dat"), ("r", "aedat4", "aedat4")],
)  # fmt: skip
@pytest.mark.parametrize("source", [words, arrays])
def test_a_format_can_be_asked_for(tmp_path: Path, name: str, word: str | None, form: str, source: Any) -> None:
    answer = made(tmp_path, source(5), name, word=word).answer
    assert (answer["format"], answer["events"]) == (form, 500)
    assert read_all(tmp_path / name)[0] == [column.tolist() for column in many(500)]


def test_time_and_interruption_end_it(tmp_path: Path) -> None:
    made_ = made(tmp_path, arrays(20), "a.npy", seconds=0.05)
    assert (made_.answer["events"], made_.answer["seconds"], made_.answer["ended"]) == (500, 0.05, "time")
    calls = iter(range(100))
    answer = made(tmp_path, arrays(20), "b.npy", seconds=None, cancelled=lambda: next(calls) >= 3).answer
    assert (answer["events"], answer["ended"], answer["truncated"]) == (300, "interrupted", False)


def test_what_the_camera_lost_is_told(tmp_path: Path) -> None:
    first, second = arrays(2)
    gap = CameraPacket(second.data, second.encoding, HostNs(0), gap_before=True, lost_events=40)
    answer = made(tmp_path, [first, gap]).answer
    assert (answer["lost"], answer["lost_reason"]) == (40, ["the camera's driver lost 40 events"])
    assert answer["warnings"][0].startswith("1 gaps")


@pytest.mark.parametrize(("source", "name"), [(words, "r.raw"), (arrays, "r.aedat4")])
def test_a_lost_camera_leaves_what_it_sent_marked(tmp_path: Path, source: Any, name: str) -> None:
    answer = made(tmp_path, source(5), name, ends=True).answer
    assert (answer["ended"], answer["truncated"], answer["reason"]) == ("camera_lost", True, "the cable was pulled")
    assert answer["events"] == 500
    assert "was not finished" in answer["warnings"][0]


@pytest.mark.parametrize(
    ("source", "name"),
    [
        (words, "r.raw"),
        (arrays, "r.raw"),
        (arrays, "r.aedat4"),
        (arrays, "r.npy"),
        (arrays, "r.csv"),
        (arrays, "r.dat"),
    ],
)
@pytest.mark.parametrize("size", [6000, 9001, 20_003])
def test_a_full_disk_leaves_whole_what_was_written(tmp_path: Path, source: Any, name: str, size: int) -> None:
    with no_file_longer_than(size):
        answer = made(tmp_path, source(50), name).answer
    assert (answer["ended"], answer["truncated"]) == ("disk_full", True)
    assert "is full" in answer["reason"]
    assert (tmp_path / name).stat().st_size <= size
    columns = read_all(tmp_path / name)[0]
    count = len(columns[0])
    assert columns == [column[:count].tolist() for column in many(5000)]
    assert answer["events"] == count
    assert count > 0 or (name, size) == ("r.aedat4", 6000)
    with closing(open_recording(tmp_path / name)) as reader:
        list(reader.packets())
        assert reader.notes["lost"] == 0
        if name in {"r.raw", "r.aedat4"}:
            assert "was not finished" in reader.notes["warnings"][0]


def test_some_room_is_left_for_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Usage(NamedTuple):
        free: int

    sizes = iter([200 << 20, 150 << 20, 99 << 20])
    monkeypatch.setattr(recorder.shutil, "disk_usage", lambda _: Usage(next(sizes)))
    clock = HeldClock()
    camera = ScriptedCamera(clock, arrays(100, 20_000))
    answer = record(camera, clock, tmp_path / "r.npy", reserve_bytes=100 << 20)
    assert (answer["ended"], answer["truncated"]) == ("disk_full", True)
    assert 2 * (4 << 20) < (tmp_path / "r.npy").stat().st_size < 3 * (4 << 20)


def test_a_full_tmpfs_is_survived(tmp_path: Path) -> None:
    script = (
        "import sys; sys.path[:0] = sys.argv[2:]\n"
        "from pathlib import Path; from test_record import *\n"
        "clock = HeldClock(); camera = ScriptedCamera(clock, arrays(400, 2000))\n"
        "answer = record(camera, clock, Path(sys.argv[1]) / 'r.aedat4', reserve_bytes=0)\n"
        "print(answer['ended'], answer['truncated'], answer['events'] > 100_000)\n"
    )
    command = f'mount -t tmpfs -o size=6m tmpfs "{tmp_path}" && exec "$@"'
    here = [str(Path(__file__).parent), *(path for path in sys.path if path)]
    ended = subprocess.run(
        ["unshare", "-m", "sh", "-c", command, "sh", sys.executable, "-c", script, str(tmp_path), *here],
        capture_output=True,
        text=True,
        check=False,
    )
    if "unshare" in ended.stderr or "mount" in ended.stderr:
        pytest.skip("no mounts of our own here")
    assert ended.stdout == "disk_full True True\n", ended.stderr


@pytest.mark.parametrize(
    ("name", "word", "message"),
    [
        ("old.raw", None, "exists"),
        ("r.npz", None, "only readable when it is finished"),
        ("r.hdf5", None, "only readable when it is finished"),
        ("r.mp3", None, "no format has the suffix '.mp3'"),
        ("absent/r.raw", None, "there is no folder"),
    ],
)
def test_what_cannot_be_recorded_to_is_told_before_the_camera_starts(
    tmp_path: Path, name: str, word: str | None, message: str
) -> None:
    (tmp_path / "old.raw").write_text("old")
    clock = HeldClock()
    with pytest.raises(UsageError, match=message):
        record(ScriptedCamera(clock, []), clock, tmp_path / name, word=word, seconds=1.0, reserve_bytes=0)
    assert clock.ns == 0
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("old.raw", "old")]


def test_a_disk_without_room_is_told_before(tmp_path: Path) -> None:
    clock = HeldClock()
    with pytest.raises(UsageError, match="MiB are free"):
        record(ScriptedCamera(clock, []), clock, tmp_path / "r", reserve_bytes=FREE)


def test_a_camera_that_sends_nothing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"sent nothing in 1\.0 s"):
        made(tmp_path, [])
    with pytest.raises(CameraError, match="pulled"):
        made(tmp_path, [], ends=True)
    assert list(tmp_path.iterdir()) == []


# --- the command -------------------------------------------------------------------------------------------------


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


def test_the_simulated_camera_is_recorded_without_moving(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    answer = elpd("record", *SMALL_RIG, "--seconds", "0.05", "--json")
    assert (answer.code, answer.err) == (0, "")
    assert answer.json.keys() >= FIELDS
    assert answer.json["ended"] == "time"
    (file,) = tmp_path.iterdir()
    assert (file.name, file.suffix) == (answer.json["out"], ".raw")
    decoded = elpd("decode", file.name, "--json").json
    assert (decoded["events"], decoded["width"], decoded["warnings"]) == (answer.json["events"], 320, [])


def test_a_recording_as_the_camera_ends_as_a_camera_does(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    made(tmp_path, words(5), "in.raw")
    camera = ("--set", "camera.driver=file", "--set", "camera.path=in.raw", "--set", "camera.pace=0")
    answer = elpd("record", *camera, "--out", "out.raw", "--json")
    assert (answer.code, answer.json["ended"]) == (3, "camera_lost")
    assert read_all(tmp_path / "out.raw") == read_all(tmp_path / "in.raw")
    told = elpd("record", *camera, "--out", "out.raw", "--force")
    assert "truncated the recording in.raw has ended" in told.out


@pytest.mark.parametrize(
    ("arguments", "code", "kind"),
    [
        (["--seconds", "1"], 4, "BusyError"),
        (["--foreground", "--seconds", "-1"], 2, "UsageError"),
        (["--set", "rig=hardware"], 2, "ConfigError"),
        (["--set", "camera.driver=abacus"], 2, "ConfigError"),
    ],
)
def test_what_cannot_be_done_is_told(elpd: Callable[..., Answer], arguments: list[str], code: int, kind: str) -> None:
    answer = elpd("record", *arguments, "--json")
    assert (answer.code, answer.json["error"]["kind"]) == (code, kind)
