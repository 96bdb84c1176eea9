"""An event sensor after v2e (Hu, Liu and Delbruck, CVPRW 2021), written from its description.

Per pixel: the logarithm of intensity, linear below 20 grey levels; a first-order low-pass whose corner falls with
intensity (photoreceptor); a threshold of its own for either polarity; a leak that drags the reference down; shot noise,
more of it in the dark; a refractory period. Parameters carry v2e's names and defaults.

Three things differ from v2e, all towards the real sensor. Events have time stamps inside the frame interval, where the
low-passed level, taken linear between frames, crosses the threshold (v2e spreads them evenly). During the refractory
period the pixel is held in reset, so its reference is the level at the *end* of it (v2e drops events but keeps counting
levels). And references start anywhere within a threshold of the level, as in a sensor that has been looking around.

The kernel is a pure function of its arguments; all chance is drawn before, from one generator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.events.jit import kernel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

LINEAR_BELOW = 20.0
LEAST_THRESHOLD = 0.01
_DARK_NOISE = 0.25
"""v2e's SHOT_NOISE_INTEN_FACTOR: how much of the dark's shot noise is left in full light."""


@dataclass(frozen=True, slots=True)
class RetinaSettings:
    """v2e's parameters, under v2e's names. A ``settled`` sensor starts with every reference at its level."""

    pos_thres: float
    neg_thres: float
    sigma_thres: float
    cutoff_hz: float = 300.0
    leak_rate_hz: float = 0.01
    shot_noise_rate_hz: float = 0.001
    refractory_period_s: float = 0.0005
    settled: bool = False


@dataclass(frozen=True, slots=True)
class RetinaEvents:
    """Events in order of time: ``t_us`` int64, ``x`` ``y`` uint16, ``on`` uint8, all (n,)."""

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]


class Retina:
    """Turns frames into events, one frame interval at a time."""

    def __init__(
        self,
        settings: RetinaSettings,
        first: NDArray[np.float32],
        begin_us: int,
        end_us: int,
        rng: np.random.Generator,
    ) -> None:
        if settings.refractory_period_s < 5e-5:
            raise ValueError(f"refractory_period_s must be 50 us or more; got {settings.refractory_period_s}")
        self._settings = settings
        self._shape = first.shape
        pixels = first.size
        self._tau_us = 1e6 / (2.0 * np.pi * settings.cutoff_hz)
        self._refractory_us = 1e6 * settings.refractory_period_s
        self._thresholds = np.maximum(
            rng.normal((settings.pos_thres, settings.neg_thres), settings.sigma_thres, (pixels, 2)), LEAST_THRESHOLD
        )
        self._level = lin_log(first.ravel().astype(np.float64))
        leftover = np.zeros(pixels) if settings.settled else rng.uniform(-1.0, 1.0, pixels)
        self._reference = self._level - np.where(
            leftover > 0.0, leftover * self._thresholds[:, 0], leftover * self._thresholds[:, 1]
        )
        self._busy_until_us = np.full(pixels, -1.0)
        self._t_us = float(begin_us)
        self._noise_t_us, self._noise_pixel, self._noise_on = self._draw_noise(first, begin_us, end_us, rng)
        self._noise_next = 0
        self._parts: list[RetinaEvents] = []

    def _draw_noise(
        self, first: NDArray[np.float32], begin_us: int, end_us: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.uint8]]:
        """Draw all shot noise: Poisson in time, thinned by brightness, either polarity alike."""
        rate = self._settings.shot_noise_rate_hz * (1.0 - (1.0 - _DARK_NOISE) * relative_bandwidth(first.ravel()))
        counts = rng.poisson(rate * (end_us - begin_us) / 1e6)
        pixel = np.repeat(np.arange(counts.size), counts)
        t_us = rng.uniform(begin_us, end_us, pixel.size)
        order = np.argsort(t_us, kind="stable")
        on = rng.integers(0, 2, pixel.size, dtype=np.uint8)
        return t_us[order], pixel[order].astype(np.int64), on

    def see(self, frame: NDArray[np.float32], t_us: float) -> None:
        """Take the next frame (height, width), seen at *t_us*; events since the last one are kept."""
        span_us = t_us - self._t_us
        intensity = frame.ravel().astype(np.float64)
        follow = 1.0 - np.exp(-span_us * np.maximum(relative_bandwidth(intensity), 1e-3) / self._tau_us)
        level = self._level + follow * (lin_log(intensity) - self._level)
        self._reference -= self._settings.leak_rate_hz * span_us / 1e6 * self._thresholds[:, 0]
        stop = int(np.searchsorted(self._noise_t_us, t_us, side="left"))
        noise = slice(self._noise_next, stop)
        room = intensity.size * (int(span_us / self._refractory_us) + 2) + (stop - self._noise_next)
        when, where, on = np.empty(room), np.empty(room, dtype=np.int64), np.empty(room, dtype=np.uint8)
        found = cross_thresholds(
            self._level, level, self._t_us, t_us, self._thresholds, self._refractory_us,
            self._noise_t_us[noise], self._noise_pixel[noise], self._noise_on[noise],
            self._reference, self._busy_until_us, when, where, on,
        )  # fmt: skip
        order = np.argsort(when[:found], kind="stable")
        pixel = where[:found][order]
        width = self._shape[1]
        self._parts.append(
            RetinaEvents(
                when[:found][order].astype(np.int64),
                (pixel % width).astype(np.uint16),
                (pixel // width).astype(np.uint16),
                on[:found][order],
            )
        )
        self._level, self._t_us, self._noise_next = level, t_us, stop

    def newest(self) -> RetinaEvents:
        """Return the events of the last interval."""
        return self._parts[-1]

    def events(self) -> RetinaEvents:
        """Return everything so far."""
        return joined(self._parts)


def joined(parts: Sequence[RetinaEvents]) -> RetinaEvents:
    """Return the events of *parts*, which follow each other in time, as one."""
    if not parts:
        nothing = np.empty(0, dtype=np.int64)
        return RetinaEvents(nothing, nothing.astype(np.uint16), nothing.astype(np.uint16), nothing.astype(np.uint8))
    return RetinaEvents(
        np.concatenate([part.t_us for part in parts]),
        np.concatenate([part.x for part in parts]),
        np.concatenate([part.y for part in parts]),
        np.concatenate([part.on for part in parts]),
    )


def lin_log(intensity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the natural logarithm of grey values, linear below ``LINEAR_BELOW`` and continuous there."""
    slope = np.log(LINEAR_BELOW) / LINEAR_BELOW
    return np.where(intensity > LINEAR_BELOW, np.log(np.maximum(intensity, LINEAR_BELOW)), intensity * slope)


def relative_bandwidth(intensity: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return v2e's brightness between 0 and 1, offset so that black still has some bandwidth."""
    return np.clip((np.asarray(intensity, dtype=np.float64) + 20.0) / 275.0, 0.0, 1.0)


@kernel(
    "int64(float64[::1], float64[::1], float64, float64, float64[:, ::1], float64, float64[::1], int64[::1], "
    "uint8[::1], float64[::1], float64[::1], float64[::1], int64[::1], uint8[::1])"
)
def cross_thresholds(
    level0: NDArray[np.float64],
    level1: NDArray[np.float64],
    begin_us: float,
    end_us: float,
    thresholds: NDArray[np.float64],
    refractory_us: float,
    noise_t_us: NDArray[np.float64],
    noise_pixel: NDArray[np.int64],
    noise_on: NDArray[np.uint8],
    reference: NDArray[np.float64],
    busy_until_us: NDArray[np.float64],
    when_us: NDArray[np.float64],
    where: NDArray[np.int64],
    on: NDArray[np.uint8],
) -> int:
    """Write the events between two frames and return how many.

    Levels (pixels,) run linearly from *level0* to *level1*; *thresholds* (pixels, 2) are ON and OFF. *reference* and
    *busy_until_us* (pixels,) are carried on. Noise comes sorted by time and puts its pixel in reset until the
    refractory period after it, from the beginning of this interval on; a pixel in reset swallows it. Outputs must hold
    (span / refractory + 2) events a pixel and the noise.
    """
    found = 0
    span = end_us - begin_us
    for k in range(noise_t_us.size):
        pixel = noise_pixel[k]
        if noise_t_us[k] >= busy_until_us[pixel]:
            when_us[found] = noise_t_us[k]
            where[found] = pixel
            on[found] = noise_on[k]
            found += 1
            busy_until_us[pixel] = noise_t_us[k] + refractory_us
    for pixel in range(level0.size):
        slope = (level1[pixel] - level0[pixel]) / span
        now = begin_us
        while True:
            if busy_until_us[pixel] > now:
                # Held in reset: the reference follows the level until release.
                now = min(busy_until_us[pixel], end_us)
                reference[pixel] = level0[pixel] + slope * (now - begin_us)
                if now >= end_us:
                    break
            level = level0[pixel] + slope * (now - begin_us)
            above = level - (reference[pixel] + thresholds[pixel, 0])
            below = (reference[pixel] - thresholds[pixel, 1]) - level
            crossing = now
            # Already past a threshold: the leak went there while the level rested, or the reset ended beyond it.
            rising = above >= 0.0
            if not rising and below < 0.0:
                if slope == 0.0:
                    break
                rising = slope > 0.0
                crossing = now - (above if rising else below) / abs(slope)
            if crossing >= end_us:
                break
            when_us[found] = crossing
            where[found] = pixel
            on[found] = 1 if rising else 0
            found += 1
            busy_until_us[pixel] = crossing + refractory_us
    return found
