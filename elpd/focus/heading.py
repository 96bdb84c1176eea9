"""Which way focus lies, as far as a sweep has told: by ELP while the scene is still, by sharpness where it moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.records import Direction
from elpd.vision.bearing import Bearing, Gauge
from elpd.vision.crossing import ROI_MARGIN_PX
from elpd.vision.detector import Detector

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from elpd.records import ElpSample
    from elpd.vision.detector import RestingRate
    from elpd.vision.memory import EventMemory
    from elpd.vision.resting import Resting

SIGMAS_OF_PROBE = 5.0
"""What turns the first direction round: a false one costs a turn, and every micrometre the wrong way counts."""

SIGMAS_AFTER_REVERSAL = 9.0
"""A false reversal costs the most: the second needs this many standard deviations."""

STALE_PX = 2.0
"""A picture that lies so far beside the scene says nothing of focus any more: the finest weights change their sign
1.4 px beside a line. What a sweep over a scene that stands still feigns is below 1.4 px."""

TICKS_PER_GAUGE = 4
"""How often it is asked where the scene has gone: a hand takes 20 ms for a pixel."""


class Stale:
    """Tells when the scene has left the one picture that a sweep is judged by.

    Parameters
    ----------
    picture:
        What the sensor saw when the sweep began, (height, width) of the remembered image, in thresholds.
    """

    def __init__(self, picture: NDArray[np.float32]) -> None:
        self._picture = picture
        self._gauge = Gauge(ROI_MARGIN_PX)
        self._ticks = 0
        self.is_so = False
        """Whether it has."""

    def tick(self, image: NDArray[np.float32], t_us: int) -> None:
        """Take what events have built since, at the next tick."""
        if self._ticks % TICKS_PER_GAUGE == 0 and not self.is_so:
            now = self._gauge.look(self._picture + image, t_us)
            self.is_so = now.x_px**2 + now.y_px**2 > STALE_PX**2
        self._ticks += 1


class Heading:
    """Judges one direction of travel.

    Parameters
    ----------
    rest:
        What noise alone looks like.
    bearing:
        What judges instead of ELP where the scene moves.
    stale:
        What says that ELP's picture has gone stale, where it has only one.
    again:
        Whether another verdict has turned the lens round: the opposite one must be more certain still.
    """

    def __init__(
        self, rest: RestingRate, bearing: Bearing | None = None, stale: Stale | None = None, *, again: bool = False
    ) -> None:
        self._stale = stale
        self._detector = Detector(rest, recede_sigmas=SIGMAS_AFTER_REVERSAL if again else SIGMAS_OF_PROBE)
        self._bearing = bearing

    @classmethod
    def of_sweep(cls, rest: RestingRate, resting: Resting, *, again: bool) -> Heading:
        """Return what judges a sweep that begins after *resting*."""
        if resting.unrest is not None:
            return cls(rest, Bearing(resting.unrest, ROI_MARGIN_PX, resting.beneath, again=again), again=again)
        return cls(rest, None, None if resting.only_picture is None else Stale(resting.only_picture), again=again)

    def feed(self, sample: ElpSample, memory: EventMemory, *, ticked: bool) -> None:
        """Take a window, and the image where it was time to look at it."""
        self._detector.feed(sample)
        if self._bearing is not None and ticked:
            self._bearing.look(memory.image, sample.end_us)
        if self._stale is not None and ticked:
            self._stale.tick(memory.image, sample.end_us)

    @property
    def seen_ahead(self) -> bool:
        """Whether focus has been said to lie ahead."""
        if self._bearing is not None:
            return self._bearing.direction is Direction.APPROACHING
        return self._detector.direction is Direction.APPROACHING or self._detector.mutation is not None

    @property
    def direction(self) -> Direction:
        """Where focus lies by the newest verdict; of ELP by its first, once its picture has gone stale."""
        if self._bearing is not None:
            return self._bearing.direction
        forgotten = self._detector.mutation is not None and self._stale is not None and self._stale.is_so
        return Direction.APPROACHING if forgotten else self._detector.direction

    @property
    def changed_us(self) -> int | None:
        """When ELP changed its mind after "ahead"; ``None`` if it has not, or is not asked.

        Whoever has said "ahead" while its picture was new is not asked again when it has gone stale: then the sharpness
        of the events' image alone says when focus has been passed.
        """
        mutation = None if self._bearing is not None else self._detector.mutation
        if mutation is None or (self._stale is not None and self._stale.is_so):
            return None
        return mutation.decided_us

    @property
    def score(self) -> float:
        """The running evidence in standard deviations: positive while focus is ahead, negative once it is behind."""
        rally, drawdown = self._detector.approach_score, self._detector.recede_score
        return -drawdown if drawdown > rally else rally
