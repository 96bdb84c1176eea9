"""A dynamic vision sensor's pixels: log photocurrent in, events out.

Each pixel is a first-order photoreceptor whose bandwidth is proportional to its photocurrent, followed by a comparator
that fires when the level has moved by a contrast threshold from where it was last reset. After an event the pixel is
held in reset for the refractory time and takes the level at its *end* as its new reference, as the circuit does.
Thresholds differ from pixel to pixel with a fixed pattern; shot noise fires the comparator that is nearer, leakage
fires ON, hot pixels fire without reason. Time is cut into steps; inside one, the level is a straight line and event
times are interpolated on it.

Where the picture stands still nothing is computed but noise; the kernels stand in ``pixels``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.records import BiasSet, Roi
from elpd_drivers.sim.optics import CACHED_PIXELS
from elpd_drivers.sim.pixels import fire_noise, scratch, sort_events, step_pixels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

LAG_US_AT_FULL = 60.0
"""Photoreceptor time constant at intensity 1: 0.3 ms at 0.2, and so on."""

SLOWEST_LAG_US = 2_000.0
MISMATCH_SD = 0.035
MISMATCH_STEP = 0.00125
HOT_PIXEL_HZ = 2_000.0
UNSETTLED_HZ = 60.0
UNSETTLED_TAU_US = 700.0
UNSETTLED_US = 3_000
NEVER_US = 1 << 62
CAPACITY_MARGIN = 1 << 16

NEAREST, ON = 0, 1


@dataclass(frozen=True, slots=True)
class BiasLevels:
    """What a set of biases means: contrast thresholds (in natural log) and refractory time."""

    c_on: float
    c_off: float
    refractory_us: int


EXPOSE = BiasLevels(c_on=0.25, c_off=1.5, refractory_us=400_000)
"""One ON event per pixel and opening: refractory longer than any opening, OFF all but disabled."""

FOCUS = BiasLevels(c_on=0.18, c_off=0.18, refractory_us=500)


@dataclass(frozen=True, slots=True)
class Events:
    """Events of one span of sensor time, sorted by time; ``lost`` is how many the sensor itself could not deliver."""

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]
    lost: int = 0

    def part(self, begin: int, end: int) -> Events:
        """Return those from index *begin* to *end*."""
        return Events(self.t_us[begin:end], self.x[begin:end], self.y[begin:end], self.on[begin:end])


class EventSensor:
    """The pixels of a window and their state.

    Parameters
    ----------
    width, height
        Of the whole sensor.
    pattern
        Draws what is fixed at manufacture: mismatch and hot pixels.
    chance
        Draws what happens: noise.
    noise_hz, leak_hz
        Rates per pixel.
    hot_pixel_hz
        How often a hot pixel's comparator trips of itself, before the refractory time thins it.
    mismatch
        Standard deviation of the thresholds over pixels, relative; ON and OFF are drawn apart.
    lag_us
        Time constant of a photoreceptor at intensity 1; it grows in inverse proportion to the light.
    memories
        Whether pixels begin focusing with the memories of a running sensor, or all freshly reset.
    """

    def __init__(
        self,
        width: int,
        height: int,
        pattern: np.random.Generator,
        chance: np.random.Generator,
        *,
        noise_hz: float = 1.0,
        leak_hz: float = 0.1,
        hot_pixels: int = 0,
        hot_pixel_hz: float = HOT_PIXEL_HZ,
        mismatch: float = MISMATCH_SD,
        lag_us: float = LAG_US_AT_FULL,
        focus: BiasLevels = FOCUS,
        memories: bool = True,
    ) -> None:
        self._sets = {BiasSet.EXPOSE: EXPOSE, BiasSet.FOCUS: focus}
        self._memories = memories
        self._biases = focus
        self._chance = chance
        self._noise_hz = noise_hz
        self._leak_hz = leak_hz
        self._hot_pixel_hz = hot_pixel_hz
        self._mismatch_step = MISMATCH_STEP * (mismatch / MISMATCH_SD)
        self._lag_us = lag_us
        self._scratch = scratch()
        self._unsettled_since_us = -NEVER_US
        self._unsettled = False
        unit = MISMATCH_SD / MISMATCH_STEP
        drawn = np.clip(np.rint(128 + unit * pattern.standard_normal((2, height, width))), 0, 255)
        self._spread_on, self._spread_off = drawn.astype(np.uint8)
        self.hot = [(int(pattern.integers(width)), int(pattern.integers(height))) for _ in range(hot_pixels)]
        self._masked: frozenset[tuple[int, int]] = frozenset()
        self.window = Roi(0, 0, width, height)
        self._fresh = True
        self._allocate()

    def set_window(self, window: Roi) -> None:
        """Keep only *window*'s pixels from now on; pixels that enter start from the present brightness."""
        old, state = self.window, (self.level, self._reference, self._held, self._release_us)
        self.window = window
        self._allocate()
        if self._fresh:
            self._apply_mask()
            return
        self._fresh = True  # entering pixels wait, in reset, for the next picture
        left, top = max(old.x, window.x), max(old.y, window.y)
        right = min(old.x + old.width, window.x + window.width)
        bottom = min(old.y + old.height, window.y + window.height)
        if left < right and top < bottom:
            to = np.s_[top - window.y : bottom - window.y, left - window.x : right - window.x]
            source = np.s_[top - old.y : bottom - old.y, left - old.x : right - old.x]
            self._entering[to] = False
            self.level[to], self._reference[to] = state[0][source], state[1][source]
            self._held[to], self._release_us[to] = state[2][source], state[3][source]
        self._apply_mask()

    def set_mask(self, pixels: Sequence[tuple[int, int]]) -> None:
        """Switch off exactly these pixels."""
        unmasked = self._masked - frozenset(pixels)
        for x, y in unmasked:
            if self._inside(x, y):
                self._release_us[y - self.window.y, x - self.window.x] = 0
        self._masked = frozenset(pixels)
        self._apply_mask()

    def apply_biases(self, biases: BiasSet, now_us: int) -> None:
        """Switch thresholds and refractory time; for a few milliseconds the pixels fire without order.

        Moving biases disturb what the pixels remember. At the end of that time they hold their present level when they
        have been made ready for an exposure; ready for focusing, they are where a running sensor's pixels are: anywhere
        between their two thresholds (``memories``), or all at their present level without.
        """
        self._biases = self._sets[biases]
        self._unsettled_since_us = now_us
        self._unsettled = True

    def restart(self) -> None:
        """Let all pixels begin anew, at whatever they are settled on next."""
        self._allocate()
        self._fresh = True
        self._apply_mask()

    @property
    def needs_picture(self) -> bool:
        """Whether some pixel has no level yet, so that the next step must be a ``settle``."""
        return self._fresh

    def settle(self, target: NDArray[np.float32]) -> None:
        """Put pixels that have just been switched on at rest at *target*, (height, width) log photocurrent."""
        self.level[self._entering] = target[self._entering]
        self._reference[self._entering] = target[self._entering]
        self._entering[:] = False
        self._fresh = False

    def set_bandwidth(self, log_photocurrent: NDArray[np.float32]) -> None:
        """Make the photoreceptors as fast as this photocurrent lets them be."""
        parts = max(1, self._rate.size // CACHED_PIXELS)
        for log_rows, rows in zip(
            np.array_split(log_photocurrent, parts), np.array_split(self._rate, parts), strict=True
        ):
            np.exp(log_rows, out=rows)
            rows *= np.float32(1 / self._lag_us)
            np.maximum(rows, np.float32(1 / SLOWEST_LAG_US), out=rows)
        self._gain_fits_us = 0

    def begin(self, begin_us: int, end_us: int) -> None:
        """Open a span of time; its steps follow in order, then ``finish``."""
        self._begin_us, self._end_us, self._count = begin_us, end_us, 0
        if self._unsettled and begin_us >= self._unsettled_since_us + UNSETTLED_US:
            self._unsettled = False
            self._reference[:] = self.level
            if self._biases is self._sets[BiasSet.FOCUS] and self._memories:
                self._reference -= self._left_between_thresholds()
            self._held.fill(0)
            self._apply_mask()

    def _left_between_thresholds(self) -> NDArray[np.float32]:
        """Draw how far each pixel's level is from what it remembers: evenly, from one threshold to the other."""
        span = np.float32(self._biases.c_on + self._biases.c_off)
        drawn: NDArray[np.float32] = self._chance.random(self.level.shape, np.float32)
        return drawn * (np.float32(0.98) * span) - np.float32(0.98 * self._biases.c_off)

    def noise(self, begin_us: int, end_us: int) -> None:
        """Let noise, leakage and hot pixels fire in a part of the span, before the same part's ``step``."""
        times, pixels, kinds = self._noise_candidates(begin_us, end_us)
        if not len(times):
            return
        biases = self._biases
        dice = self._chance.random(len(times), np.float32)
        self._count = fire_noise(
            times, pixels, kinds, self.level.ravel(), self._reference.ravel(), self._held.ravel(),
            self._release_us.ravel(), np.float32(biases.c_on), np.float32(biases.c_off), dice, biases.refractory_us,
            self._count, self._out_t, self._out_pixel, self._out_on,
        )  # fmt: skip

    def step(self, target: NDArray[np.float32], begin_us: int, end_us: int) -> None:
        """Let the picture change evenly to *target* in a part of the span."""
        biases = self._biases
        self._fit_gain(end_us - begin_us)
        self._count = step_pixels(
            target.ravel(), self.level.ravel(), self._reference.ravel(), self._gain.ravel(),
            self._window_on.ravel(), self._window_off.ravel(), self._held.ravel(), self._release_us.ravel(),
            np.float32(biases.c_on), np.float32(biases.c_off), np.float32(self._mismatch_step), biases.refractory_us,
            begin_us, end_us, self._count, self._out_t, self._out_pixel, self._out_on, *self._scratch,
        )  # fmt: skip

    def finish(self) -> Events:
        """Close the span and return its events, sorted by time."""
        kept = min(self._count, len(self._out_t))
        t, on = np.empty(kept, np.int64), np.empty(kept, np.uint8)
        x, y = np.empty(kept, np.uint16), np.empty(kept, np.uint16)
        span_us = self._end_us - self._begin_us
        sort_events(
            self._out_t, self._out_pixel, self._out_on, kept, self._begin_us, span_us, self.window.width,
            self.window.x, self.window.y, np.empty(span_us + 1, np.int64), t, x, y, on,
        )  # fmt: skip
        return Events(t, x, y, on, self._count - kept)

    def _fit_gain(self, step_us: int) -> None:
        """Set the photoreceptors' gain for a step: implicit Euler, which delays a ramp by exactly the time constant."""
        if self._gain_fits_us == step_us:
            return
        self._gain_fits_us = step_us
        parts = max(1, self._rate.size // CACHED_PIXELS)
        for rate, gain in zip(np.array_split(self._rate, parts), np.array_split(self._gain, parts), strict=True):
            np.multiply(rate, np.float32(step_us), out=gain)
            np.divide(gain, gain + np.float32(1), out=gain)

    def _noise_candidates(
        self, begin_us: int, end_us: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]:
        chance, span_us = self._chance, end_us - begin_us
        pixels = self.window.width * self.window.height
        rate_hz = self._noise_hz
        since_us = begin_us - self._unsettled_since_us
        if since_us < UNSETTLED_US:
            rate_hz += UNSETTLED_HZ * float(np.exp(-since_us / UNSETTLED_TAU_US))
        noise = int(chance.poisson(pixels * rate_hz * span_us * 1e-6))
        leak = int(chance.poisson(pixels * self._leak_hz * span_us * 1e-6))
        which = chance.integers(pixels, size=noise + leak)
        kinds = np.repeat(np.array([NEAREST, ON], np.uint8), [noise, leak])
        hot = [(y - self.window.y) * self.window.width + x - self.window.x for x, y in self.hot if self._inside(x, y)]
        if hot:
            bursts = chance.poisson(self._hot_pixel_hz * span_us * 1e-6, len(hot))
            which = np.concatenate([which, np.repeat(hot, bursts)])
            kinds = np.concatenate([kinds, np.full(int(bursts.sum()), ON, np.uint8)])
        times = begin_us + chance.integers(span_us, size=len(which))
        order = np.argsort(times, kind="stable")
        return times[order], which[order], kinds[order]

    def _allocate(self) -> None:
        window = self.window
        shape = (window.height, window.width)
        rows, columns = slice(window.y, window.y + window.height), slice(window.x, window.x + window.width)
        self._window_on = np.ascontiguousarray(self._spread_on[rows, columns])
        self._window_off = np.ascontiguousarray(self._spread_off[rows, columns])
        self.level = np.zeros(shape, np.float32)
        self._reference = np.zeros(shape, np.float32)
        self._rate = np.full(shape, 1 / SLOWEST_LAG_US, np.float32)
        self._gain, self._gain_fits_us = np.empty(shape, np.float32), 0
        self._held = np.zeros(shape, np.uint8)
        self._release_us = np.zeros(shape, np.int64)
        self._entering = np.ones(shape, np.bool_)
        capacity = shape[0] * shape[1] + CAPACITY_MARGIN
        self._out_t, self._out_pixel = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
        self._out_on = np.empty(capacity, np.uint8)

    def _apply_mask(self) -> None:
        for x, y in self._masked:
            if self._inside(x, y):
                self._held[y - self.window.y, x - self.window.x] = 1
                self._release_us[y - self.window.y, x - self.window.x] = NEVER_US

    def _inside(self, x: int, y: int) -> bool:
        window = self.window
        return window.x <= x < window.x + window.width and window.y <= y < window.y + window.height
