"""What a region looks like while the lens stands still: its noise, whether its scene moves, and how it looks then."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.vision.detector import RestingRate
from elpd.vision.memory import EventMemory
from elpd.vision.track import frame_levels

if TYPE_CHECKING:
    from collections.abc import Iterable

    from elpd.events.decoder import EventArrays
    from elpd.records import Frame, Geometry, Roi

SIGMAS_OF_MOTION = 4.0
"""How much more order than independent events have shows that the scene moved while the lens stood still. A false
alarm costs a second pass."""


class RestingScene:
    """Collects what is seen at rest over a region; ``close`` ends the lesson."""

    def __init__(self, roi: Roi, geometry: Geometry) -> None:
        self._roi = roi
        self._geometry = geometry
        self._memory = EventMemory(roi, geometry)
        self._elp = self._us = 0
        self.frames: list[Frame] = []
        self.events = 0
        """How many events in the region the rate was learnt from."""
        self.rate = RestingRate()
        self.moves = False
        """Whether the events lie together as those of a moving scene do."""

    def take(self, events: EventArrays, frames: Iterable[Frame]) -> None:
        """Take a packet's events and frames."""
        self._memory.add(events.t, events.x, events.y, events.p)
        self.frames += frames

    def take_window(self, elp: int, events: int, duration_us: int) -> None:
        """Take one window of ELP."""
        self._elp += elp
        self.events += events
        self._us += duration_us

    def close(self) -> None:
        """Draw the conclusions."""
        if self._us > 0:
            self.rate = RestingRate(self._elp / self._us, self.events / self._us)
        self.moves = self._memory.order > SIGMAS_OF_MOTION

    def image_at_start(self) -> EventMemory:
        """Return a memory that begins with nothing, or, where the scene moves, with what it looks like now."""
        if not self.moves:
            return EventMemory(self._roi, self._geometry)
        if not self.frames:
            return EventMemory(self._roi, self._geometry, before=self._memory)
        frame = self.frames[-1]
        seen = self._memory.since(int(frame.t_us), frame_levels(frame.pixels))
        return EventMemory(self._roi, self._geometry, before=seen)
