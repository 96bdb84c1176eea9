"""The events of a sweep, kept so that focus can be measured once it has been passed.

Deciding *that* focus was passed needs sums only; measuring *where* needs the events again. This memory keeps those of
the region and a margin around it, refuses what hot pixels add, follows the band energy of the image they build, and
answers when asked. It holds a bounded number: the oldest are forgotten first, which costs nothing but a different start
picture, and the vertex does not depend on the start picture.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.vision.crossing import FLANK, ROI_MARGIN_PX, UNMEASURED_LAG_US, EventStretch, ask_events
from elpd.vision.filters import PixelCap
from elpd.vision.integral import BANDS_PX, add_events, band_energy, band_gain, band_patch
from elpd.vision.refractory import Refractory, refractory_period
from elpd.vision.track import EventEnergy, PeakTrack

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Geometry, Roi
    from elpd.vision.crossing import EventWitnesses, Witness
    from elpd.vision.ruler import Ruler

MIN_EVENTS = 1_000
"""Fewer events between the flank of the peak and now make no image worth a vertex."""

MAX_EVENTS = 1 << 23
"""What is kept at most: 13 bytes each."""

FIRST_CAPACITY = 1 << 17

LEAST_LEVEL = 1.0 / 3.0
"""Variance, in thresholds², of what pixels hold back (evenly between minus one and one threshold since their last
event). An image that does not stand above it at its sharpest shows the sensor, not the scene."""

LEAST_ORDER = 0.75
"""Energy of the image over that of the same number of random events. Still scenes have 1 to 30 and the paper's violent
motion 2 to 15; below one, motion has shuffled the events more than focus has ordered them."""

ORDER_PX = 2.4
"""Scale at which events of one moving edge agree, in a picture that is out of focus."""

MIN_RISE = 0.30
"""Without frames the curve starts from nothing, so its first wiggles are noise; a peak stands higher."""


class EventMemory:
    """Keeps and questions the events of one sweep.

    Parameters
    ----------
    roi, geometry:
        Where to focus, and on what sensor.
    max_events:
        How many are kept.
    before:
        What went before, of the same region: the image that it had built is gone on with.
    picture:
        The whole sensor's log picture in thresholds, (height, width), upon which the image is built.
    """

    def __init__(
        self,
        roi: Roi,
        geometry: Geometry,
        max_events: int = MAX_EVENTS,
        *,
        before: EventMemory | None = None,
        picture: NDArray[np.float32] | None = None,
    ) -> None:
        self._left, self._top = max(0, roi.x - ROI_MARGIN_PX), max(0, roi.y - ROI_MARGIN_PX)
        self._right = min(geometry.width, roi.x + roi.width + ROI_MARGIN_PX)
        self._bottom = min(geometry.height, roi.y + roi.height + ROI_MARGIN_PX)
        height, width = self._bottom - self._top, self._right - self._left
        self._roi, self._geometry = roi, geometry
        self._skimmed = 0
        self._cap = PixelCap(height, width)
        if picture is not None:
            picture = np.ascontiguousarray(picture[self._top : self._bottom, self._left : self._right])
        elif before is not None:
            picture = before.picture
        self._energy = EventEnergy(height, width, ROI_MARGIN_PX, picture)
        self._base: NDArray[np.float32] | None = None
        self._forgotten = 0
        if before is not None:
            before.copy_image(self._energy.level)
            self._base = self._energy.image()
            self._forgotten = before.events
        self._shape = (height, width)
        self._columns = _columns(FIRST_CAPACITY)
        self._count = 0
        self._taken = 0
        self._max_events = max_events
        self.track = PeakTrack()
        self.capped = 0
        self._least_log_energy = float(np.log(LEAST_LEVEL * band_gain(BANDS_PX[0])))

    def add(self, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], on: NDArray[np.uint8]) -> None:
        """Keep those of the events (in time order, in the sensor's coordinates) that matter. They are copied."""
        events = self._those_that_matter(t_us, x, y, on)
        count = events[0].size
        self._make_room(count)
        part = slice(self._count, self._count + count)
        for column, values in zip(self._columns, events, strict=True):
            column[part] = values
        self._count += count

    def skim(
        self, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], on: NDArray[np.uint8]
    ) -> None:
        """Let events go on building the image, and forget them."""
        _, x, y, on = self._those_that_matter(t_us, x, y, on)
        self._energy.add(x, y, on)
        self._skimmed += x.size

    def since(self, t_us: int, picture: NDArray[np.float32]) -> EventMemory:
        """Return a memory that has skimmed the events from *t_us* on, built upon a *picture* of that time."""
        memory = EventMemory(self._roi, self._geometry, picture=picture)
        first = int(np.searchsorted(self._t_us, t_us, side="left"))
        t_us_, x, y, on = (column[first : self._count] for column in self._columns)
        left, top = np.uint16(self._left), np.uint16(self._top)
        memory.skim(t_us_, x + left, y + top, on)
        return memory

    @property
    def events(self) -> int:
        """How many events have built the image, those of the memories before this one too."""
        return self._forgotten + self._count + self._skimmed

    @property
    def picture(self) -> NDArray[np.float32] | None:
        """What the image is built upon, (height, width) of the region and its margin; ``None`` for nothing."""
        return self._energy.picture

    def image(self) -> NDArray[np.float32]:
        """Return the image at the last ``advance``, (height, width) of the region and its margin, in thresholds."""
        return self._energy.image()

    @property
    def order(self) -> float:
        """Say by how many standard deviations the events so far lie together by their sign, as a moving scene's do.

        The energy of their image in a band of some pixels is compared with what independent events would have: each
        pixel's own part, so that noisy pixels are not taken for order, and its scatter over the region.
        """
        level = np.empty(self._shape, np.int32)
        self.copy_image(level)
        image = level.astype(np.float32)
        inside = image[ROI_MARGIN_PX:-ROI_MARGIN_PX, ROI_MARGIN_PX:-ROI_MARGIN_PX]
        by_itself = band_gain(ORDER_PX) * float(np.square(inside).mean()) if inside.size else 0.0
        if by_itself == 0.0:
            return 0.0
        excess = band_energy(image, ORDER_PX, np.ones_like(image), ROI_MARGIN_PX) / by_itself - 1.0
        return excess / float(np.sqrt(2.0 * band_patch(ORDER_PX) / inside.size))

    def copy_image(self, into: NDArray[np.int32]) -> None:
        """Copy the image that all events so far have built, in thresholds, those after the last ``advance`` too."""
        into[:] = self._energy.level
        part = slice(self._taken, self._count)
        _, x, y, on = self._columns
        add_events(x[part], y[part], on[part], into)

    def _those_that_matter(
        self, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], on: NDArray[np.uint8]
    ) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
        """Cut the region out, in its own coordinates, without what pixels say that fire without reason."""
        inside = (x >= self._left) & (x < self._right) & (y >= self._top) & (y < self._bottom)
        t_us, on = t_us[inside], on[inside]
        x = (x[inside] - self._left).astype(np.uint16)
        y = (y[inside] - self._top).astype(np.uint16)
        keep = self._cap.keep(t_us, x, y)
        self.capped += int(keep.size - keep.sum())
        return t_us[keep], x[keep], y[keep], on[keep]

    def _make_room(self, count: int) -> None:
        """Let *count* more events fit: forget the oldest of those that the curve has seen, or double the columns."""
        used, capacity = self._count, self._columns[0].size
        if used + count <= capacity:
            return
        drop = min(max(0, used + count - self._max_events), self._taken)
        capacity = max(capacity, min(2 * capacity, self._max_events), used - drop + count)
        columns = _columns(capacity)
        for new, old in zip(columns, self._columns, strict=True):
            new[: used - drop] = old[drop:used]
        self._columns = columns
        self._count -= drop
        self._taken -= drop
        self._forgotten += drop

    @property
    def _t_us(self) -> NDArray[np.int64]:
        times: NDArray[np.int64] = self._columns[0][: self._count]
        return times

    def refractory(self) -> Refractory:
        """Return how long a pixel is deaf after an event, as far as the events tell."""
        t_us, x, y, _ = (column[: self._count] for column in self._columns)
        return refractory_period(t_us, x, y, self._shape)

    def advance(self, until_us: int, position: float) -> None:
        """Add a point to the curve of log S: the image that events before *until_us* built, the lens at *position*."""
        until = int(np.searchsorted(self._t_us, until_us, side="left"))
        part = slice(self._taken, until)
        _, x, y, on = self._columns
        self._energy.add(x[part], y[part], on[part])
        self._taken = until
        self.track.add(until_us, position, self._energy.measure())

    @property
    def peak_passed(self) -> bool:
        """Whether the image has become as sharp as it gets, and duller again, by enough events to believe it."""
        track = self.track
        if not track.passed or track.rise < MIN_RISE or track.values[track.peak] < self._least_log_energy:
            return False
        if not self._shows_a_picture():
            return False
        begin_us = track.times_us[track.flank(FLANK)]
        return self._taken - int(np.searchsorted(self._t_us, begin_us, side="left")) >= MIN_EVENTS

    def _shows_a_picture(self) -> bool:
        """Whether the image is sharper, at its peak, than as many events at random would have made it."""
        track = self.track
        height, width = self._shape
        until = int(np.searchsorted(self._t_us, track.times_us[track.peak], side="left")) + self._forgotten
        at_random = band_gain(BANDS_PX[0]) * until / (height * width)
        return float(np.exp(track.values[track.peak])) > LEAST_ORDER * at_random

    def ask(
        self, now_us: int, ruler: Ruler, brightness: NDArray[np.float32] | None = None, deaf_us: float = 0.0
    ) -> EventWitnesses | None:
        """Question the events of the present stretch of motion up to the last ``advance``.

        *brightness* is that of the whole sensor (``Reference.brightness``); events are dated *deaf_us* later, to the
        release of their pixels. ``None`` when there is nothing to ask.
        Positions in the answer rise with time: they are multiplied by the sign of the motion.
        """
        begin_us, _, sign = ruler.stretch(now_us)
        begin = int(np.searchsorted(self._t_us, begin_us, side="left"))
        track = self.track
        if self._taken - begin < MIN_EVENTS or sign == 0 or not len(track):
            return None
        flank_us = max(float(track.times_us[track.flank(FLANK)]), begin_us)
        peak_us = track.times_us[track.peak]
        if peak_us <= flank_us:
            return None
        part = slice(begin, self._taken)
        position = sign * ruler.at(self._t_us[part] + round(deaf_us))
        height, width = self._shape
        t_us, x, y, on = (column[part] for column in self._columns)
        events = EventStretch(t_us, x, y, on, position, height, width, ROI_MARGIN_PX, self._base)
        if brightness is not None:
            brightness = np.ascontiguousarray(brightness[self._top : self._bottom, self._left : self._right])
        flank, peak, now = (sign * ruler.position(one) for one in (flank_us, peak_us, now_us))
        return ask_events(events, flank, peak, now, brightness)

    def witnesses(
        self, now_us: int, ruler: Ruler, brightness: NDArray[np.float32] | None = None
    ) -> tuple[list[Witness], float | None]:
        """Return what the events say, on the ruler, and the width of the curve (``None`` if nothing)."""
        said = self.ask(now_us, ruler, brightness)
        if said is None or said.vertex is None:
            return [], None
        _, _, sign = ruler.stretch(now_us)
        lag = UNMEASURED_LAG_US * ruler.speed_at(now_us)
        return [replace(one, at=sign * one.at) for one in said.witnesses(lag)], said.vertex.width


def _columns(capacity: int) -> tuple[NDArray[Any], ...]:
    """Return room for events: times, x, y, polarity."""
    return (
        np.empty(capacity, np.int64),
        np.empty(capacity, np.uint16),
        np.empty(capacity, np.uint16),
        np.empty(capacity, np.uint8),
    )
