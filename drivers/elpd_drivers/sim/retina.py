"""Light to events: drives the sensor's pixels through one span of time after another.

A span is what the camera flushes at once. It is cut into as many steps as the lens or the aperture makes necessary;
where nothing has changed for longer than any photoreceptor remembers, only noise is drawn. The steps lie on a fixed
grid of sensor time, never on the instants at which somebody reads, so the events do not depend on the reader.

A camera with frames (DAVIS) has them from the same picture: linear light averaged over the exposure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.records import Frame
from elpd.units import NS_PER_US, SensorUs
from elpd_drivers.sim.optics import DARK, MOST_STEPS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Roi
    from elpd_drivers.sim.optics import Condition, LightField
    from elpd_drivers.sim.sensor import Events, EventSensor

FORGOTTEN_US = 20_000
BANDWIDTH_EVERY_US = 4_000
OVEREXPOSED = 0.01


class Retina:
    """A sensor in a light field. Times are us since the sensor's birth; ``birth_ns`` is that instant's host time."""

    def __init__(self, sensor: EventSensor, light: LightField, birth_ns: int, frames: ApsFrames | None = None) -> None:
        self.sensor = sensor
        self._light = light
        self._birth_ns = birth_ns
        self._frames = frames
        self._condition: Condition | None = None
        self._unchanged_us = 0
        self._fitted_us = -BANDWIDTH_EVERY_US
        self._target = np.empty((sensor.window.height, sensor.window.width), np.float32)

    def set_window(self, window: Roi) -> None:
        """Keep only *window* from now on."""
        self.sensor.set_window(window)
        self._target = np.empty((window.height, window.width), np.float32)
        self._disturb()

    def restart(self) -> None:
        """Put all pixels at rest at whatever they see next."""
        self.sensor.restart()
        self._disturb()

    def expose(self, begin_us: int, end_us: int) -> Events:
        """Return the events of a span, times in us since birth."""
        span_us = end_us - begin_us
        grid_us = begin_us + np.arange(MOST_STEPS + 1) * span_us // MOST_STEPS
        conditions = self._light.conditions(self._birth_ns + grid_us * NS_PER_US)
        sensor = self.sensor
        sensor.begin(begin_us, end_us)
        if sensor.needs_picture:
            self._look(conditions[0])
            sensor.settle(self._target)
            self._disturb()
        still = all(condition == self._condition for condition in conditions)
        self._unchanged_us = self._unchanged_us + span_us if still else 0
        if still and self._unchanged_us > FORGOTTEN_US:
            sensor.noise(begin_us, end_us)
        else:
            steps = self._light.steps_needed(conditions)
            stride = MOST_STEPS // steps
            for i in range(0, MOST_STEPS, stride):
                self._step(conditions[i + stride], int(grid_us[i]), int(grid_us[i + stride]))
        if self._frames is not None:
            self._frames.gather(begin_us, end_us, sensor.window, self._target)
        return sensor.finish()

    def _step(self, condition: Condition, begin_us: int, end_us: int) -> None:
        lit = self._condition is None or condition.light != self._condition.light
        if condition != self._condition:
            self._look(condition)
        if lit or begin_us - self._fitted_us >= BANDWIDTH_EVERY_US:
            self.sensor.set_bandwidth(self._target)
            self._fitted_us = begin_us
        self.sensor.noise(begin_us, end_us)
        self.sensor.step(self._target, begin_us, end_us)

    def _look(self, condition: Condition) -> None:
        self._light.render(condition, self.sensor.window, self._target)
        self._condition = condition

    def _disturb(self) -> None:
        """Forget what would let the next span be skipped."""
        self._unchanged_us = 0
        self._condition = None


class ApsFrames:
    """Grey frames at a fixed rate, from the light that fell during each exposure.

    Linear in light, 8 bit, black level 4, with shot and read noise; the gain is set once, from the first frame, so
    that a given share of it clips. Pixels outside the event window stay black.
    """

    PERIOD_US = 20_000
    EXPOSURE_US = 5_000
    READ_OUT_US = 4_000
    BLACK = 4.0
    READ_NOISE = 0.6
    FULL_WELL_ELECTRONS = 12_000.0

    def __init__(self, width: int, height: int, chance: np.random.Generator, overexposed: float = OVEREXPOSED) -> None:
        self._overexposed = overexposed
        self._chance = chance
        self._sum = np.zeros((height, width), np.float32)
        self._weight_us = 0
        self._gain: float | None = None
        self._done: list[Frame] = []

    def gather(self, begin_us: int, end_us: int, window: Roi, target: NDArray[np.float32]) -> None:
        """Add a span's light, *target* being its log photocurrent, to the exposure it belongs to."""
        phase_us = begin_us % self.PERIOD_US
        if phase_us < self.EXPOSURE_US:
            part = self._sum[window.y : window.y + window.height, window.x : window.x + window.width]
            part += (np.exp(target) - np.float32(DARK)) * np.float32(end_us - begin_us)
            self._weight_us += end_us - begin_us
        if self._weight_us and (end_us % self.PERIOD_US) >= self.EXPOSURE_US:
            self._develop(end_us - end_us % self.PERIOD_US)

    def take(self, until_us: int, origin_us: int) -> tuple[Frame, ...]:
        """Return, once, the frames that the host has by *until_us*, stamped on a clock that starts at *origin_us*."""
        ready = [frame for frame in self._done if frame.available_us <= until_us]
        self._done = [frame for frame in self._done if frame.available_us > until_us]
        return tuple(
            Frame(SensorUs(f.t_us + origin_us), SensorUs(f.available_us + origin_us), f.exposure_us, f.pixels)
            for f in ready
        )

    def _develop(self, begin_us: int) -> None:
        mean = self._sum / np.float32(self._weight_us)
        self._sum.fill(0)
        self._weight_us = 0
        if self._gain is None:
            self._gain = 240.0 / max(float(np.percentile(mean, 100 * (1 - self._overexposed))), 1e-3)
        grey = np.maximum(mean * self._gain, 0)
        electrons_per_grey = self.FULL_WELL_ELECTRONS / 255
        noise_sd = np.sqrt(self.READ_NOISE**2 + grey / electrons_per_grey)
        grey = grey + noise_sd * self._chance.standard_normal(grey.shape, np.float32) + self.BLACK
        pixels = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        middle = begin_us + self.EXPOSURE_US // 2
        ready = begin_us + self.EXPOSURE_US + self.READ_OUT_US
        self._done.append(Frame(SensorUs(middle), SensorUs(ready), self.EXPOSURE_US, pixels))
