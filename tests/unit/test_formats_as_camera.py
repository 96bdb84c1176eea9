"""Every format as the camera of a cycle, for the detector and for the map: what is recorded can be played."""

from __future__ import annotations

from contextlib import closing
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from command_line import Answer, caller
from elpd_drivers.cameras.file import encodings, open_camera
from event_files import GEOMETRY, edge, many, packet
from shared import RECORDINGS, needs_shared

from elpd.errors import CameraError
from elpd.events.stream import PacketDecoder
from elpd.record.convert import convert
from elpd.record.files import format_for, writable_formats
from elpd.records import Encoding, Frame, Geometry
from elpd.units import HostNs, SensorUs

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from elpd.records import CameraPacket

WORDS = list(writable_formats())


class StillClock:
    def now_ns(self) -> HostNs:
        return HostNs(0)

    def sleep_until(self, when: HostNs) -> None:
        """Time stands still: nothing is waited for at pace 0."""


def written(folder: Path, word: str, packets: list[CameraPacket], geometry: Geometry = GEOMETRY) -> Path:
    path = folder / f"r.{word}"
    writes, word = format_for(path, word)
    with closing(writes.create(path, word, geometry, {})) as writer:
        for one in packets:
            writer.write(one)
    return path


def played(path: Path, **settings: Any) -> list[tuple[CameraPacket, list[list[int]]]]:
    """Return every packet and its events, until the recording ends."""
    camera = open_camera({"path": path, "pace": 0, "width": 64, "height": 48} | settings, StillClock())
    decoder = PacketDecoder(camera.geometry)
    found: list[tuple[CameraPacket, list[list[int]]]] = []
    camera.start()
    try:
        while one := camera.read(1.0):
            found.append((one, [column.tolist() for column in decoder.feed(one)]))
    except CameraError as ended:
        assert "has ended" in str(ended)  # noqa: PT017  (the end of a recording is how this returns)
    finally:
        camera.stop()
    return found


@pytest.mark.parametrize("word", WORDS)
def test_every_format_is_played_in_packets_of_time(tmp_path: Path, word: str) -> None:
    columns = many(3000)
    edges = [edge(6000), edge(20_000, rising=False)]
    path = written(tmp_path, word, [packet(columns, triggers=edges)])
    found = played(path)
    assert len(found) > 20
    assert {one.encoding for one, _ in found} == encodings({"path": str(path)}), "said beforehand"
    assert [[t for _, part in found for t in part[k]] for k in range(4)] == [column.tolist() for column in columns]
    for (one, part), (following, _) in pairwise(found):
        if one.complete_until_us is not None:
            assert not part[0] or max(part[0]) < one.complete_until_us
            assert following.complete_until_us is None or following.complete_until_us >= one.complete_until_us
    played_edges = [(one.t_us, one.rising) for each, _ in found for one in each.triggers]
    kept = word.startswith("evt") or word in {"aedat4", "hdf5", "hdf5-deflate"}
    assert played_edges == ([(6000, True), (20_000, False)] if kept else [])


def test_frames_come_when_a_host_could_have_them(tmp_path: Path) -> None:
    pictures = [
        Frame(SensorUs(t), SensorUs(t + 9000), 500, np.full((48, 64), t // 1000, np.uint8)) for t in (8000, 18_000)
    ]
    found = played(written(tmp_path, "aedat4", [packet(many(3000), frames=pictures)]))
    frames = [(each.complete_until_us, one) for each, _ in found for one in each.frames]
    assert [(until, one.t_us, one.exposure_us, int(one.pixels[0, 0])) for until, one in frames] == [
        (18_000, 8000, 500, 8),
        (28_000, 18_000, 500, 18),
    ]


@pytest.mark.parametrize("word", ["csv", "npy", "aedat4", "evt2", "evt3", "evt2.1"])
def test_a_clock_that_was_set_back_ends_the_playing(tmp_path: Path, word: str) -> None:
    first, second = many(500), many(500, seed=2)
    second[0] = second[0] + 20_000
    first[0] = first[0] + 2_000_000
    path = written(tmp_path, word, [packet(first), packet(second)])
    with pytest.raises(AssertionError, match="clock jumps back from 20"):
        played(path)
    answer = convert(path, tmp_path / "out.npy")
    assert any("time jumps back 1 times" in warning for warning in answer["warnings"])


def test_steps_back_of_some_microseconds_are_no_jump(tmp_path: Path) -> None:
    columns = many(3000)
    columns[0][::7] -= 11
    found = played(written(tmp_path, "npy", [packet(columns)]))
    assert [t for _, part in found for t in part[0]] == columns[0].tolist()


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


@pytest.mark.parametrize("word", WORDS)
def test_the_detector_takes_every_format_and_says_the_same(
    elpd: Callable[..., Answer], tmp_path: Path, word: str
) -> None:
    same = elpd("detect", str(written(tmp_path, "evt3", [packet(many(3000))])), "--roi", "0,0,60,40", "--json")
    answer = elpd("detect", str(written(tmp_path, word, [packet(many(3000))])), "--roi", "0,0,60,40", "--json")
    assert (answer.code, answer.json["events"]) == (same.code, same.json["events"])
    assert answer.json["outcome"] == same.json["outcome"]


@needs_shared
def test_a_real_davis_recording_is_played_with_its_frames() -> None:
    path = RECORDINGS / "davis346_frames_events.aedat4"
    camera = open_camera({"path": path, "pace": 0, "packet_us": 10_000}, StillClock())
    assert camera.geometry == Geometry(346, 260)
    found = played(path, packet_us=10_000, width=346, height=260)
    assert sum(len(part[0]) for _, part in found) == 78_830
    frames = [one for each, _ in found for one in each.frames]
    assert (len(frames), {one.exposure_us for one in frames}) == (59, {500})
    assert all(one.encoding is Encoding.ARRAY for one, _ in found)
    times = [one.available_us for one in frames]
    assert times == sorted(times)
    inertial = [(each.complete_until_us, one.t_us) for each, _ in found for one in each.imu]
    assert len(inertial) == 2363
    assert all(until is None or t_us < until for until, t_us in inertial), "none comes before its packet's time"


@needs_shared
@pytest.mark.parametrize("word", ["aedat4", "npz"])
def test_the_map_of_an_opening_is_the_same_from_every_format(
    elpd: Callable[..., Answer], tmp_path: Path, word: str
) -> None:
    source = RECORDINGS / "evk4_aperture_opening.raw"
    convert(source, tmp_path / f"r.{word}", word=word)
    maps = [
        elpd("temporal-map", str(path), "--size", "1280,720", "--out", f"{k}.png", "--json").json
        for k, path in enumerate((source, tmp_path / f"r.{word}"))
    ]
    for one in maps:
        del one["out"]
    assert maps[0] == maps[1]
    assert (tmp_path / "0.png").read_bytes() == (tmp_path / "1.png").read_bytes()
