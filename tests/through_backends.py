"""A simulated camera whose packets pass through a backend of ours, over a stand-in for its library.

What the simulated sensor says is put into the library's own types and handed out by the stand-in; what the backend's
source makes of it is what a cycle gets, in the world's time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import davis_stand_in
import metavision_stand_in
import numpy as np
from elpd_drivers.sim.camera import LATENCY_US

from elpd.events.edges import EdgeReader
from elpd.events.stream import PacketDecoder
from elpd.records import CameraPacket
from elpd.units import HostNs, SensorUs

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd_drivers.sim.camera import SimulatedCamera

    from elpd.records import BiasSet, Geometry

dv = davis_stand_in.dv


class BackendCamera:
    """The simulated sensor behind a source; *hand_over* gives a packet of its to the stand-in."""

    def __init__(self, sensor: SimulatedCamera, source: Any, hand_over: Callable[[CameraPacket], None]) -> None:
        self._sensor, self._source, self._hand_over = sensor, source, hand_over
        self.geometry: Geometry = sensor.geometry
        self.min_latency_us: float = source.facts.min_latency_us
        self.start, self.stop = sensor.start, sensor.stop

    def enable_trigger(self, *, on: bool) -> None:
        self._source.call("enable_trigger", [on])
        self._sensor.enable_trigger(on=on)

    def apply_biases(self, biases: BiasSet) -> None:
        self._sensor.apply_biases(biases)

    def read(self, timeout_s: float) -> CameraPacket | None:
        spoken = self._sensor.read(timeout_s)
        if spoken is None:
            return None
        self._hand_over(spoken)
        made = self._source.read(0.0)
        if made is None:
            return None
        return CameraPacket(
            data=np.asarray(made.data),
            encoding=self._source.facts.encoding,
            received_ns=HostNs(spoken.received_ns),
            complete_until_us=SensorUs(made.complete_until_us),
            frames=made.frames,
            triggers=made.triggers,
            imu=made.imu,
        )


def through_metavision(sensor: SimulatedCamera) -> BackendCamera:
    """Let a simulated EVK4's events and edges come as the hardware layer's decoders hand them out."""
    device = metavision_stand_in.Device()
    decoder, edges = PacketDecoder(sensor.geometry), EdgeReader()

    def hand_over(packet: CameraPacket) -> None:
        events = decoder.feed(packet)
        rows = np.zeros(events.t.size, metavision_stand_in.metavision.EVENTS)
        rows["t"], rows["x"], rows["y"], rows["p"] = events.t, events.x, events.y, events.p
        marks = [(int(edge.rising), int(edge.t_us), edge.id) for edge in edges.of(packet)]
        assert packet.complete_until_us is not None
        device.buffers.append((packet.complete_until_us, [rows], marks))

    step_back_us = metavision_stand_in.metavision.STEP_BACK_US
    return BackendCamera(
        sensor, metavision_stand_in.source(device, min_latency_us=LATENCY_US + step_back_us), hand_over
    )


def through_davis(sensor: SimulatedCamera) -> BackendCamera:
    """Let a simulated DAVIS346's events, frames and edges come as dv-processing's stores, frames and triggers."""
    interval_us = 1000
    source, camera = davis_stand_in.source(interval_us=interval_us, min_latency_us=interval_us + LATENCY_US)
    origin_us = davis_stand_in.EPOCH_US
    kinds = {True: dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE, False: dv.TriggerType.EXTERNAL_SIGNAL_FALLING_EDGE}

    def hand_over(packet: CameraPacket) -> None:
        rows = packet.data
        columns = (rows[name].tolist() for name in ("t", "x", "y", "on"))
        if rows.size:
            camera.batches["Event"].append(
                davis_stand_in.store((origin_us + t, x, y, on) for t, x, y, on in zip(*columns, strict=True))
            )
        for frame in packet.frames:
            begin_us = origin_us + frame.t_us - frame.exposure_us // 2
            camera.batches["Frame"].append(
                dv.Frame(begin_us, frame.exposure_us, 0, 0, np.array(frame.pixels), dv.FrameSource.SENSOR)
            )
        if packet.triggers:
            camera.batches["Trigger"].append(
                [dv.Trigger(origin_us + edge.t_us, kinds[edge.rising]) for edge in packet.triggers]
            )
        assert packet.complete_until_us is not None
        at_rest = [0.0] * 10
        camera.batches["Imu"].append([dv.IMU(origin_us + packet.complete_until_us, *at_rest)])

    return BackendCamera(sensor, source, hand_over)
