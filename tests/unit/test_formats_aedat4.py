"""AEDAT4: events, frames and edges there and back, other people's readers and writers, and damage."""

import datetime as dt
import math
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from elpd_drivers.formats import aedat4_write
from elpd_drivers.formats.aedat4 import FORMAT
from elpd_drivers.formats.aedat4_header import MAGIC
from event_files import (
    GEOMETRY,
    edge,
    event_columns,
    many,
    packet,
    peak_bytes,
    read_all,
    read_imu,
    sample,
    write_all,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from shared import RECORDINGS, needs_shared
from streams import cuts

from elpd.cli.decode import summarise
from elpd.errors import FormatError
from elpd.events.stream import open_recording
from elpd.records import Frame, Geometry
from elpd.units import SensorUs

DAVIS = RECORDINGS / "davis346_frames_events.aedat4"
DIGESTS = ["f1e093cad5af", "1d8ea97b0feb", "18f89da35f8f", "6f99cf01187d"]
SAMPLES = [sample(5010 + 1000 * k, k) for k in range(5)]
EDGES = [edge(5010, 0), edge(5020, 0, rising=False), edge(5030, 1), edge(5040, 2), edge(5050, 3, rising=False)]


def frame(t_us: int, seed: int = 0, *, exposure_us: int = 500, dtype: Any = np.uint8) -> Frame:
    shape = (GEOMETRY.height, GEOMETRY.width)
    pixels = np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype)
    return Frame(SensorUs(t_us), SensorUs(t_us + 9000), exposure_us, pixels)


def create(path: Path) -> aedat4_write.Aedat4Writer:
    return FORMAT.create(path, "aedat4", GEOMETRY, {"serial_number": "DAVIS <7>"})


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "r.aedat4"
    with closing(create(path)) as writer:
        writer.write(packet(many(300), triggers=EDGES, frames=[frame(6000)], imu=SAMPLES))
        writer.write(packet([column[:0] for column in many(1)], frames=[frame(26_000, 1)]))
    return path


@given(columns=event_columns(largest_step_us=10**7), cuts=cuts, chunk=st.integers(1, 2000))
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, columns: Any, cuts: list[int], chunk: int
) -> None:
    path = tmp_path_factory.mktemp("aedat4") / "r.aedat4"
    write_all(create(path), columns, cuts)
    assert read_all(path, chunk)[0] == columns
    with closing(open_recording(path)) as reader:
        assert (reader.geometry, reader.notes["format"], reader.notes["warnings"]) == (GEOMETRY, "AEDAT4", [])
        assert reader.notes["header"] == {"source": "DAVIS <7>"}


def test_edges_and_frames_come_back_with_their_times(small: Path) -> None:
    columns, edges, frames = read_all(small)
    assert columns == [column.tolist() for column in many(300)]
    assert edges == EDGES
    for found, seed in zip(frames, (0, 1), strict=True):
        wanted = frame(found.t_us, seed)
        assert (found.available_us, found.exposure_us) == (wanted.available_us, wanted.exposure_us)
        assert (found.pixels == wanted.pixels).all()
    assert [found.t_us for found in frames] == [6000, 26_000]


def test_inertial_samples_come_back_in_our_units(small: Path) -> None:
    found = read_imu(small)
    assert [one.t_us for one in found] == [one.t_us for one in SAMPLES]
    for one, wanted in zip(found, SAMPLES, strict=True):
        assert one.acceleration_m_s2 == pytest.approx(wanted.acceleration_m_s2, rel=1e-6)
        assert one.rotation_rad_s == pytest.approx(wanted.rotation_rad_s, rel=1e-6)
        assert one.temperature_c == 30.5


def test_what_was_changed_or_left_out_is_told(tmp_path: Path) -> None:
    with closing(create(tmp_path / "r.aedat4")) as writer:
        deep = frame(6000, dtype=np.uint16)
        other = Frame(SensorUs(1), SensorUs(2), 1, np.zeros((2, 2), np.uint8))
        writer.write(packet(many(1), triggers=[edge(5, 7)], frames=[deep, other]))
        assert [warning[:2] for warning in writer.warnings] == ["1 "] * 3
    _, edges, frames = read_all(tmp_path / "r.aedat4")
    assert edges == [edge(5, 0)]
    assert (frames[0].pixels == deep.pixels >> 8).all()


def test_an_unfinished_file_is_read_and_says_so(tmp_path: Path) -> None:
    writer = create(tmp_path / "r.aedat4")
    writer.write(packet(many(300)))
    writer.close(complete=False)
    writer.close()
    assert len(read_all(tmp_path / "r.aedat4")[0][0]) == 300
    with closing(open_recording(tmp_path / "r.aedat4")) as reader:
        assert "was not finished" in reader.notes["warnings"][0]


def test_a_live_cameras_small_packets_are_gathered(tmp_path: Path) -> None:
    columns = many(4000)
    with closing(create(tmp_path / "r.aedat4")) as writer:
        for k in range(4000):
            writer.write(packet([column[k : k + 1] for column in columns]))
    assert (tmp_path / "r.aedat4").stat().st_size < 4000 * 16 + 4000
    assert read_all(tmp_path / "r.aedat4")[0] == [column.tolist() for column in columns]


@settings(max_examples=150)
@given(data=st.data())
def test_no_damage_makes_the_reader_fail_in_another_way(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("aedat4") / "r.aedat4"
    with closing(create(path)) as writer:
        writer.write(packet(many(20), triggers=EDGES, frames=[frame(6000)]))
        writer.write(packet(many(20, seed=2)))
    whole = bytearray(path.read_bytes())
    places = st.integers(14, len(whole) - 1)
    for at in data.draw(st.lists(places, max_size=5)):
        whole[at] = data.draw(st.integers(0, 255))
    path.write_bytes(whole[: data.draw(st.one_of(st.none(), places))])
    try:
        with closing(open_recording(path)) as reader:
            assert sum(len(one.data) for one in reader.packets(100)) <= 40
            assert isinstance(reader.notes["lost"], int)
    except FormatError:
        return


def test_a_damaged_packet_is_counted_and_the_rest_is_read(small: Path) -> None:
    whole = bytearray(small.read_bytes())
    at = whole.index(b"FRME", 2000)
    whole[at : at + 4] = b"EMRF"
    small.write_bytes(whole)
    with closing(open_recording(small)) as reader:
        summary = summarise(reader)
    assert (summary["events"], summary["frames"], summary["lost"]) == (300, 1, 1)
    assert summary["lost_reason"] == ["1 packets are damaged"]


@pytest.mark.parametrize(
    ("begin", "message"), [(b"", "0 bytes"), (b"\x40\0\0\0abc", "ends within"), (b"\x08\0\0\0" + b"x" * 8, "damaged")]
)
def test_a_damaged_header_is_named(tmp_path: Path, begin: bytes, message: str) -> None:
    (tmp_path / "r.aedat4").write_bytes(MAGIC + begin)
    with pytest.raises(FormatError, match=message):
        open_recording(tmp_path / "r.aedat4")


def test_a_missing_package_is_named(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dv = pytest.importorskip("dv_processing")
    write_with_dv(dv, small, "LZ4")
    monkeypatch.setitem(__import__("sys").modules, "lz4.frame", None)
    with pytest.raises(FormatError, match="pip install lz4"):
        open_recording(small)


def test_a_sensor_that_is_too_large_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="15-bit"):
        FORMAT.create(tmp_path / "r.aedat4", "aedat4", Geometry(40_000, 5), {})


# --- other people's ----------------------------------------------------------------------------------------------


def test_the_aedat_package_reads_what_we_write(small: Path) -> None:
    aedat = pytest.importorskip("aedat")
    found: dict[str, list[Any]] = {}
    for one in aedat.Decoder(small):
        for kind, value in one.items():
            found.setdefault(kind, []).append(value)
    events = np.concatenate(found["events"])
    for ours, name in zip(many(300), ("t", "x", "y", "on"), strict=True):
        assert (ours == events[name]).all()
    assert [one["source"] for one in np.concatenate(found["triggers"])] == [1, 2, 4, 6, 9]
    (inertial,) = found["imus"]
    assert inertial["t"].tolist() == [one.t_us for one in SAMPLES]
    assert inertial["accelerometer_x"].tolist() == pytest.approx([g(one.acceleration_m_s2[0]) for one in SAMPLES])
    assert inertial["gyroscope_z"].tolist() == pytest.approx([math.degrees(one.rotation_rad_s[2]) for one in SAMPLES])
    theirs = found["frame"][0]
    assert (theirs["exposure_begin_t"], theirs["exposure_end_t"], theirs["end_t"]) == (5750, 6250, 15_000)
    assert (theirs["pixels"] == frame(6000).pixels).all()


def test_dv_processing_reads_what_we_write(small: Path) -> None:
    dv = pytest.importorskip("dv_processing")
    recording = dv.io.MonoCameraRecording(str(small))
    assert recording.getEventResolution() == (64, 48)
    events = recording.getNextEventBatch().numpy()
    for ours, name in zip(many(300), ("timestamp", "x", "y", "polarity"), strict=True):
        assert (ours == events[name]).all()
    theirs = recording.getNextFrame()
    assert (theirs.exposure, theirs.timestamp) == (dt.timedelta(microseconds=500), 5750)
    assert (theirs.image == frame(6000).pixels).all()
    assert [one.timestamp for one in recording.getNextTriggerBatch()] == [one.t_us for one in EDGES]
    inertial = recording.getNextImuBatch()
    assert [one.timestamp for one in inertial] == [one.t_us for one in SAMPLES]
    assert [one.temperature for one in inertial] == [30.5] * 5
    for one, wanted in zip(inertial, SAMPLES, strict=True):
        assert one.accelerometerY == pytest.approx(g(wanted.acceleration_m_s2[1]))
        assert one.gyroscopeX == pytest.approx(math.degrees(wanted.rotation_rad_s[0]))


def g(acceleration_m_s2: float) -> float:
    return acceleration_m_s2 / 9.80665


def write_with_dv(dv: Any, path: Path, compression: str) -> None:
    config = dv.io.MonoCameraWriter.Config("CAM", getattr(dv.CompressionType, compression))
    config.addEventStream((64, 48))
    config.addFrameStream((64, 48))
    config.addTriggerStream()
    config.addImuStream()
    writer = dv.io.MonoCameraWriter(str(path), config)
    store = dv.EventStore()
    for t, x, y, p in zip(*(column.tolist() for column in many(300)), strict=True):
        store.push_back(t, x, y, bool(p))
    writer.writeEvents(store)
    image = dv.Frame(5750, frame(6000).pixels)
    image.exposure = dt.timedelta(microseconds=500)
    writer.writeFrame(image)
    colours = dv.Frame(7750, np.full((48, 64, 3), 90, np.uint8))
    writer.writeFrame(colours)
    writer.writeTrigger(dv.Trigger(5010, dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE))
    writer.writeImu(dv.IMU(5020, 31.0, 0.0, 0.0, 1.0, 180.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    del writer


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "LZ4_HIGH", "ZSTD", "ZSTD_HIGH"])
def test_what_dv_processing_writes_is_read(tmp_path: Path, compression: str) -> None:
    dv = pytest.importorskip("dv_processing")
    path = tmp_path / "r.aedat4"
    write_with_dv(dv, path, compression)
    columns, edges, frames = read_all(path)
    assert columns == [column.tolist() for column in many(300)]
    assert edges == EDGES[:1]
    assert [(one.t_us, one.exposure_us, one.pixels.shape) for one in frames] == [
        (6000, 500, (48, 64)),
        (7750, 0, (48, 64)),
    ]
    assert (frames[0].pixels == frame(6000).pixels).all()
    assert (frames[1].pixels == 90).all()
    (inertial,) = read_imu(path)
    assert (inertial.t_us, inertial.temperature_c) == (5020, 31.0)
    assert inertial.acceleration_m_s2 == (0.0, 0.0, 9.80665)
    assert inertial.rotation_rad_s == pytest.approx((math.pi, 0.0, 0.0))


# --- a real one --------------------------------------------------------------------------------------------------


@needs_shared
def test_the_digests_are_those_of_the_field() -> None:
    with closing(open_recording(DAVIS)) as reader:
        summary = summarise(reader)
    assert list(summary["digest"].values()) == DIGESTS
    assert [summary[name] for name in ("events", "frames", "imu", "width", "height", "lost", "warnings")] == [
        *(78_830, 59, 2363, 346, 260, 0, [])
    ]
    assert len(summary["triggers"]) == 236


@needs_shared
def test_the_aedat_package_agrees_on_every_inertial_sample() -> None:
    aedat = pytest.importorskip("aedat")
    theirs = np.concatenate([one["imus"] for one in aedat.Decoder(DAVIS) if "imus" in one])
    ours = read_imu(DAVIS)
    assert len(ours) == len(theirs) == 2363
    assert [one.t_us for one in ours] == theirs["t"].tolist()
    assert [one.temperature_c for one in ours] == theirs["temperature"].tolist()
    for place, axis in enumerate("xyz"):
        assert [g(one.acceleration_m_s2[place]) for one in ours] == pytest.approx(theirs[f"accelerometer_{axis}"])
        turned = [math.degrees(one.rotation_rad_s[place]) for one in ours]
        assert turned == pytest.approx(theirs[f"gyroscope_{axis}"], abs=1e-6)
    length = np.linalg.norm([one.acceleration_m_s2 for one in ours], axis=1)
    assert 9.3 < np.median(length) < 10.3, "a camera that hardly moves feels gravity"


@needs_shared
def test_the_aedat_package_agrees_on_every_frame() -> None:
    aedat = pytest.importorskip("aedat")
    theirs = [one["frame"] for one in aedat.Decoder(DAVIS) if "frame" in one]
    ours = read_all(DAVIS, 1 << 16)[2]
    assert len(ours) == len(theirs) == 59
    for one, other in zip(ours, theirs, strict=True):
        begin, end = other["exposure_begin_t"], other["exposure_end_t"]
        assert (one.t_us, one.exposure_us, one.available_us) == ((begin + end) // 2, end - begin, other["end_t"])
        assert (one.pixels == other["pixels"]).all()


@needs_shared
@settings(max_examples=15, deadline=None)
@given(size=st.integers(20, 400_000))
def test_a_real_file_cut_short_anywhere_is_read_as_far_as_it_goes(
    tmp_path_factory: pytest.TempPathFactory, size: int
) -> None:
    path = tmp_path_factory.mktemp("aedat4") / "r.aedat4"
    path.write_bytes(DAVIS.read_bytes()[:size])
    try:
        columns, _, _ = read_all(path)
    except FormatError:
        assert size < 4000
        return
    whole = read_all(DAVIS)[0]
    assert columns == [column[: len(columns[0])] for column in whole]


@needs_shared
def test_memory_stays_bounded() -> None:
    def read() -> None:
        with closing(open_recording(DAVIS)) as reader:
            summarise(reader)

    assert peak_bytes(read) < 3_500_000 < DAVIS.stat().st_size
