"""Mirror pairs of a sensor whose ON and OFF thresholds differ.

After two equal events at t0 and t1 the first opposite one at t2 lies one *opposite* threshold from t1's level, which is
t0's level only where the two thresholds are alike (``elpd.vision.pairs``). Where their ratio is known, the level of t2
is found on the way from t0 to t1, on the straight line between them: a correction along the motion, of the same
length at every speed, which would else pass for play.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.vision.pairs import Pairs

if TYPE_CHECKING:
    from numpy.typing import NDArray


def level_pairs(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    position: NDArray[np.float64],
    ratio: float,
) -> Pairs:
    """Return the mirror pairs of events in time order, in the order of pixels; *ratio* is C_on over C_off.

    With a ratio of one they are those of ``elpd.vision.pairs.find_pairs``.
    """
    order = np.lexsort((x, y))  # stable: time order stays within a pixel
    column, row, lit, at = x[order], y[order], on[order], position[order]
    same = (column[2:] == column[:-2]) & (row[2:] == row[:-2])
    turn = same & (lit[:-2] == lit[1:-1]) & (lit[2:] != lit[1:-1])
    first = np.flatnonzero(turn)
    x0, x1, x2 = at[first], at[first + 1], at[first + 2]
    back = np.where(lit[first + 2] == 1, ratio, 1.0 / ratio)
    last = order[first + 2]
    return Pairs(x1 - (x1 - x0) * back, x2, t_us[last], x[last], y[last], on[last])
