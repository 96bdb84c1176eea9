"""The Metavision hardware layer behind our door: a stand-in with the names and types of its Python bindings."""

from __future__ import annotations

import sys
import types
from typing import Any

import numpy as np
import pytest
from elpd_drivers.cameras import metavision
from metavision_stand_in import Device, source
from virtual import MonotonicClock

from elpd.errors import CameraError, ConfigError, UsageError
from elpd.events.layout import event_columns
from elpd.records import Geometry


def test_buffers_become_packets_with_the_edges_that_were_in_them() -> None:
    device = Device(
        (1000, [[(3, 4, 1, 900), (5, 6, 0, 990)], [(7, 8, 1, 1000)]], [(1, 950, 6), (0, 960, 6)]), (1500, [], [])
    )
    opened = source(device)
    packet = opened.read(0.0)
    assert packet is not None
    assert isinstance(packet.data, np.ndarray)
    assert [column.tolist() for column in event_columns(packet.data)] == [
        [900, 990, 1000], [3, 5, 7], [4, 6, 8], [1, 0, 1],
    ]  # fmt: skip
    assert [(edge.t_us, edge.id, edge.rising) for edge in packet.triggers] == [(950, 6, True), (960, 6, False)]
    assert (packet.events, packet.complete_until_us) == (3, 984)
    quiet = opened.read(0.0)
    assert quiet is not None
    assert (len(quiet.data), quiet.complete_until_us, quiet.triggers) == (0, 1484, ())
    assert opened.read(0.0) is None
    assert opened.notes() == {"buffers": 2}
    assert (opened.facts.geometry, opened.facts.serial, opened.facts.model) == (
        Geometry(1280, 720), "00050567", "IMX636",
    )  # fmt: skip


def test_the_end_of_the_stream_is_a_lost_camera_and_a_clock_that_falls_back_another_epoch() -> None:
    with pytest.raises(CameraError, match=r"unplugged \(no device\)"):
        source(Device(-1)).read(0.0)
    opened = source(Device((5_000_000, [], []), (10, [], [])))
    opened.read(0.0)
    with pytest.raises(CameraError, match=r"its clock jumped back by 5\.000 s"):
        opened.read(0.0)
    opened.close()
    opened.close()


def test_abilities_are_the_facilities_that_the_camera_has() -> None:
    every = ("window", "biases", "mask", "trigger", "rate_limit", "temperature")
    assert source(Device()).facts.abilities == every
    assert source(Device(missing=("digital_event_mask", "erc_module"))).facts.abilities == (
        "window", "biases", "trigger", "temperature",
    )  # fmt: skip


def test_what_is_asked_for_reaches_the_facilities() -> None:
    device = Device()
    opened = source(
        device, rate_limit_mev_s=20, trigger=False, biases={"expose": {"bias_fo": 5}, "focus": {"bias_diff_on": 30}}
    )
    biases = device.facilities["ll_biases"].calls
    assert sorted(biases) == [("set", "bias_diff_on", 30), ("set", "bias_fo", 20)]
    biases.clear()
    opened.call("apply_biases", ["expose"])
    assert sorted(biases) == [("set", "bias_diff_on", 10), ("set", "bias_fo", 5)]
    assert device.facilities["erc_module"].calls == [("set_cd_event_rate", 20_000_000), ("enable", True)]
    opened.call("limit_rate", [None])
    assert device.facilities["erc_module"].calls[-1] == ("enable", False)
    assert device.facilities["trigger_in"].calls == [("disable", "main")]
    opened.call("enable_trigger", [True])
    assert device.facilities["trigger_in"].calls[-1] == ("enable", "main")
    opened.call("set_window", [[1, 2, 3, 4]])
    opened.call("set_window", [None])
    assert device.facilities["roi"].calls == [
        ("set_window", ("window", 1, 2, 3, 4)), ("enable", True), ("enable", False),
    ]  # fmt: skip
    assert opened.call("set_mask", [[[9, 8]]]) == 1
    assert [slot.calls[-1] for slot in device.slots] == [
        ("set_mask", 9, 8, True), ("set_mask", 0, 0, False), ("set_mask", 0, 0, False),
    ]  # fmt: skip
    assert opened.call("set_mask", [[[9, 8]] * 5]) == 3
    assert opened.call("temperature_c", []) == 41.0


def test_what_the_layer_refuses_is_told_in_its_words() -> None:
    def refuse(*_: Any) -> None:
        raise RuntimeError("bias value out of range [-25, 23]")

    device = Device()
    opened = source(device, biases={"expose": {"bias_fo": 99}})
    device.facilities["ll_biases"] = opened._facility["biases"] = types.SimpleNamespace(set=refuse)
    with pytest.raises(UsageError, match=r"refuses apply_biases: bias value out of range \[-25, 23\]"):
        opened.call("apply_biases", ["expose"])


def test_a_table_that_does_not_fit_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"camera\.biases\.focus\.diff: IMX636 has no such bias; it has bias_diff_on"):
        source(Device(), biases={"focus": {"diff": 3}})
    with pytest.raises(ConfigError, match=r"camera\.rate_limit: IMX636 cannot do that"):
        source(Device(missing=("erc_module",)), rate_limit_mev_s=3)
    monkeypatch.setattr("elpd_drivers.cameras.source.find_spec", lambda _: None)
    with pytest.raises(CameraError, match="the package metavision_hal is not installed; install OpenEB"):
        metavision.open_camera({}, MonotonicClock())
    with pytest.raises(ConfigError, match=r"camera\.rate_limit_mev_s: .*greater than 0"):
        metavision.open_camera({"rate_limit_mev_s": 0}, MonotonicClock())
    hal = types.SimpleNamespace(DeviceDiscovery=types.SimpleNamespace(open=lambda _: None))
    monkeypatch.setitem(sys.modules, "metavision_hal", hal)
    with pytest.raises(CameraError, match="no Prophesee camera found \\(asked for: 0005"):
        metavision.open_source({"serial": "0005"})

    def locked(_: str) -> None:
        raise RuntimeError("Access denied (insufficient permissions)")

    hal.DeviceDiscovery.open = locked
    with pytest.raises(CameraError, match="no permission to open it; `elpd check` prints the udev rule"):
        metavision.open_source({})
