"""Background activity: events that no neighbour vouches for.

A dark pixel fires by leakage and shot noise, alone; an edge passes over many. So the classic filter believes an event
only if some other pixel close by has fired shortly before (Delbruck 2008). Here close by is the same cell of two by two
pixels, and what is remembered of a cell is its last event alone: one number for four pixels, read and written once an
event (Khodamoradi and Kastner 2018 go further and remember rows and columns). A pixel does not vouch for itself, or a
hot one would pass; and what the rate cap refuses vouches for nobody.

Whether it pays is another matter, and for focusing it mostly does not: ``tools/docs/throughput.md`` has the figures.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.events.registers import Integer

CELL = 2
"""Side of a cell."""

NEVER = -(1 << 62)


@kernel()
def is_alone(t: Integer, place: Any, cells: NDArray[np.int64], cell: Any, support_us: Any) -> bool:
    """Remember an event at *place* (0 to 3) of a cell; say whether nobody else there fired at most *support_us* before.

    A cell holds the time of its last event times four, plus its place. Time may step back: that counts as just before.
    """
    last = cells[cell]
    cells[cell] = t * 4 + place
    return bool(t - (last >> 2) > support_us or last & 3 == place)


@kernel("int64(int64[::1], uint16[::1], uint16[::1], int64, int64, int64[::1], int64, int64, uint8[::1])")
def find_supported(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    left: int,
    top: int,
    cells: NDArray[np.int64],
    cells_per_row: int,
    support_us: int,
    keep: NDArray[np.uint8],
) -> int:
    """Mark in *keep* the events that are not alone; return how many are. *left*, *top* are added to x and y."""
    refused = 0
    for i in range(t_us.size):
        column, row = np.int64(x[i]) + left, np.int64(y[i]) + top
        cell = row // CELL * cells_per_row + column // CELL
        alone = is_alone(t_us[i], row % CELL * CELL + column % CELL, cells, cell, support_us)
        keep[i] = not alone
        refused += alone
    return refused


class BackgroundActivity:
    """The filter over one region.

    Parameters
    ----------
    height, width
        Of the region, pixels.
    support_us
        An event needs another pixel of its cell to have fired at most so long before.
    left, top
        Where the region begins on the sensor, so that cells are the same for all regions.
    """

    def __init__(self, height: int, width: int, support_us: int, *, left: int = 0, top: int = 0) -> None:
        self._left, self._top = left % CELL, top % CELL
        self._per_row = width // CELL + 2
        self._cells = np.full((height // CELL + 2) * self._per_row, NEVER, np.int64)
        self._support_us = support_us

    def keep(self, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """Return which of the events (in the stream's order, in the region's coordinates) pass."""
        keep = np.empty(t_us.size, np.uint8)
        cells, step = self._cells, self._per_row
        find_supported(t_us, x, y, self._left, self._top, cells, step, self._support_us, keep)
        return keep.view(np.bool_)
