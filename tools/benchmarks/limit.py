"""How well the signs of the events could tell focus at best: a Cramér-Rao-like limit for every case.

Take of every event one bit: whether its polarity and the Laplacian of the *current, noise-free* log picture at its
pixel say "sharper" or "more blurred". At lens position v the bit is +1 with probability (1 + rho(v)) / 2, where rho is
ELP normalised to the number of events, positive before focus and negative behind it. Moving focus moves the curve, so
N(v) independent events at v hold the Fisher information

    I = Σ N(v)·rho'(v)² / (1 - rho(v)²),      sigma >= 1 / √I

on where focus is. rho is fitted as ``-a·tanh((v - c) / w)``, because the differences of a noisy curve would be taken
for slope and promise too much. (The curve's own centre c, which hysteresis makes late, does not enter: a limit to
scatter is no limit to bias.)

What it is not: a limit to everything. Real detectors have a blurred or stale picture and do worse; events are not quite
independent; and who uses *when* each pixel fires, as mirror pairs do, has more than one bit of an event and may do
better.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from benchmarks.retina import RetinaEvents
    from elpd.records import Roi

REACH = 7.5
"""How far around focus events are counted, in depths of focus: 45 um where one is 6 um."""

_SCALE_PX = 1.0
_GROUND = 10.0
_FEWEST_EVENTS = 200


class SignLimit:
    """Counts a sweep's events by what they say of the picture they were made by."""

    def __init__(self, roi: Roi) -> None:
        self._roi = roi
        self._position_um: list[float] = []
        self._events: list[int] = []
        self._sharper: list[int] = []

    def add(self, events: RetinaEvents, picture: NDArray[np.float32], position_um: float) -> None:
        """Take the events of a short interval, the picture (height, width) of then, and the lens's position."""
        roi = self._roi
        log = np.log(picture + np.float32(_GROUND))
        bend = cv2.Laplacian(cv2.GaussianBlur(log, (0, 0), _SCALE_PX), cv2.CV_32F)
        inside = (events.x >= roi.x) & (events.x < roi.x + roi.width)
        inside &= (events.y >= roi.y) & (events.y < roi.y + roi.height)
        polarity = 2.0 * events.on[inside] - 1.0
        said = -polarity * bend[events.y[inside], events.x[inside]]
        self._position_um.append(position_um)
        self._events.append(int(np.count_nonzero(said)))
        self._sharper.append(int(np.count_nonzero(said > 0.0)))

    def sigma_um(self, depth_of_focus_um: float) -> float:
        """Return the least standard deviation, ``nan`` where the signs say nothing about focus."""
        position_um = np.array(self._position_um)
        events = np.array(self._events, dtype=np.float64)
        near = (np.abs(position_um) <= REACH * depth_of_focus_um) & (events > 0)
        if events[near].sum() < _FEWEST_EVENTS:
            return math.nan
        rho = 2.0 * np.array(self._sharper)[near] / events[near] - 1.0
        return sign_sigma_um(position_um[near], events[near], rho, depth_of_focus_um)


def sign_sigma_um(
    position_um: NDArray[np.float64], events: NDArray[np.float64], rho: NDArray[np.float64], depth_of_focus_um: float
) -> float:
    """Return ``1 / √I`` for counts of *events* with mean sign *rho* at positions, all (n,); ``nan`` if rho never falls.

    Of the curves ``-a·tanh((v - c) / w)`` with c within a depth of focus and a half of the truth, the one is taken that
    lies nearest in least squares, each bin weighted by its events.
    """
    best = (math.inf, 0.0, 0.0, 1.0)
    for width in depth_of_focus_um * np.geomspace(0.1, 10.0, 41):
        for centre in depth_of_focus_um * np.linspace(-1.5, 1.5, 31):
            shape = -np.tanh((position_um - centre) / width)
            height = float((events * shape * rho).sum() / (events * shape * shape).sum())
            height = min(height, 0.999)
            residual = float((events * np.square(rho - height * shape)).sum())
            if residual < best[0]:
                best = (residual, height, float(centre), float(width))
    _, height, centre, width = best
    # Signs at random still fit something: a height of less than three of its standard errors is nothing.
    if height * math.sqrt(events.sum()) < 3.0:
        return math.nan
    bent = np.tanh((position_um - centre) / width)
    slope = height / width * (1.0 - bent * bent)
    information = float((events * slope * slope / (1.0 - np.square(height * bent))).sum())
    return 1.0 / math.sqrt(information) if information > 0.0 else math.nan
