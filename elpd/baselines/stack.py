"""What every peer is given and what it must answer.

A peer sees one recorded sweep: events, the frames that were there, where the lens was, and the region of interest. It
answers with one time, on the sensor's clock, at which the lens stood in focus, or with ``nan``. Peers that need the
whole stack say so in ``decided_us``: an answer that could only be given at the end of the record was decided there,
whatever it says about the past. The benchmark reports both numbers, because published tables report only the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Geometry, Roi


@dataclass(frozen=True, slots=True)
class StackFrame:
    """A grey image (height, width) ``uint8`` of the instant ``t_us``."""

    t_us: int
    pixels: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class LensPath:
    """Where the lens was: positions in um at increasing times in us, linear between and held outside them."""

    t_us: NDArray[np.float64]
    position_um: NDArray[np.float64]

    def at(self, t_us: float) -> float:
        """Return the position at *t_us*."""
        return float(np.interp(t_us, self.t_us, self.position_um))

    def time_at(self, position_um: float) -> float:
        """Return when the lens was at *position_um*, for a path that moves one way; held outside its ends."""
        if self.position_um[-1] >= self.position_um[0]:
            return float(np.interp(position_um, self.position_um, self.t_us))
        return float(np.interp(position_um, self.position_um[::-1], self.t_us[::-1]))


@dataclass(frozen=True, slots=True)
class FocusStack:
    """One recorded sweep.

    ``t_us`` is sorted ``int64``; ``x``, ``y`` ``uint16``; ``on`` ``uint8`` (1 brighter, 0 darker); all (events,).
    The record covers ``begin_us`` to ``end_us``, ends included. ``frames`` are in order of time. ``path`` is ``None``
    where nobody knew where the lens was; peers then treat its speed as constant.
    """

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]
    geometry: Geometry
    roi: Roi
    begin_us: int
    end_us: int
    frames: tuple[StackFrame, ...] = ()
    path: LensPath | None = None

    @property
    def duration_us(self) -> int:
        """How long the record is."""
        return self.end_us - self.begin_us

    def inside_roi(self) -> NDArray[np.bool_]:
        """Say of every event whether it lies in the region of interest."""
        columns = (self.x >= self.roi.x) & (self.x < self.roi.x + self.roi.width)
        return columns & (self.y >= self.roi.y) & (self.y < self.roi.y + self.roi.height)

    def lens_um(self, t_us: float) -> float:
        """Return the lens position at *t_us*; without a path, microseconds since the beginning stand for it."""
        return t_us - self.begin_us if self.path is None else self.path.at(t_us)

    def time_at_um(self, position_um: float) -> float:
        """Return when the lens was at *position_um*, the inverse of ``lens_um``."""
        return position_um + self.begin_us if self.path is None else self.path.time_at(position_um)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A peer's answer.

    ``focus_us`` is when the lens stood in focus, ``nan`` for no answer. ``decided_us`` is the sensor time of the last
    datum that the answer rests on: no implementation could have given it earlier. ``details`` are plain numbers and
    words for the report, curves as lists.
    """

    focus_us: float
    decided_us: float
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def found(self) -> bool:
        """Whether there is an answer."""
        return math.isfinite(self.focus_us)


Peer = Callable[[FocusStack], Estimate]
"""A peer is a function from a stack to an estimate."""


def no_answer(reason: str, **details: Any) -> Estimate:
    """Return the answer of a peer that has none, and why."""
    return Estimate(math.nan, math.nan, {"reason": reason, **details})
