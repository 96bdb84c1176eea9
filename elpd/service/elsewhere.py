"""Where continuous mode looks when focus was not found from where the lens is: once at each place of its travel.

Far out of focus a picture shows next to nothing, and no direction can be told from it. A cycle finds focus within some
hundred depths of focus of where it begins, so beginning one at a few places finds it wherever it lies. That is done
once: if there is nothing to focus on, a lens that goes to and fro for ever would not find it either. At the end the
lens is put back where the search began.
"""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING

import structlog

from elpd.service.messages import FocusParams, MoveParams

if TYPE_CHECKING:
    from collections.abc import Sequence

    from elpd.service.messages import LensStatus

REACH_DOF = 150.0
"""A cycle finds focus so far from where it begins. Simulated pictures show it from 200 depths (1.2 mm of 6 um) in
nearly all scenes, and this leaves room; blur goes with defocus in depths of focus in any lens."""

OUTCOMES = frozenset({"NO_CROSSING", "NO_TEXTURE", "LOW_CONFIDENCE", "TOO_FEW_EVENTS"})
"""How a cycle ends that began too far away. What ended otherwise ends so elsewhere too."""

log = structlog.get_logger(__name__)


class Elsewhere:
    """A search over the travel: moves and cycles by turns. Whoever holds it locks it."""

    def __init__(self) -> None:
        self.places_um: tuple[float, ...] = ()
        """Where it has begun cycles, or will; empty if there was no search since focus was found."""
        self._left_um: list[float] = []
        self._back_um: float | None = None
        self._begins_here = False

    @property
    def goes_on(self) -> bool:
        """Whether something is left to be done."""
        return self._begins_here or bool(self._left_um) or self._back_um is not None

    def failed(self, outcome: str, lens: LensStatus, depth_of_focus_um: float) -> None:
        """Hear of a cycle without focus; the first one after which there is somewhere else to look begins a search."""
        if outcome not in OUTCOMES:
            self.stop()
        elif not self.places_um and lens.position_um is not None and lens.limits_um is not None:
            self.places_um = places_um(lens.position_um, lens.limits_um, REACH_DOF * depth_of_focus_um)
            if self.places_um:
                self._left_um, self._back_um = list(self.places_um), lens.position_um
                log.info("focus is searched elsewhere", from_um=lens.position_um, places_um=self.places_um)

    def wish(self) -> tuple[str, FocusParams | MoveParams] | None:
        """Return what should be asked for now, if anything."""
        if self._begins_here:
            self._begins_here = False
            return "focus", FocusParams()
        to_um = self._left_um[0] if self._left_um else self._back_um
        return None if to_um is None else ("move", MoveParams(to_um=to_um))

    def moved(self, *, ended_well: bool) -> None:
        """Hear how a move that it wished for has ended."""
        if not ended_well:
            self.stop()
        elif self._left_um:
            del self._left_um[0]
            self._begins_here = True
        else:
            self._back_um = None

    def stop(self) -> None:
        """Go nowhere any more; a search that has been is not begun again."""
        self._left_um, self._back_um, self._begins_here = [], None, False

    def forget(self) -> None:
        """Focus was found, or somebody asks anew: the next failure may begin a search."""
        self.stop()
        self.places_um = ()


def places_um(here_um: float, limits_um: Sequence[float], reach_um: float) -> tuple[float, ...]:
    """Return from which places all of a travel is within reach, the nearest first, but for one that is here (pure)."""
    low_um, high_um = min(limits_um), max(limits_um)
    count = max(1, ceil((high_um - low_um) / (2 * reach_um)))
    span_um = (high_um - low_um) / count
    places = [low_um + (k + 0.5) * span_um for k in range(count)]
    spare_um = max(0.0, reach_um - 0.5 * span_um)  # a cycle from so far beside a place reaches what one from it would
    return tuple(sorted((at for at in places if abs(at - here_um) > spare_um), key=lambda at: abs(at - here_um)))
