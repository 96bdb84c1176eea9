"""Which way focus lies, as far as a sweep has told: by ELP while the scene is still, by sharpness where it moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.records import Direction
from elpd.vision.bearing import Bearing
from elpd.vision.crossing import ROI_MARGIN_PX
from elpd.vision.detector import Detector

if TYPE_CHECKING:
    from elpd.records import ElpSample
    from elpd.vision.detector import RestingRate
    from elpd.vision.memory import EventMemory
    from elpd.vision.resting import Resting

SIGMAS_OF_PROBE = 5.0
"""What turns the first direction round: a false one costs a turn, and every micrometre the wrong way counts."""

SIGMAS_AFTER_REVERSAL = 9.0
"""A false reversal costs the most: the second needs this many standard deviations."""


class Heading:
    """Judges one direction of travel.

    Parameters
    ----------
    rest:
        What noise alone looks like.
    bearing:
        What judges instead of ELP where the scene moves.
    again:
        Whether another verdict has turned the lens round: the opposite one must be more certain still.
    """

    def __init__(self, rest: RestingRate, bearing: Bearing | None = None, *, again: bool = False) -> None:
        self._detector = Detector(rest, recede_sigmas=SIGMAS_AFTER_REVERSAL if again else SIGMAS_OF_PROBE)
        self._bearing = bearing

    @classmethod
    def of_sweep(cls, rest: RestingRate, resting: Resting, *, again: bool) -> Heading:
        """Return what judges a sweep that begins after *resting*."""
        bearing = None
        if resting.unrest is not None:
            bearing = Bearing(resting.unrest, ROI_MARGIN_PX, resting.beneath, again=again)
        return cls(rest, bearing, again=again)

    def feed(self, sample: ElpSample, memory: EventMemory, *, ticked: bool) -> None:
        """Take a window, and the image where it was time to look at it."""
        self._detector.feed(sample)
        if self._bearing is not None and ticked:
            self._bearing.look(memory.image, sample.end_us)

    @property
    def seen_ahead(self) -> bool:
        """Whether focus has been said to lie ahead."""
        if self._bearing is not None:
            return self._bearing.direction is Direction.APPROACHING
        return self._detector.direction is Direction.APPROACHING or self._detector.mutation is not None

    @property
    def direction(self) -> Direction:
        """Where focus lies by the newest verdict."""
        return self._detector.direction if self._bearing is None else self._bearing.direction

    @property
    def changed_us(self) -> int | None:
        """When ELP changed its mind after "ahead"; ``None`` if it has not, or is not asked."""
        mutation = None if self._bearing is not None else self._detector.mutation
        return None if mutation is None else mutation.decided_us

    @property
    def score(self) -> float:
        """The running evidence in standard deviations: positive while focus is ahead, negative once it is behind."""
        rally, drawdown = self._detector.approach_score, self._detector.recede_score
        return -drawdown if drawdown > rally else rally
