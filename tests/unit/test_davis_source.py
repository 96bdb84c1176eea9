"""dv-processing behind our door: its own stores, frames and triggers, handed out by a camera that is not there."""

from __future__ import annotations

import math
from datetime import timedelta

import numpy as np
import pytest
from davis_stand_in import EPOCH_US, dv, source, store
from elpd_drivers.cameras import davis
from virtual import MonotonicClock

from elpd.errors import CameraError, ConfigError
from elpd.events.layout import event_columns
from elpd.records import Encoding, Geometry


def test_the_store_that_the_library_makes_is_the_one_we_know() -> None:
    assert store([(1, 2, 3, True)]).numpy().dtype == davis.EVENTS


def test_events_are_copied_and_counted_from_a_second_before_the_first() -> None:
    opened, camera = source()
    given = store([(EPOCH_US, 3, 4, True), (EPOCH_US + 700, 5, 6, False)])
    camera.batches["Event"].append(given)
    packet = opened.read(0.0)
    assert packet is not None
    assert isinstance(packet.data, np.ndarray)
    assert not np.shares_memory(packet.data, given.numpy())
    t, x, y, p = event_columns(packet.data)
    assert [column.tolist() for column in (x, y, p)] == [[3, 5], [4, 6], [1, 0]]
    assert np.diff(t).tolist() == [700]
    assert packet.events == 2
    assert packet.complete_until_us == int(t[-1]) - 1000, "a commit interval behind the newest stamp"


def test_the_inertial_sensor_keeps_time_in_the_dark() -> None:
    opened, camera = source()
    camera.batches["Imu"] += [[dv.IMU(EPOCH_US + at, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)] for at in (0, 1000)]
    first, second = opened.read(0.0), opened.read(0.0)
    assert first is not None
    assert second is not None
    assert (first.events, len(first.data)) == (0, 0)
    assert second.complete_until_us == (first.complete_until_us or 0) + 1000
    assert opened.read(0.0) is None


def test_inertial_samples_are_in_our_units_and_count_from_our_origin() -> None:
    opened, camera = source()
    camera.batches["Imu"] += [[dv.IMU(EPOCH_US, 30, 0, 0, -1, 0, 90, 0, 0, 0, 0)]] * 2
    packet = opened.read(0.0)
    assert packet is not None
    (sample,) = packet.imu
    assert (sample.t_us, sample.temperature_c) == (1_000_000, 30)
    assert sample.acceleration_m_s2 == (0, 0, -9.80665)
    assert sample.rotation_rad_s == (0, math.pi / 2, 0)
    opened.call("enable_imu", [False])
    silent = opened.read(0.0)
    assert silent is not None
    assert silent.imu == ()


def test_a_frame_is_dated_by_the_middle_of_its_exposure_and_known_after_its_read_out() -> None:
    opened, camera = source()
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    camera.batches["Imu"].append([dv.IMU(EPOCH_US, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)])
    camera.batches["Frame"].append(dv.Frame(EPOCH_US + 10_000, 500, 0, 0, image, dv.FrameSource.SENSOR))
    packet = opened.read(0.0)
    assert packet is not None
    (frame,) = packet.frames
    assert (frame.t_us, frame.exposure_us) == (1_010_250, 500)
    assert frame.available_us == 1_010_500 + davis.READ_OUT_US
    np.testing.assert_array_equal(frame.pixels, image)


def test_edges_of_the_signal_input_are_triggers_and_the_exposure_s_are_not() -> None:
    opened, camera = source()
    kinds = dv.TriggerType
    camera.batches["Imu"].append([dv.IMU(EPOCH_US, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)])
    camera.batches["Trigger"].append([
        dv.Trigger(EPOCH_US + at, kind)
        for at, kind in enumerate(
            (kinds.APS_EXPOSURE_START, kinds.EXTERNAL_SIGNAL_RISING_EDGE, kinds.EXTERNAL_SIGNAL_FALLING_EDGE)
        )
    ])  # fmt: skip
    packet = opened.read(0.0)
    assert packet is not None
    assert opened.notes() == {"frames": 0}
    assert [(edge.t_us, edge.rising) for edge in packet.triggers] == [(1_000_001, True), (1_000_002, False)]


def test_the_settings_reach_the_camera() -> None:
    opened, camera = source(
        exposure_us=700, frame_interval_us=20_000, interval_us=2000, trigger=False, biases={"focus": {"On": (5, 100)}}
    )
    said = camera.said
    assert said["TimeInterval"] == said["USBEarlyPacketDelay"] == (timedelta(milliseconds=2),)
    assert (said["AutoExposure"], said["ExposureDuration"]) == ((False,), (timedelta(microseconds=700),))
    assert said["FrameInterval"] == (timedelta(milliseconds=20),)
    assert said["DetectorRunning"] == (False,)
    biases = dv.io.camera.DAVIS.Davis346BiasCF
    assert said["Davis346BiasCoarseFine"] == (biases.On, 5, 100)
    opened.call("apply_biases", ["expose"])
    assert said["Davis346BiasCoarseFine"] == (biases.On, 4, 39), "what only the other set names goes back"
    opened.call("set_window", [[10, 20, 30, 40]])
    assert said["CropAreaEvents"] == ((10, 20, 30, 40),)
    opened.call("set_window", [None])
    assert said["CropAreaEvents"] == ((0, 0, 346, 260),)
    opened.call("enable_trigger", [True])
    assert said["DetectorRunning"] == (True,)
    assert opened.facts.geometry == Geometry(346, 260)
    assert (opened.facts.encoding, opened.facts.serial) == (Encoding.ARRAY, "00000499")
    assert opened.facts.min_latency_us == 2000


def test_every_method_that_is_called_is_the_library_s_own() -> None:
    """The stand-in takes only what the real class can be told; what it answers the real one must know, too."""
    for name in ("isRunning", "getEventResolution", "getCameraName", "getSerialNumber", "getNextImuBatch"):
        assert hasattr(dv.io.camera.DAVIS, name), name


@pytest.mark.parametrize(
    ("model", "abilities"), [("DVXplorer", ("window", "trigger", "imu")), ("DVXplorerM", ("window", "imu"))]
)
def test_cameras_without_frames_are_told_what_they_know(model: str, abilities: tuple[str, ...]) -> None:
    opened, camera = source(getattr(dv.io.camera, model))
    assert opened.facts.abilities == abilities
    opened.call("set_window", [[10, 20, 30, 40]])
    assert camera.said["CropArea"] == ((10, 20, 30, 40),)
    assert ("DetectorRunning" in camera.said) == ("trigger" in abilities)
    with pytest.raises(ConfigError, match=r"camera\.biases: this camera's biases cannot be set one by one"):
        source(getattr(dv.io.camera, model), biases={"focus": {"On": (1, 2)}})
    opened.close()
    opened.close()


def test_an_unplugged_camera_is_an_error() -> None:
    opened, camera = source()
    camera.running = False
    with pytest.raises(CameraError, match=r"unplugged \(no device\)"):
        opened.read(0.0)
    opened.close()
    opened.close()


def test_a_clock_that_was_set_back_is_another_epoch() -> None:
    opened, camera = source()
    camera.batches["Event"] += [store([(EPOCH_US + at, 1, 2, True)]) for at in (5_000_000, 4_500_000, 3_900_000)]
    for _ in range(2):
        assert opened.read(0.0) is not None, "streams are handed out out of step"
    with pytest.raises(CameraError, match=r"its clock jumped back by 1\.100 s; it was reset, start again"):
        opened.read(0.0)


def test_wrong_tables_say_so() -> None:
    with pytest.raises(ConfigError, match=r"camera\.biases\.focus\.on: a DAVIS346 has no such bias; it has .*Diff.*On"):
        source(biases={"focus": {"on": (1, 2)}})
    for table, reason in (
        ({"exposure": 3}, r"camera\.exposure: unknown key; known are .*exposure_us"),
        ({"biases": {"focusing": {}}}, r"camera\.biases\.focusing: unknown key; known are expose, focus"),
        ({"interval_us": 10}, r"camera\.interval_us: .*greater than or equal to 1000 \(got 10\)"),
    ):
        with pytest.raises(ConfigError, match=reason):
            davis.open_camera(table, MonotonicClock())


def test_no_camera_is_a_sentence() -> None:
    with pytest.raises(CameraError, match=r"no iniVation camera found|dv-processing"):
        davis.open_source({})
