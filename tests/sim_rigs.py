"""Simulated cameras over stand-in lenses, for tests of the world that need no lens controller."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from elpd_drivers.sim.aperture import SimulatedAperture
from elpd_drivers.sim.camera import ArrayWire, SimulatedCamera
from elpd_drivers.sim.motion import SceneMotion
from elpd_drivers.sim.optics import DefocusStack, LightField
from elpd_drivers.sim.retina import ApsFrames, Retina
from elpd_drivers.sim.scene import scene_canvas
from elpd_drivers.sim.sensor import EventSensor
from elpd_drivers.sim.world import BIRTH_NS, World, random_stream
from numpy.typing import NDArray

from elpd.records import BiasSet, CameraPacket, Geometry

MARGIN_PX = 32


@dataclass
class Ramp:
    """A lens that rests at *start_um*, moves from *begin_s* for *travel_um* at *speed_um_s*, and rests again."""

    start_um: float = -200.0
    speed_um_s: float = 4000.0
    begin_s: float = 0.01
    travel_um: float = 400.0

    def carriage_um(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        since_s = (np.asarray(times_ns) - BIRTH_NS) / 1e9 - self.begin_s
        return self.start_um + np.clip(
            since_s * self.speed_um_s, *sorted((0.0, np.copysign(self.travel_um, self.speed_um_s)))
        )


class Setup:
    """A world with a camera in it; focus is at 0 um."""

    def __init__(
        self,
        lens: Any = None,
        *,
        seed: int = 1,
        scene: str = "camera",
        size: tuple[int, int] = (96, 80),
        motion: str = "static",
        with_aperture: bool = False,
        with_frames: bool = False,
        wire: Any = None,
        aperture: dict[str, Any] | None = None,
        light: dict[str, Any] | None = None,
        sensor: dict[str, Any] | None = None,
        camera: dict[str, Any] | None = None,
        brightness: float = 1.0,
    ) -> None:
        width, height = size
        self.world = World()
        self.canvas = scene_canvas(scene, width, height, MARGIN_PX)
        self.stack = DefocusStack(self.canvas, brightness)
        self.aperture = SimulatedAperture(self.world, random_stream(seed, "aperture"), **(aperture or {}))
        self.light = LightField(
            self.stack,
            (lens or Ramp(speed_um_s=1e-9)).carriage_um,
            0.0,
            SceneMotion(motion, random_stream(seed, "motion"), MARGIN_PX - 3),
            aperture=self.aperture if with_aperture else None,
            depth_of_focus_um=6.0,
            margin_px=MARGIN_PX,
            **(light or {}),
        )
        pattern, chance = random_stream(seed, "pattern"), random_stream(seed, "noise")
        self.sensor = EventSensor(width, height, pattern, chance, **(sensor or {}))
        frames = ApsFrames(width, height, random_stream(seed, "frames")) if with_frames else None
        self.camera = SimulatedCamera(
            self.world,
            Retina(self.sensor, self.light, BIRTH_NS, frames),
            wire or ArrayWire(),
            Geometry(width, height),
            birth_ns=BIRTH_NS,
            origin_us=10_690_000,
            jitter=random_stream(seed, "usb"),
            frames=frames,
            **(camera or {}),
        )

    def packets(self, until_s: float) -> list[CameraPacket]:
        """Read everything up to an instant of the world, in seconds after its birth."""
        end = BIRTH_NS + round(until_s * 1e9)
        got = []
        while self.world.now_ns() < end:
            packet = self.camera.read(min(0.01, (end - self.world.now_ns()) / 1e9))
            if packet is not None:
                got.append(packet)
        return got

    def run(self, until_s: float) -> NDArray[Any]:
        """Start if need be, read up to an instant, and return the events with t in us since the world's birth."""
        self.camera.start()
        events = np.concatenate(
            [np.empty(0, ArrayWire().encode(_NO_EVENTS, 0, 0).dtype), *(p.data for p in self.packets(until_s))]
        )
        events["t"] -= 10_690_000
        return events

    def expose(self, until_s: float) -> NDArray[Any]:
        """Open the aperture at once, with the sensor biased for it."""
        self.camera.start()
        self.camera.apply_biases(BiasSet.EXPOSE)
        self.aperture.open()
        return self.run(until_s)


class _NoEvents:
    t_us = x = y = on = np.empty(0, np.int64)


_NO_EVENTS: Any = _NoEvents()


def rank_correlation(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Spearman's rho, ties in order of appearance."""
    ranks = [np.argsort(np.argsort(v.ravel(), kind="stable"), kind="stable") for v in (a, b)]
    return float(np.corrcoef(*ranks)[0, 1])
