"""What a calibration looks at, wherever it comes from: a live rig, a run's folder, somebody's sweep.

Each part is optional, because a recording may hold one and not another; whoever measures says what was missing. Times
are microseconds of the sensor's clock, positions micrometres on the motor's ruler.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Geometry
    from elpd.vision.ruler import Ruler


class Columns(NamedTuple):
    """Events in time order, in the sensor's coordinates: ``t_us`` int64, ``x`` and ``y`` uint16, ``on`` uint8."""

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]

    def between(self, begin_us: float, end_us: float) -> Columns:
        """Return those in ``[begin_us, end_us)``, as views."""
        part = slice(*np.searchsorted(self.t_us, [begin_us, end_us], side="left").tolist())
        return Columns(self.t_us[part], self.x[part], self.y[part], self.on[part])

    def chosen(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> Columns:
        """Return those that a mask or a list of indices names."""
        return Columns(self.t_us[which], self.x[which], self.y[which], self.on[which])

    def counts(self, geometry: Geometry) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return how many ON and how many OFF events each pixel has, both (height, width)."""
        shape = (geometry.height, geometry.width)
        pixel = self.y.astype(np.int64) * geometry.width + self.x
        lit = self.on == 1
        size = geometry.height * geometry.width
        return (
            np.bincount(pixel[lit], minlength=size).reshape(shape),
            np.bincount(pixel[~lit], minlength=size).reshape(shape),
        )


NO_EVENTS = Columns(np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.uint8))


@dataclass(frozen=True, slots=True)
class Rest:
    """Events of a span in which nothing moved."""

    events: Columns
    begin_us: int
    end_us: int

    @property
    def duration_s(self) -> float:
        """How long it was."""
        return 1e-6 * (self.end_us - self.begin_us)


class Pass(NamedTuple):
    """One motion in one direction: when it began and ended, and its sign on the ruler."""

    begin_us: int
    end_us: int
    sign: int


@dataclass(frozen=True, slots=True)
class Sweeps:
    """Whole there-and-backs at one speed: they begin and end at one place, after the same motion.

    ``events`` and ``path`` cover ``begin_us .. end_us``; ``passes`` are the single motions in it.
    """

    speed_um_s: float
    events: Columns
    path: Ruler
    begin_us: int
    end_us: int
    passes: tuple[Pass, ...]


@dataclass(frozen=True, slots=True)
class Step:
    """What frames and events say of one change between two pictures.

    ``before`` and ``after`` are stacks of frames, (frames, height, width), linear in light; ``events`` came between.
    ``speed_um_s`` is how fast the lens went, ``nan`` where that is not known.
    """

    before: NDArray[np.generic]
    after: NDArray[np.generic]
    events: Columns
    duration_s: float
    speed_um_s: float


@dataclass(frozen=True, slots=True)
class Evidence:
    """All that there is to look at. ``missing`` says, by part, why it is not there."""

    geometry: Geometry
    rest: Rest | None = None
    sweeps: tuple[Sweeps, ...] = ()
    steps: tuple[Step, ...] = ()
    brightness: NDArray[np.float32] | None = None
    """Linear intensity relative to the brightest parts, (height, width)."""
    brightness_doubt: float = 0.0
    """Relative error of the slowness that follows from it, beside what every picture has."""
    black: float | None = None
    """Grey level of darkness in frames, where somebody knows it."""
    other: Columns | None = None
    """Events of which nothing more is known than that they came from this sensor."""
    lost_events: int = 0
    missing: dict[str, str] | None = None

    def why_not(self, part: str, otherwise: str) -> str:
        """Return why a part is missing."""
        return (self.missing or {}).get(part, otherwise)
