"""The events of a sweep, kept so that focus can be measured once it has been passed.

Deciding *that* focus was passed needs sums only; measuring *where* needs the events again. This memory keeps those of
the region and a margin around it, refuses what hot pixels add, follows the band energy of the image they build, and
answers when asked. It holds a bounded number: the oldest are forgotten first, which costs nothing but a different start
picture, and the vertex does not depend on the start picture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.vision.background import BackgroundActivity
from elpd.vision.crossing import LEAST_LEVEL, ROI_MARGIN_PX, ask_events
from elpd.vision.filters import PixelCap
from elpd.vision.flicker import find_flicker
from elpd.vision.integral import BANDS_PX, band_gain, stamp_events
from elpd.vision.lag import UNMEASURED_LAG_US, LagPrior
from elpd.vision.losses import lost_levels
from elpd.vision.planes import FLANK
from elpd.vision.rebuilt import EventStretch
from elpd.vision.refractory import NOT_DEAF, Deafness, Refractory
from elpd.vision.slowness import DARK
from elpd.vision.track import POINT, EventEnergy, PeakTrack

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.records import Geometry, Roi, SensorProfile
    from elpd.vision.flicker import Flicker
    from elpd.vision.integral import Vertex
    from elpd.vision.ruler import Ruler
    from elpd.vision.witness import EventWitnesses, Witness

MIN_EVENTS = 1_000
"""Fewer events between the flank of the peak and now make no image worth a vertex."""

MAX_EVENTS = 1 << 23
"""What is kept at most: 13 bytes each."""

FIRST_CAPACITY = 1 << 17

LEAST_ORDER = 0.75
"""Energy that the image has won over that of the same number of random events. Still scenes have 1 to 30 and the
paper's violent motion 2 to 15; below one, motion has shuffled the events more than focus has ordered them."""

CLEAR = 1.5
"""A hill of log S that is as high as this on both sides, many times its scatter, is one, whatever motion has shuffled:
bricks in a shaking hand have 3 and an order of 0.7."""

MIN_RISE = 0.30
"""Without frames the curve starts from nothing, so its first wiggles are noise; a peak stands higher."""


@dataclass(frozen=True, slots=True)
class BuiltImage:
    """An image that earlier events have built, of a region and its margin: (height, width) in thresholds."""

    levels: NDArray[np.float32]
    events: int
    """How many they were."""
    lost: NDArray[np.float32] | None = None
    """What the image lacks because pixels were deaf, (height, width); ``None`` where nobody asked."""


class EventMemory:
    """Keeps and questions the events of one sweep.

    Parameters
    ----------
    roi, geometry:
        Where to focus, and on what sensor.
    max_events:
        How many are kept.
    hot:
        (height, width) of the sensor: pixels not to listen to.
    sensor:
        What a calibration knows: hot pixels are not heard, the lag is not guessed.
    start:
        The image that earlier events have built, upon which these go on building.
    support_us:
        Events that no other pixel of their cell fired so shortly before are not heard; 0: all are.
    deafness:
        What earlier events of this region have taught of how long its pixels are deaf. These go on teaching it.
    """

    def __init__(
        self,
        roi: Roi,
        geometry: Geometry,
        max_events: int = MAX_EVENTS,
        hot: NDArray[np.bool_] | None = None,
        sensor: SensorProfile | None = None,
        start: BuiltImage | None = None,
        support_us: int = 0,
        deafness: Deafness | None = None,
    ) -> None:
        self._left, self._top = max(0, roi.x - ROI_MARGIN_PX), max(0, roi.y - ROI_MARGIN_PX)
        self._right = min(geometry.width, roi.x + roi.width + ROI_MARGIN_PX)
        self._bottom = min(geometry.height, roi.y + roi.height + ROI_MARGIN_PX)
        height, width = self._bottom - self._top, self._right - self._left
        self._cap = PixelCap(height, width)
        self._background = (
            BackgroundActivity(height, width, support_us, left=self._left, top=self._top) if support_us else None
        )
        self._sensor = sensor
        for x, y in sensor.hot_pixels if sensor is not None else ():
            if self._left <= x < self._right and self._top <= y < self._bottom:
                self._cap.silence(x - self._left, y - self._top)
        self._start = start
        self._energy = EventEnergy(height, width, ROI_MARGIN_PX, None if start is None else start.levels)
        self._shape = (height, width)
        self.deafness = Deafness(self._shape) if deafness is None else deafness
        self._taught = 0
        self._columns = _columns(FIRST_CAPACITY)
        self._count = 0
        self._taken = 0
        self._max_events = max_events
        self.track = PeakTrack()
        self._raw: list[float] = []
        self._forgotten = 0 if start is None else start.events
        self._hot = None if hot is None or not hot.any() else hot
        self.capped = 0
        self.depths: tuple[float, ...] = ()
        """Where planes of the region are in focus, nearest first along the sweep, if ``witnesses`` found several."""
        self._least_energy = LEAST_LEVEL * band_gain(BANDS_PX[0])

    def under_a_lamp(self) -> None:
        """Expect net events of whole lamp periods, whose chance is not white."""
        self._energy.white = False

    def add(self, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], on: NDArray[np.uint8]) -> None:
        """Keep those of the events (in time order, in the sensor's coordinates) that matter. They are copied."""
        inside = (x >= self._left) & (x < self._right) & (y >= self._top) & (y < self._bottom)
        if self._hot is not None:
            inside &= ~self._hot[y, x]
        t_us, on = t_us[inside], on[inside]
        x = (x[inside] - self._left).astype(np.uint16)
        y = (y[inside] - self._top).astype(np.uint16)
        keep = self._cap.keep(t_us, x, y)
        if self._background is not None:
            keep[keep] = self._background.keep(t_us[keep], x[keep], y[keep])
        self.capped += int(keep.size - keep.sum())
        count = int(keep.sum())
        self._make_room(count)
        part = slice(self._count, self._count + count)
        events: tuple[NDArray[Any], ...] = (t_us, x, y, on)
        for column, values in zip(self._columns, events, strict=True):
            column[part] = values[keep]
        self._count += count

    @property
    def image(self) -> NDArray[np.float32]:
        """The image at the last ``advance``, (height, width) of the region and its margin, in thresholds: a view."""
        return self._energy.image

    def built(self) -> BuiltImage:
        """Return what all events so far have built, those after the last ``advance`` too."""
        levels = self._energy.image.copy()
        part = slice(self._taken, self._count)
        _, x, y, on = self._columns
        stamp_events(x[part], y[part], on[part], POINT, levels)
        return BuiltImage(levels, self._forgotten + self._count, self._lost(self._count, self.refractory()))

    def sharpest(self) -> NDArray[np.float32]:
        """Return the image at the peak of the curve, (height, width) in thresholds."""
        until = int(np.searchsorted(self._t_us, self.track.times_us[self.track.peak], side="left"))
        return self._upon(self._begun, until)

    def sharpness(self, until_us: int) -> float:
        """Return log S of the image that events before *until_us* have built, with what pixels lost while deaf."""
        until = int(np.searchsorted(self._t_us, until_us, side="left"))
        whole = self._upon(self._begun, until) + self._lost(until, self.refractory())
        return EventEnergy(*self._shape, ROI_MARGIN_PX, whole).measure()

    @property
    def _begun(self) -> BuiltImage:
        return BuiltImage(np.zeros(self._shape, np.float32), 0) if self._start is None else self._start

    def change(self) -> NDArray[np.float32]:
        """Return what the events of this memory alone have built, those after the last ``advance`` too."""
        levels = self.built().levels
        return levels if self._start is None else levels - self._start.levels

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
        self._taught = max(0, self._taught - drop)
        self._forgotten += drop

    def cut(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return the part of an image of the whole sensor that is remembered here."""
        return image[self._top : self._bottom, self._left : self._right]

    def change_beyond(self, position: float) -> NDArray[np.int32]:
        """Return by how many events each pixel's level changed since the curve passed *position*, (height, width)."""
        beyond = np.flatnonzero(np.array(self.track.positions) >= position)
        since_us = self.track.times_us[int(beyond[0])] if beyond.size else self.track.times_us[-1]
        part = slice(int(np.searchsorted(self._t_us, since_us, side="left")), self._count)
        _, x, y, on = self._columns
        change = np.zeros(self._shape, np.int32)
        np.add.at(change, (y[part], x[part]), 2 * on[part].astype(np.int32) - 1)
        return change

    def within(self, roi: Roi) -> tuple[slice, slice]:
        """Return where a region lies in the remembered images: rows, columns."""
        top, left = roi.y - self._top, roi.x - self._left
        return slice(top, top + roi.height), slice(left, left + roi.width)

    def sums(self, weights: NDArray[np.float64], positions: Sequence[float]) -> NDArray[np.float64]:
        """Return the sum over events of weight times sign, up to where the curve first passed each of *positions*.

        *weights* is (height, width) of the remembered images.
        """
        _, x, y, on = (column[: self._count] for column in self._columns)
        total = np.concatenate([[0.0], np.cumsum(weights[y, x] * (2.0 * on - 1.0))])
        places, times = np.array(self.track.positions), np.array(self.track.times_us)
        at = np.array([int(np.argmax(places >= one)) if (places >= one).any() else -1 for one in positions])
        return np.asarray(total[np.searchsorted(self._t_us, times[at], side="left")])

    @property
    def _t_us(self) -> NDArray[np.int64]:
        times: NDArray[np.int64] = self._columns[0][: self._count]
        return times

    def refractory(self) -> Refractory:
        """Return how long a pixel is deaf after an event, by the events up to the last ``advance`` and earlier ones."""
        part = slice(self._taught, self._taken)
        self.deafness.add(*(column[part] for column in self._columns))
        self._taught = part.stop
        return self.deafness.period()

    def flicker(self) -> Flicker | None:
        """Return a lamp's flicker, if the events up to the last ``advance`` show one."""
        if self._taken == 0:
            return None
        t_us, x, y, on = (column[: self._taken] for column in self._columns)
        pixel = y.astype(np.int64) * self._shape[1] + x
        return find_flicker(t_us, pixel, on, int(t_us[0]), int(t_us[-1]) + 1)

    def advance(self, until_us: int, position: float) -> None:
        """Add a point to the curve of log S: the image that events before *until_us* built, the lens at *position*."""
        until = int(np.searchsorted(self._t_us, until_us, side="left"))
        part = slice(self._taken, until)
        _, x, y, on = self._columns
        self._energy.add(x[part], y[part], on[part])
        self._taken = until
        self.track.add(until_us, position, self._energy.measure())
        self._raw.append(self._energy.raw)

    @property
    def peak_passed(self) -> bool:
        """Whether the image has become as sharp as it gets, and duller again, by enough events to believe it."""
        track = self.track
        if not track.passed or track.rise < MIN_RISE or self._raw[track.peak] < self._least_energy:
            return False
        if min(track.rise, track.drop) < CLEAR and not self._shows_a_picture():
            return False
        begin_us = track.times_us[track.flank(FLANK)]
        return self._taken - int(np.searchsorted(self._t_us, begin_us, side="left")) >= MIN_EVENTS

    def _shows_a_picture(self) -> bool:
        """Whether the image has become sharper, up to its peak, than as many events at random would have made it.

        Counted from the curve's lowest point on: what earlier passes and motion have shuffled before stays in the image
        on both sides of the peak.
        """
        track = self.track
        energies = self._raw[: track.peak + 1]
        lowest = int(np.argmin(energies))
        begin, end = (int(np.searchsorted(self._t_us, track.times_us[k], side="left")) for k in (lowest, track.peak))
        begin = 0 if lowest == 0 else begin
        height, width = self._shape
        at_random = band_gain(BANDS_PX[0]) * (end - begin) / (height * width)
        gained = energies[-1] - (0.0 if self._start is None and lowest == 0 else energies[lowest])
        return gained > LEAST_ORDER * at_random

    def ask(
        self,
        now_us: int,
        ruler: Ruler,
        brightness: NDArray[np.float32] | None = None,
        deaf: Refractory = NOT_DEAF,
        start: NDArray[np.float32] | None = None,
        dark: float = DARK,
        *,
        hurried: bool = True,
    ) -> EventWitnesses | None:
        """Question the events of the present stretch of motion up to the last ``advance``.

        *brightness* is that of the whole sensor (``Reference.brightness``), *dark* the dark current that it does not
        show; events are dated later by what pixels are *deaf*, to their release, and what they lost meanwhile is put
        back. *start* is the picture, as brightness,
        that the sensor saw when it sent the first of them; *hurried* says that a lens waits for the answer.
        ``None`` when there is nothing to ask.
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
        position = sign * ruler.at(self._t_us[part] + round(deaf.period_us))
        height, width = self._shape
        t_us, x, y, on = (column[part] for column in self._columns)
        base = None if self._start is None else self._upon(self._start, begin)
        lost = None if self._start is None else self._lost(begin, deaf)
        events = EventStretch(t_us, x, y, on, position, height, width, ROI_MARGIN_PX, base, lost, deaf)
        if begin > 0 or self._forgotten:
            start = None
        flank, peak, now = (sign * ruler.position(one) for one in (flank_us, peak_us, now_us))
        return ask_events(
            events,
            flank,
            peak,
            now,
            self._cut(brightness),
            UNMEASURED_LAG_US * ruler.speed_at(peak_us),
            self._cut(start),
            LagPrior.of(self._sensor, ruler.speed_at(peak_us) if ruler.in_um else 0.0),
            dark,
            hurried=hurried,
        )

    def _upon(self, start: BuiltImage, count: int) -> NDArray[np.float32]:
        """Return what the first *count* events have made of the image at the start."""
        levels = start.levels.copy()
        _, x, y, on = (column[:count] for column in self._columns)
        stamp_events(x, y, on, POINT, levels)
        return levels

    def _lost(self, count: int, deaf: Refractory) -> NDArray[np.float32]:
        """Return what the image that the first *count* events have left lacks because pixels were *deaf*."""
        t_us, x, y, on = (column[:count] for column in self._columns)
        lost = lost_levels(t_us, x, y, on, deaf.period_us, self._shape)
        return lost if self._start is None or self._start.lost is None else lost + self._start.lost

    def _cut(self, picture: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
        """Return the part of a picture of the whole sensor that belongs to the events that are kept."""
        if picture is None:
            return None
        return np.ascontiguousarray(picture[self._top : self._bottom, self._left : self._right])

    def witnesses(
        self,
        now_us: int,
        ruler: Ruler,
        brightness: NDArray[np.float32] | None = None,
        start: NDArray[np.float32] | None = None,
    ) -> tuple[list[Witness], float | None]:
        """Return what the events of a record say, on the ruler, and the width of the curve (``None`` if nothing)."""
        deaf = self.refractory()
        lamp = self.flicker()
        if lamp is not None:
            # What makes pairs of bright pixels differ from those of dark ones is the lamp then, not the lag.
            brightness = start = None
        said = self.ask(now_us, ruler, brightness, deaf, start, hurried=False)
        self.depths = ()
        if said is None or (said.image is None and not said.depths):
            return [], None
        _, _, sign = ruler.stretch(now_us)
        if lamp is not None:
            said = self._dithered(said, lamp, now_us, ruler)
        undated = deaf.sigma_us * ruler.speed_at(now_us)
        self.depths = tuple(sign * at for at in said.depths)
        width = said.plane_width if said.image is None else said.image.finest.width
        witnesses = [
            replace(one, at=sign * one.at, shared=float(np.hypot(one.shared, undated)))
            for one in said.witnesses(width=width)
            if lamp is None or said.depths or one.name != "pairs"
        ]
        return witnesses, width

    def _dithered(self, said: EventWitnesses, lamp: Flicker, now_us: int, ruler: Ruler) -> EventWitnesses:
        """Return what the events say, for a lamp that swings the levels to and fro between the thresholds.

        A pixel that has turned need not come back by a whole threshold then: the lamp carries it there. So turns that
        are put back by one, as in the rebuilt image, come too early, and turns as they are, in the levels at the end of
        each of the lamp's periods, too late; where between the two depends on the lamp's swing over the thresholds.
        Pairs are as early and are not asked.
        """
        raw = self._by_periods(lamp, now_us, ruler)
        if said.image is None or raw is None:
            return said
        _, _, sign = ruler.stretch(now_us)
        early, late = said.image.at, sign * raw.at - said.lag.at
        between = float(np.hypot(said.image.sigma, (late - early) / sqrt(12.0)))
        return replace(said, image=replace(said.image, at=0.5 * (early + late), sigma=between))

    def _by_periods(self, lamp: Flicker, now_us: int, ruler: Ruler) -> Vertex | None:
        """Return the vertex of log S of the image at the end of each of a lamp's periods, dated to their middle."""
        t_us, x, y, on = (column[: self._taken] for column in self._columns)
        ends_us = np.arange(float(now_us), float(t_us[0]), -lamp.period_us)[::-1]
        energy = EventEnergy(*self._shape, ROI_MARGIN_PX, None if self._start is None else self._start.levels)
        track, done = PeakTrack(), 0
        for end_us, until in zip(ends_us, np.searchsorted(t_us, ends_us), strict=True):
            energy.add(x[done:until], y[done:until], on[done:until])
            done = until
            track.add(round(end_us), ruler.position(round(end_us - 0.5 * lamp.period_us)), energy.measure())
        return track.vertex()


def _columns(capacity: int) -> tuple[NDArray[Any], ...]:
    """Return room for events: times, x, y, polarity."""
    return (
        np.empty(capacity, np.int64),
        np.empty(capacity, np.uint16),
        np.empty(capacity, np.uint16),
        np.empty(capacity, np.uint8),
    )
