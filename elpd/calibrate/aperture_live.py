"""Openings of a rig's own aperture: close, wait for the dark, open, and keep what the pixels said.

The sensor is biased as for focusing, so that each pixel fires once per threshold and not only once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.calibrate.evidence import NO_EVENTS, Columns
from elpd.errors import UsageError
from elpd.events.stream import PacketDecoder
from elpd.focus.expose import AFTER_FACTOR
from elpd.focus.safety import CAMERA_SILENCE_MS
from elpd.focus.stage import REST_LIMIT_MS, Stage
from elpd.ports import Biases, HardwareRoi
from elpd.records import BiasSet
from elpd.units import after_ms

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.ports import RigParts
    from elpd.records import CameraPacket

DARK_MS = 30.0
"""After closing: biases have settled, and the slowest photoreceptor has followed."""

TOLD_BEFORE_US = 10_000
"""Darkness before the command, to know the noise by."""


def take_openings(
    parts: RigParts, openings: int, progress: Callable[[str], None] = lambda _: None
) -> list[tuple[Columns, int, int, int]]:
    """Open and close the aperture; return events, begin, command and end (sensor time) of each opening.

    The lens stays where it is. Raises ``UsageError`` without an aperture, ``DeviceError`` from the rig.
    """
    aperture, camera = parts.aperture, parts.camera
    if aperture is None or aperture.opening_ms <= 0.0:
        raise UsageError("this rig has no aperture that opens; set aperture.driver, or give a recording")
    camera.start()
    try:
        if isinstance(camera, HardwareRoi):
            camera.set_window(None)
        if isinstance(camera, Biases):
            camera.apply_biases(BiasSet.FOCUS)
        stage = Stage(parts)
        stage.rest(REST_LIMIT_MS)
        found = []
        for number in range(openings):
            progress(f"opening {number + 1} of {openings}")
            aperture.close()
            stage.wait_ms(AFTER_FACTOR * aperture.opening_ms)
            keeper = _Keeper(PacketDecoder(camera.geometry))
            stage.listener = keeper.keep
            try:
                stage.wait_ms(DARK_MS)
                stage.learn_time()
                stamp = aperture.open()
                until = after_ms(stamp.begun_ns, AFTER_FACTOR * aperture.opening_ms + DARK_MS)
                while stage.now_ns() < until:
                    stage.read()
                stage.hear(CAMERA_SILENCE_MS)
            finally:
                stage.listener = None
            told_us = int(stage.sensor_clock.to_sensor(stamp.done_ns))
            end_us = int(stage.sensor_clock.to_sensor(until))
            found.append((keeper.events(), told_us - TOLD_BEFORE_US, told_us, end_us))
        return found
    finally:
        camera.stop()


class _Keeper:
    """Keeps what a stage hears."""

    def __init__(self, decoder: PacketDecoder) -> None:
        self._decoder = decoder
        self._pieces: list[Columns] = []

    def keep(self, packet: CameraPacket) -> None:
        t_us, x, y, on = self._decoder.feed(packet)
        if t_us.size:
            self._pieces.append(Columns(t_us.copy(), x.copy(), y.copy(), on.copy()))

    def events(self) -> Columns:
        if not self._pieces:
            return NO_EVENTS
        every = Columns(*(np.concatenate(part) for part in zip(*self._pieces, strict=True)))
        return every.chosen(np.argsort(every.t_us, kind="stable"))
