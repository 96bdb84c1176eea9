"""What a sensor says while lens and scene rest: its noise, its hot pixels, and whether the light flickers.

A few milliseconds before a sweep are enough for noise and hot pixels. Where the signs of events swing together more
than independent signs would, or lie together more than they do by chance, somebody should listen a little longer
(``restless``): a lamp needs several periods to be told from a hand that shakes, and a dull scene some hundred events.
Where signs lie together as those of one moving edge do, the scene moves: then its image is gone on with when the sweep
begins, on a picture that is laid where the scene is now, and what motion alone does to the image's sharpness is
measured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.vision.alignment import laid_on
from elpd.vision.bearing import Unrest
from elpd.vision.crossing import ROI_MARGIN_PX
from elpd.vision.detector import RestingRate
from elpd.vision.flicker import find_flicker, residue
from elpd.vision.integral import band_energy, band_gain, band_patch, inside_margin
from elpd.vision.losses import lost_levels
from elpd.vision.memory import BuiltImage
from elpd.vision.refractory import Deafness
from elpd.vision.track import frame_levels
from elpd.vision.whole_periods import WholePeriods

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from elpd.records import Frame, Geometry, Roi
    from elpd.vision.flicker import Flicker

LISTEN_MS = 35.0
"""How much longer to listen where a lamp is suspected: four periods of mains light in all."""

MAX_EVENTS = 1 << 22
"""What is remembered at most; a region that says more at rest has told enough."""

RESTLESS_BIN_US = 1_000
RESTLESS_SIGMAS = 5.0
"""Excess of the ON-OFF difference's variance over independent signs that makes listening longer worth while."""

HOT_SIGMAS = 5.0
HOT_EVENTS = 3.0
"""A pixel is hot where it fires this many standard deviations and events more often than its second busiest neighbour:
an edge that trembles makes neighbours fire alike. By chance one in 10⁸ pixels does."""

SIGMAS_OF_SUSPICION = 2.0
"""Order above which it is worth while to listen longer, one still scene in forty-four pays for it; and above which,
after that, the direction is not left to a product that motion deceives."""

SIGMAS_OF_MOTION = 4.0
"""How much more order than independent events have shows that the scene moved while the lens stood still. A false
alarm costs a second pass."""

ORDER_PX = 2.4
"""Scale at which events of one moving edge agree, in a picture that is out of focus."""

STILL_US = 1_000
"""Between two looks at the image of a resting lens: a tick of a sweep takes about as long."""


class Resting:
    """Remembers the events of a region and its margin while nothing is meant to move.

    Parameters
    ----------
    roi, geometry:
        The region and the sensor.
    picture:
        Makes an earlier picture of the whole sensor, log brightness in contrast thresholds; asked where the scene moves
        and no frame has come.
    """

    def __init__(self, roi: Roi, geometry: Geometry, picture: Callable[[], NDArray[np.float32]] | None = None) -> None:
        self._picture = picture
        self._geometry = geometry
        self._inside = _box(roi, geometry, 0)
        self.heard = _box(roi, geometry, ROI_MARGIN_PX)
        """The region and its margin, as pixels of the sensor."""
        rows, columns = np.flatnonzero(self.heard.any(axis=1)), np.flatnonzero(self.heard.any(axis=0))
        self._corner = int(columns[0]), int(rows[0])
        self._size = rows.size, columns.size
        self.deafness = Deafness(self._size)
        """What the region's pixels have taught of how long they are deaf after an event."""
        self._pieces: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]] = []
        self._count = 0
        self._frame: Frame | None = None
        self._begin_us: int | None = None
        self._end_us = 0
        self.hot = np.zeros((geometry.height, geometry.width), np.bool_)
        """Pixels not to believe, known after ``settle``."""
        self.flicker: Flicker | None = None
        """The lamp's flicker, known after ``settle``."""
        self.residue = 0.0
        """What its whole periods leave behind, in thresholds²."""
        self.events = 0
        """Events of the region that are not hot pixels'."""
        self.noise_hz = 0.0
        """The same per pixel and second."""
        self.moves = False
        """Whether the events lie together as those of a moving scene do, known after ``settle``."""
        self.image_at_start: BuiltImage | None = None
        """Where the scene moves, what has been built: upon a frame, or by the events alone."""
        self.beneath: NDArray[np.float32] | None = None
        """What that image lacks of being a picture of the scene, where motion is only suspected too."""
        self.only_picture: NDArray[np.float32] | None = None
        """Where the scene stood still, the picture that no frame will replace, as ``beneath``."""
        self.unrest: Unrest | None = None
        """What motion alone does to the sharpness of the two together; ``None`` where there is no picture."""

    def add(
        self,
        t_us: NDArray[np.int64],
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        on: NDArray[np.uint8],
        until_us: int | None,
    ) -> None:
        """Take events in time order, none before what was taken; *until_us* promises that no earlier will follow."""
        inside = self.heard[y, x]
        if self._begin_us is None:
            if until_us is None and t_us.size == 0:
                return
            self._begin_us = int(t_us[0]) if t_us.size else int(until_us or 0)
        if self._count < MAX_EVENTS:
            self._end_us = max(self._end_us, int(until_us or 0), int(t_us[-1]) + 1 if t_us.size else 0)
            pixel = y[inside].astype(np.int64) * self._geometry.width + x[inside]
            self._pieces.append((t_us[inside].copy(), pixel, on[inside].copy()))
            self._count += pixel.size

    def see(self, frames: Iterable[Frame]) -> None:
        """Take frames, in time order."""
        for frame in frames:
            self._frame = frame

    @property
    def restless(self) -> bool:
        """Whether ON and OFF events swing together, or lie together, more than independent ones would."""
        t_us, pixel, on = self._events()
        bins = self.duration_us // RESTLESS_BIN_US
        if bins < 3 or t_us.size < bins:
            return False
        if order(self._levels(pixel, on)) > SIGMAS_OF_SUSPICION:
            return True
        which = np.clip((t_us - (self._begin_us or 0)) // RESTLESS_BIN_US, 0, bins - 1)
        sign = 2.0 * on - 1.0
        mean = float(sign.mean())
        count = np.bincount(which, minlength=bins)
        swing = np.bincount(which, weights=sign, minlength=bins) - mean * count
        ratio = float(np.square(swing).sum()) / (t_us.size * max(1.0 - mean**2, 1e-3))
        return ratio > 1.0 + RESTLESS_SIGMAS * float(np.sqrt(2.0 / bins))

    @property
    def duration_us(self) -> int:
        """How long was listened."""
        return 0 if self._begin_us is None else max(0, self._end_us - self._begin_us)

    def settle(self, weights: NDArray[np.int16]) -> RestingRate:
        """Draw the conclusions; return what the region says at rest under *weights*, hot pixels left out."""
        t_us, pixel, on = self._events()
        begin_us = self._begin_us or 0
        self.flicker = find_flicker(t_us, pixel, on, begin_us, self._end_us)
        self.hot = self._hot(pixel, on)
        kept = ~self.hot.ravel()[pixel]
        t_us, pixel, on = t_us[kept], pixel[kept], on[kept]
        if self.flicker is None:  # under a lamp all signs swing together, whatever the scene does
            self._look_for_motion(t_us, pixel, on)
        counted = int(self._inside.ravel()[pixel].sum())
        self.events = counted
        duration_us = self.duration_us
        self._pieces = []
        if duration_us == 0:
            return RestingRate()
        self.noise_hz = 1e6 * counted / duration_us / max(1, int((self._inside & ~self.hot).sum()))
        if self.flicker is not None:
            self.residue = residue(t_us, pixel, on, self.flicker, self._end_us)
            self.events, listened_us = self._net_of_periods(t_us, pixel, on, self.flicker.period_us)
            return RestingRate(0.0, self.events / listened_us)
        elp = -float((2.0 * on - 1.0) @ weights.ravel()[pixel])
        return RestingRate(elp / duration_us, counted / duration_us)

    def _events(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]:
        if not self._pieces:
            return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.uint8)
        t_us, pixel, on = (np.concatenate(column) for column in zip(*self._pieces, strict=True))
        self._pieces = [(t_us, pixel, on)]
        return t_us, pixel, on

    def _look_for_motion(self, t_us: NDArray[np.int64], pixel: NDArray[np.int64], on: NDArray[np.uint8]) -> None:
        levels = self._levels(pixel, on)
        x, y = self._places(pixel)
        self.deafness.add(t_us, x, y, on)
        found = order(levels)
        self.moves = found > SIGMAS_OF_MOTION
        if found <= SIGMAS_OF_SUSPICION:
            if self._frame is None and self._picture is not None:
                self.only_picture = self._cut(self._picture())
            return
        now, since, before = levels, np.ones(t_us.size, np.bool_), None
        if self._frame is not None:
            since = t_us >= self._frame.t_us
            now = self._cut(frame_levels(self._frame.pixels)) + self._levels(pixel[since], on[since])
            before = now - levels
        elif self._picture is not None:  # in the middle of the rest it lies where events are best explained
            picture = self._cut(self._picture())
            before = self.beneath = laid_on(picture, levels) - np.float32(0.5) * levels
        if before is not None:
            self.unrest = Unrest.of(self._stills(before, t_us, pixel, on), ROI_MARGIN_PX)
        if self.moves:
            deaf_us = self.deafness.period().period_us
            lost = lost_levels(t_us[since], x[since], y[since], on[since], deaf_us, self._size)
            self.image_at_start = BuiltImage(now, int(since.sum()), lost)
        elif before is not None:  # nothing is gone on with, so all of it is lacking
            self.beneath = before + levels

    def _stills(
        self, before: NDArray[np.float32], t_us: NDArray[np.int64], pixel: NDArray[np.int64], on: NDArray[np.uint8]
    ) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield what the scene looked like while nothing else moved: upon the image *before* it, step by step."""
        image, begin = before, 0
        for until_us in range((self._begin_us or 0) + STILL_US, self._end_us + 1, STILL_US):
            end = int(np.searchsorted(t_us, until_us, side="left"))
            image, begin = image + self._levels(pixel[begin:end], on[begin:end]), end
            yield until_us, image

    def _levels(self, pixel: NDArray[np.int64], on: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the image that events build, of the region and its margin, in thresholds."""
        net = np.bincount(pixel, weights=2.0 * on - 1.0, minlength=self.heard.size).reshape(self.heard.shape)
        return self._cut(net.astype(np.float32))

    def _cut(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        (left, top), (height, width) = self._corner, self._size
        return np.ascontiguousarray(image[top : top + height, left : left + width])

    def _places(self, pixel: NDArray[np.int64]) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Return where pixels of the sensor lie in the region and its margin, (x, y)."""
        (left, top), width = self._corner, self._geometry.width
        return (pixel % width - left).astype(np.uint16), (pixel // width - top).astype(np.uint16)

    def _net_of_periods(
        self, t_us: NDArray[np.int64], pixel: NDArray[np.int64], on: NDArray[np.uint8], period_us: float
    ) -> tuple[int, float]:
        """Return how many net events whole periods leave in the region, and how long those lasted."""
        width = self._geometry.width
        periods = WholePeriods(self._inside, self._begin_us or 0)
        periods.add(t_us, (pixel % width).astype(np.uint16), (pixel // width).astype(np.uint16), on)
        whole = max(1, int(self.duration_us / period_us))
        edges = (self._begin_us or 0) + np.rint(period_us * np.arange(whole + 1)).astype(np.int64)
        net = sum(periods.close(int(edges[k]), int(edges[k + 1])).t_us.size for k in range(whole))
        return net, whole * period_us

    def _hot(self, pixel: NDArray[np.int64], on: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Judge by counts; under a lamp, to which pixels answer as differently as their thresholds are, by the net."""
        height, width = self._geometry.height, self._geometry.width
        if self.flicker is None:
            count = np.bincount(pixel, minlength=height * width)
        else:
            count = np.abs(np.rint(np.bincount(pixel, weights=2.0 * on - 1.0, minlength=height * width)))
        return hot_pixels(count.reshape(height, width).astype(np.int64))


def _box(roi: Roi, geometry: Geometry, margin: int) -> NDArray[np.bool_]:
    box = np.zeros((geometry.height, geometry.width), np.bool_)
    top, left = max(0, roi.y - margin), max(0, roi.x - margin)
    box[top : roi.y + roi.height + margin, left : roi.x + roi.width + margin] = True
    return box


def hot_pixels(count: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which pixels fired far more often than any two of their neighbours; *count* is (height, width)."""
    hot = np.zeros(count.shape, np.bool_)
    rows, columns = np.nonzero(count > HOT_EVENTS)  # of a sensor at rest few come into question
    if rows.size == 0:
        return hot
    wide = np.pad(count, 1)
    around = [wide[rows + row, columns + column] for row in range(3) for column in range(3) if (row, column) != (1, 1)]
    second = np.partition(around, -2, axis=0)[-2]
    expected = second + float(count.mean())
    hot[rows, columns] = count[rows, columns] - second > HOT_EVENTS + HOT_SIGMAS * np.sqrt(expected)
    return hot


def order(levels: NDArray[np.float32]) -> float:
    """Say by how many standard deviations events lie together by their sign, as a moving scene's do.

    *levels* is the image they have built, a region and its margin, in thresholds. Its energy in a band of some pixels
    is compared with what independent events would have: each pixel's own part, so that noisy pixels are not taken for
    order, and its scatter over the region.
    """
    inside = levels[inside_margin(levels.shape, ROI_MARGIN_PX)]
    by_itself = band_gain(ORDER_PX) * float(np.square(inside).mean())
    if by_itself == 0.0:
        return 0.0
    excess = band_energy(levels, ORDER_PX, np.ones_like(levels), ROI_MARGIN_PX) / by_itself - 1.0
    return excess / float(np.sqrt(2.0 * band_patch(ORDER_PX) / inside.size))
