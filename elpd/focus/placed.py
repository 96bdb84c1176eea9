"""Windows of ELP on the path of the lens."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.records import ElpSample
from elpd.units import SensorUs

if TYPE_CHECKING:
    from collections.abc import Callable


class Placed:
    """Says where the lens was during a window; windows follow one another, so each end is asked for once."""

    def __init__(self, locate: Callable[[SensorUs], float]) -> None:
        self._locate = locate
        self._last = (SensorUs(-1), 0.0)

    def sample(self, row: tuple[int, ...]) -> ElpSample:
        """Return a row of ``ElpWindows``, as Python numbers, with its place and travel in um."""
        begin_us, end_us, elp, energy, n_on, n_off, n_capped = row
        begin, end = SensorUs(begin_us), SensorUs(end_us)
        before_us, before_um = self._last
        from_um = before_um if before_us == begin else self._locate(begin)
        to_um = self._locate(end)
        self._last = end, to_um
        place_um, travel_um = 0.5 * (from_um + to_um), to_um - from_um
        return ElpSample(begin, end, elp, energy, n_on, n_off, n_capped, place_um, travel_um)
