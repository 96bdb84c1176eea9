"""neuromorphic-drivers' arrays behind our door: a DAVIS346 and a DVXplorer, with the library's own settings."""

from __future__ import annotations

import types
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from elpd_drivers.cameras import neuromorphic, neuromorphic_tables
from elpd_drivers.cameras.neuromorphic import NeuromorphicSource
from elpd_drivers.cameras.neuromorphic_tables import NeuromorphicSettings

from elpd.errors import CameraError, ConfigError
from elpd.records import Encoding, Geometry, ImuSample
from elpd.units import SensorUs

nd = pytest.importorskip("neuromorphic_drivers")

MODULES = {"inivation_davis346": nd.inivation_davis346, "inivation_dvxplorer": nd.inivation_dvxplorer}


class Device:
    """Hands out what the test put there and keeps the last configuration it was given."""

    def __init__(self, kind: str, *packets: Any) -> None:
        self.kind, self.packets, self.configuration = kind, deque(packets), None
        self.closed = 0

    def properties(self) -> Any:
        return MODULES[self.kind].Properties()

    def name(self) -> Any:
        return nd.Name[self.kind.upper()]

    def serial(self) -> str:
        return "00000499"

    def __next__(self) -> Any:
        if not self.packets:
            return nd.status.Status(10.0, None), None
        given = self.packets.popleft()
        if isinstance(given, Exception):
            raise given
        ring = nd.status.RingStatus(
            system_time=9.75,
            backlog=2,
            raw_packets=1,
            clutch_engaged=False,
            current_t=given.pop("t"),
            dropped_packets=5,
        )
        packet = types.SimpleNamespace(
            **{
                "polarity_events": None,
                "trigger_events": None,
                "imu_events": None,
                "frames": [],
                "polarity_events_overflow_indices": None,
                "trigger_events_overflow_indices": None,
                **given,
            }
        )
        return nd.status.Status(10.0, ring), packet

    def update_configuration(self, configuration: Any) -> None:
        configuration.serialize()  # the library refuses here what it cannot send
        self.configuration = configuration

    def close(self) -> None:
        self.closed += 1


def source(device: Device, **settings: Any) -> NeuromorphicSource:
    table = NeuromorphicSettings.model_validate(settings)
    module = MODULES[device.kind]
    configuration = neuromorphic_tables.configured(module, table)
    return NeuromorphicSource(device, module, device.kind, configuration, table)


def events(*times: int) -> Any:
    array = np.zeros(len(times), neuromorphic.EVENTS)
    array["t"] = times
    return array


def test_the_library_names_fields_as_we_know_them() -> None:
    """The stand-in's packets have the fields of the real ones."""
    for name in ("polarity_events", "trigger_events", "imu_events", "frames", "polarity_events_overflow_indices"):
        assert name in nd.Davis346Packet.__annotations__
    for name in ("start_t", "exposure_start_t", "exposure_end_t", "t", "pixels"):
        assert name in nd.Frame.__annotations__


def test_arrays_frames_and_edges_of_a_davis346() -> None:
    pixels = np.full((260, 346), 64, np.uint16)
    frames = [
        types.SimpleNamespace(start_t=100, exposure_start_t=200, exposure_end_t=600, t=9000, pixels=pixels),
        types.SimpleNamespace(start_t=100, exposure_start_t=None, exposure_end_t=None, t=9000, pixels=pixels),
        types.SimpleNamespace(start_t=100, exposure_start_t=None, exposure_end_t=5000, t=9000, pixels=pixels),
    ]
    edges = np.array([(7, 0, 1), (8, 0, 0), (9, 0, 2)], [("t", "<u8"), ("id", "u1"), ("polarity", "u1")])
    device = Device(
        "inivation_davis346",
        {"t": 1234, "polarity_events": events(1000, 1001), "frames": frames, "trigger_events": edges},
        {"t": 1300},
        {"t": 1400, "polarity_events": events(1399), "polarity_events_overflow_indices": np.array([0])},
    )
    opened = source(device)
    assert (opened.facts.encoding, opened.facts.geometry) == (Encoding.ARRAY, Geometry(346, 260))
    assert opened.facts.abilities == ("biases", "mask", "imu")
    packet = opened.read(0.0)
    assert packet is not None
    assert (packet.events, packet.complete_until_us, packet.backlog, packet.gap_before) == (2, 1234, 2, False)
    assert [(frame.t_us, frame.exposure_us, frame.available_us) for frame in packet.frames] == [
        (400, 400, 9000),
        (2100, 4000, 9000),
        (3000, 4000, 9000),
    ]
    assert [(edge.t_us, edge.rising) for edge in packet.triggers] == [(7, True), (8, False), (9, True)]
    quiet = opened.read(0.0)
    assert quiet is not None
    assert (quiet.events, len(quiet.data), quiet.complete_until_us) == (0, 0, 1300)
    after = opened.read(0.0)
    assert after is not None
    assert after.gap_before
    assert opened.notes()["usb_overflows"] == 1
    assert opened.notes()["usb_packets_dropped"] == 5
    assert opened.read(0.0) is None
    opened.close()
    assert device.closed == 1


def test_a_davis346_takes_masks_and_biases() -> None:
    device = Device("inivation_davis346")
    opened = source(device, biases={"expose": {"onbn": 1500}, "focus": {"onbn": 1600}}, exposure_us=700)
    opened.call("apply_biases", ["expose"])
    assert device.configuration is not None
    assert device.configuration.biases.onbn == 1500
    assert opened.call("set_mask", [[[1, 0], [0, 2]]]) == 2
    assert device.configuration.pixel_mask == (2, 1 + 2 * 346, 0, 0, 0, 0, 0, 0)
    assert device.configuration.biases.onbn == 1500, "what was set before stays"
    assert device.configuration.exposure_us == 700


def test_a_dvxplorer_has_biases_and_no_more() -> None:
    opened = source(Device("inivation_dvxplorer", {"t": 5, "polarity_events": events(3)}))
    assert opened.facts.abilities == ("biases", "imu")
    assert opened.facts.geometry == Geometry(640, 480)
    packet = opened.read(0.0)
    assert packet is not None
    assert packet.events == 1


@pytest.mark.parametrize("kind", ["inivation_davis346", "inivation_dvxplorer"])
def test_inertial_samples_are_delivered_unless_they_are_not_wanted(kind: str) -> None:
    fields = [*(f"{sensor}_{axis}" for sensor in ("accelerometer", "gyroscope") for axis in "xyz"), "temperature"]
    samples = np.array([(70, 1, 2, 9.5, 0.25, 0, 0, 30)], [("t", "<u8"), *((name, "<f4") for name in fields)])
    opened = source(Device(kind, *({"t": 100, "imu_events": samples} for _ in range(2))))
    packet = opened.read(0.0)
    assert packet is not None
    assert packet.imu == (ImuSample(SensorUs(70), (1.0, 2.0, 9.5), (0.25, 0.0, 0.0), 30.0),)
    opened.call("enable_imu", [False])
    silent = opened.read(0.0)
    assert silent is not None
    assert silent.imu == ()


def test_an_error_of_the_library_is_a_lost_camera() -> None:
    device = Device("inivation_davis346", RuntimeError("InivationDavis346(Usb(Rusb(NoDevice)))"))
    with pytest.raises(CameraError, match=r"unplugged \(no device\)"):
        source(device).read(0.0)


def test_a_layout_that_is_not_known_is_refused() -> None:
    device = Device("inivation_davis346", {"t": 5, "polarity_events": np.zeros(1, [("t", "<u4")])})
    with pytest.raises(CameraError, match="install the version that elpd was made for"):
        source(device).read(0.0)


def test_settings_that_a_camera_has_not_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"camera\.rate_limit_mev_s: this camera has no rate controller"):
        source(Device("inivation_davis346"), rate_limit_mev_s=3)
    with pytest.raises(ConfigError, match=r"camera\.biases\.expose\.diff_on: this camera has no such bias; .*onbn"):
        source(Device("inivation_davis346"), biases={"expose": {"diff_on": 3}})
    bounds = replace(nd.prophesee_evk4.BiasesBounds(), diff_on=nd.prophesee_evk4.Bounds(-35, 10))
    table = NeuromorphicSettings.model_validate({"biases": {"focus": {"diff_on": 11}}})
    with pytest.raises(ConfigError, match=r"diff_on: 11 is outside what this prophesee evk4 takes, -35 to 10"):
        neuromorphic_tables.check_bounds(table.biases, bounds, "prophesee_evk4")


def listing(*devices: tuple[str, str | None, str | None]) -> Any:
    listed = [types.SimpleNamespace(name=nd.Name[name], serial=serial, error=error) for name, serial, error in devices]
    return types.SimpleNamespace(list_devices=lambda: listed)


@pytest.mark.parametrize(
    ("there", "asked", "reason"),
    [
        ((), {}, r"none found \(asked for: any; plugged in: none that"),
        ((("PROPHESEE_EVK4", "1", None), ("PROPHESEE_EVK4", "2", None)), {}, "several would do .*camera.serial"),
        ((("PROPHESEE_EVK4", "1", None),), {"model": "davis346"}, "asked for: davis346; plugged in: prophesee evk4 1"),
        ((("PROPHESEE_EVK4", None, "Access denied"),), {}, "no permission to open it"),
        ((("PROPHESEE_EVK4", None, "Resource busy"),), {}, "another program holds it"),
    ],
)
def test_which_camera_is_meant_must_be_clear(there: Any, asked: dict[str, Any], reason: str) -> None:
    with pytest.raises(CameraError, match=reason):
        neuromorphic_tables.choose(listing(*there), NeuromorphicSettings.model_validate(asked))


def test_an_evk4_whose_type_was_not_read_at_first_is_listed_twice_and_meant_once() -> None:
    there = listing(("PROPHESEE_EVK3_HD", None, "Pipe error"), ("PROPHESEE_EVK4", "1", None))
    assert neuromorphic_tables.choose(there, NeuromorphicSettings()) == ("prophesee_evk4", "1")
