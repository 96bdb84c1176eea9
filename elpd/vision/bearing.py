"""Which way is focus while the scene moves: the sharpness of what the sensor sees now, against what motion does to it.

A product with a picture that has gone stale turns negative before focus; the sharpness of a *current* image does not
mind where the picture lies. The image is a picture of the scene with the events since put upon it. Its energy in a band
of some pixels rises toward focus and falls away from it, within a depth of focus or two.

How far to trust a change is not a constant but measured. *Events* are counted: each moves log S by the gradient of S at
its pixel, and independent ones add up to a variance. *Motion* moves log S too, because thresholds are guessed, pixels
hold back and the picture is some tenths of a pixel aside; and while the lens rests it moves it by nothing but that. So
the rest before the sweep tells how much a pixel of the scene's travel, and a millisecond, are worth (``Unrest``), and
the scene's travel goes on being measured during the sweep, from the events on the gradient of their own image. A change
between any two looks that is three times what motion may have made of it, and five standard deviations of the events,
is a direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from elpd.records import Direction
from elpd.vision.integral import band_image, inside_margin

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

SHRINK = 4
"""The image is looked at on a grid this many times coarser: where the direction is asked for, fine structure is gone,
and a look costs a sixteenth."""

BAND_PX = 3.4
"""The band, in pixels of the sensor: most of what is left of a picture ten depths of focus from focus lies there, and
near focus it still changes by more than events scatter."""

TIMES_MOTION = 3.0
"""A change is this many times what motion alone may do: as rare as three standard deviations, of a scatter that itself
is known from some ten milliseconds."""

SIGMAS_OF_EVENTS = 5.0
"""And this many standard deviations of what independent events would do."""

AFTER_REVERSAL = 1.5
"""A second turn costs the most: it needs this many times as much of both."""

LEAST_SHIFT_PX = 0.05
"""Shifts smaller than this are the estimate's own noise."""

_TINY = 1e-12


class Look(NamedTuple):
    """What a look has found: log S, how far the scene has gone since the first, and the events' variance since then."""

    t_ms: float
    log_energy: float
    x_px: float
    y_px: float
    variance: float


class Gauge:
    """Measures an image from look to look.

    Parameters
    ----------
    margin:
        Pixels at each side that are left out.
    """

    def __init__(self, margin: int) -> None:
        self._margin = margin // SHRINK
        self._image: NDArray[np.float32] | None = None
        self._band = np.empty((0, 0), np.float32)
        self._shift_px = np.zeros(2)
        self._variance = 0.0

    def look(self, image: NDArray[np.float32], t_us: int) -> Look:
        """Measure an image, (height, width) in thresholds."""
        band = band_image(_shrunk(image), BAND_PX / SHRINK)
        inside = inside_margin(band.shape, self._margin)
        kept = np.zeros_like(band)
        kept[inside] = band[inside]
        size = band[inside].size
        energy = float(np.square(kept).sum(dtype=np.float64)) / size + _TINY
        if self._image is not None:
            # d log S by each pixel of the coarse grid, whose value is the mean of SHRINK² pixels with an event each.
            gradient = band_image(kept, BAND_PX / SHRINK) * (2.0 / (size * energy))
            fired = _shrunk(np.abs(image - self._image))
            self._variance += float((np.square(gradient) * fired).sum(dtype=np.float64)) / SHRINK**2
            self._shift_px += SHRINK * shift_between(self._band[inside], band[inside])
        self._image, self._band = image.copy(), band
        x_px, y_px = (float(one) for one in self._shift_px)
        return Look(1e-3 * t_us, float(np.log(energy)), x_px, y_px, self._variance)


@dataclass(frozen=True, slots=True)
class Unrest:
    """What motion alone does to log S: for each pixel that the scene goes, and for the root of each millisecond."""

    per_px: float
    per_root_ms: float
    longest_ms: float = float("inf")
    """How long it was listened to."""

    def moved(self, gone_px: NDArray[np.float64], took_ms: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what motion may have done to log S.

        What it leaves behind has forgotten where the scene was once that has gone by as much as the band is wide. And
        motion that goes on as it did does no more than in all the time that it was listened to.
        """
        gone = self.per_px * np.minimum(gone_px, BAND_PX)
        return np.maximum(gone, self.per_root_ms * np.sqrt(np.clip(took_ms, 0.0, self.longest_ms)))

    @classmethod
    def of(cls, stills: Iterable[tuple[int, NDArray[np.float32]]], margin: int) -> Unrest | None:
        """Measure it from images of a resting lens, (time, levels); ``None`` from fewer than four."""
        gauge = Gauge(margin)
        seen = np.array([gauge.look(image, t_us) for t_us, image in stills])
        if len(seen) < 4:
            return None
        before, after = np.triu_indices(len(seen), 2)
        change = seen[after] - seen[before]
        squares = float(np.square(change[:, 1]).sum())
        gone = float(np.square(change[:, 2:4]).sum())
        return cls(
            float(np.sqrt(squares / max(gone, LEAST_SHIFT_PX**2 * before.size))),
            float(np.sqrt(np.mean(np.square(change[:, 1]) / change[:, 0]))),
            float(change[:, 0].max()),
        )


class Bearing:
    """Judges the direction from one look at the image per tick of travel.

    Parameters
    ----------
    unrest:
        What motion does to the image's sharpness.
    margin:
        Pixels at each side that are left out.
    beneath:
        What an image lacks of being a picture of the scene, (height, width) in thresholds: it is added to each.
    again:
        Whether another verdict has turned the lens round: an opposite one must then be more certain.
    """

    def __init__(
        self, unrest: Unrest, margin: int, beneath: NDArray[np.float32] | None = None, *, again: bool = False
    ) -> None:
        self._unrest = unrest
        self._gauge = Gauge(margin)
        self._beneath = beneath
        self._doubt = AFTER_REVERSAL if again else 1.0
        self._seen: list[Look] = []
        self.direction = Direction.UNKNOWN
        """The first verdict; it stands."""

    def look(self, image: NDArray[np.float32], t_us: int) -> Direction:
        """Take the image, (height, width) in thresholds, at the next tick; return the direction so far."""
        if self.direction is not Direction.UNKNOWN:
            return self.direction
        now = self._gauge.look(image if self._beneath is None else image + self._beneath, t_us)
        if self._seen:
            took_ms, change, x_px, y_px, variance = (np.array(now) - np.array(self._seen)).T
            motion = self._unrest.moved(np.hypot(x_px, y_px), took_ms)
            limit = self._doubt * np.hypot(TIMES_MOTION * motion, SIGMAS_OF_EVENTS * np.sqrt(variance))
            beyond = np.abs(change) > limit
            if beyond.any():
                rises = change[np.argmax(np.abs(change) / (limit + _TINY))] > 0.0
                self.direction = Direction.APPROACHING if rises else Direction.RECEDING
        self._seen.append(now)
        return self.direction


def shift_between(before: NDArray[np.float32], after: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return how far an image has gone, (x, y) in its pixels, by least squares on its gradient: a fraction of a pixel.

    Where all edges point one way only the way across them is known; the other component is the least that explains it.
    """
    down, right = np.gradient(0.5 * (before + after))
    change = (after - before).ravel()
    design = np.stack([right.ravel(), down.ravel()])
    normal = (design @ design.T).astype(np.float64)
    inverse = np.linalg.pinv(normal, rcond=1e-6, hermitian=True)
    return np.asarray(-inverse @ (design @ change).astype(np.float64))


def _shrunk(image: NDArray[np.float32]) -> NDArray[np.float32]:
    shrunk = cv2.resize(image, None, fx=1.0 / SHRINK, fy=1.0 / SHRINK, interpolation=cv2.INTER_AREA)
    return np.asarray(shrunk, dtype=np.float32)
