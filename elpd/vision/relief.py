"""Whether a region is flat: where each of its parts is in focus, by the mirror pairs of passes there and back.

Pairs that turn in many places say that a region holds several depths, or that its receptors are slow, each as slow as
its light, or that noise leads them astray. One pass cannot tell these from each other. Two can: receptors make each
part of the region late by as much on the way back as on the way there, so the middle of both is where the part is in
focus, whatever its light. In a flat region these places lie together within their errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.vision.pairs import weighted_mode
from elpd.vision.turns import BLOCKS, weighted_median

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.vision.turns import Turns

FEWEST_PAIRS = 8
FEWEST_PARTS = 3

LEAST_SPREAD = 0.01
"""Scatter of a part's pairs at the least, over how far they are asked: no midpoint is known better."""

_NORMAL_MAD = 1.4826
_OF_MEDIAN = 1.2533


_FINE = BLOCKS**2
_QUARTERS = 4
_QUARTER_OF = np.array(
    [2 * (2 * row // BLOCKS) + 2 * column // BLOCKS for row in range(BLOCKS) for column in range(BLOCKS)]
)
_GROUPS = [np.flatnonzero(np.arange(_FINE) == k) for k in range(_FINE)]
_GROUPS += [np.flatnonzero(np.equal(_QUARTER_OF, k)) for k in range(_QUARTERS)]
_ROW, _COLUMN = np.divmod(np.arange(_FINE), BLOCKS)
_HALVES = [
    *(one // (BLOCKS // 2) == 0 for one in (_ROW, _COLUMN)),
    *(one % 2 == 0 for one in (_ROW, _COLUMN, _ROW + _COLUMN)),
]
_GRIDS = (slice(0, _FINE), slice(_FINE, None))


@dataclass(frozen=True, slots=True)
class Parts:
    """Where a region's blocks are in focus by one pass, late as they are, and standard errors: (blocks + quarters,).

    The last four are of the region's quarters, for pairs that are too few for blocks. The error is infinite where there
    are too few pairs at all.
    """

    at: NDArray[np.float64]
    sigma: NDArray[np.float64]

    @classmethod
    def of(cls, turns: Turns, reach: float) -> Parts:
        """Return the weighted medians of the parts' midpoints within *reach* of the mode.

        No pair counts for more than a typical one.
        """
        at, sigma = np.zeros(len(_GROUPS)), np.full(len(_GROUPS), np.inf)
        near = (np.abs(turns.middle - turns.mode) <= reach) & (turns.weights > 0.0)
        if not near.any():
            return cls(at, sigma)
        most, least = float(np.median(turns.weights[near])), LEAST_SPREAD * reach
        for part, blocks in enumerate(_GROUPS):
            here = near & np.isin(turns.block, blocks)
            if int(here.sum()) < FEWEST_PAIRS:
                continue
            values, weights = turns.middle[here], np.minimum(turns.weights[here], most)
            at[part] = weighted_median(values, weights)
            spread = max(_NORMAL_MAD * weighted_median(np.abs(values - at[part]), weights), least)
            sigma[part] = _OF_MEDIAN * spread * float(np.sqrt(np.square(weights).sum())) / float(weights.sum())
        return cls(at, sigma)

    @classmethod
    def together(cls, passes: Sequence[Parts]) -> Parts:
        """Return the mean of passes in the same direction."""
        precision = np.array([1.0 / np.square(one.sigma) for one in passes])
        total = precision.sum(axis=0)
        known = total > 0.0
        at, sigma = np.zeros(total.size), np.full(total.size, np.inf)
        at[known] = (precision * np.array([one.at for one in passes])).sum(axis=0)[known] / total[known]
        sigma[known] = 1.0 / np.sqrt(total[known])
        return cls(at, sigma)


def halves_apart(turns: Turns) -> float:
    """Return the error of the pairs' mode by how far apart halves of the region put it: a standard deviation.

    The mode of few pairs that lie far and wide is any of several heaps, whatever the spread of that one heap says.
    """
    squares = []
    for half in _HALVES:
        inside = half[turns.block]
        one, other = (weighted_mode(turns.middle[part], turns.weights[part], turns.width) for part in (inside, ~inside))
        if one is not None and other is not None:
            squares.append((one.at - other.at) ** 2)
    return 0.5 * float(np.sqrt(np.mean(squares))) if squares else np.inf


def is_flat(there: Sequence[Parts], back: Sequence[Parts], within: float) -> bool | None:
    """Say whether a region's parts are in focus at one place, to a standard deviation of *within*.

    *there* and *back* are by passes in opposite directions, each on a ruler that rises with time. ``None`` where they
    do not tell: too few parts are known in both, or not well enough.
    The variance between parts beyond their errors is that of a random-effects model by the method of moments (R.
    DerSimonian, R. Kacker, Contemp. Clin. Trials 28, 2007), with the weights that parts would have if it were as large
    as may be.
    """
    if not there or not back:
        return None
    one, other = Parts.together(there), Parts.together(back)
    known = np.isfinite(one.sigma) & np.isfinite(other.sigma)
    grid = next((grid for grid in _GRIDS if int(known[grid].sum()) >= FEWEST_PARTS), None)
    if grid is None:
        return None
    both = known[grid]
    places = 0.5 * (one.at - other.at)[grid][both]
    errors = 0.25 * (np.square(one.sigma) + np.square(other.sigma))[grid][both]
    weights = 1.0 / (errors + within**2)
    total = float(weights.sum())
    off = places - float(weights @ places) / total
    free = weights * (1.0 - weights / total)
    between = float(weights @ np.square(off) - free @ errors) / float(free.sum())

    def doubt(variance: float) -> float:
        return float(np.sqrt(2.0 * np.square(weights * (errors + variance)).sum())) / float(free.sum())

    if between > within**2 + doubt(within**2):  # so much even if it were just flat
        return False
    return True if between + doubt(max(between, 0.0)) <= within**2 else None
