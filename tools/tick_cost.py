"""What following the sharpness of the events' own image costs, per event and per tick: ``python tools/tick_cost.py``.

A tick comes once per half a depth of focus of travel (0.75 ms at 4 mm/s and 6 um), whatever the event rate; the time
per event is that of keeping it and of adding it to the image. CPU time of this thread, median over rounds.
"""

from __future__ import annotations

import time
from itertools import count
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from elpd.records import Geometry, Roi
from elpd.vision.bearing import Bearing, Unrest
from elpd.vision.crossing import ROI_MARGIN_PX
from elpd.vision.memory import EventMemory

if TYPE_CHECKING:
    from collections.abc import Callable

ROUNDS = 30
EVENTS = 200_000


def main() -> None:
    """Measure two sizes of a region with its margin; print a table."""
    print(f"{'region':>12s}{'ns per event':>14s}{'us per tick':>13s}{'direction, us per tick':>24s}")
    for side in (104, 288):
        whole = side + 2 * ROI_MARGIN_PX
        geometry, roi = Geometry(whole, whole), Roi(ROI_MARGIN_PX, ROI_MARGIN_PX, side, side)
        rng = np.random.default_rng(1)
        x, y = (rng.integers(whole, size=EVENTS).astype(np.uint16) for _ in range(2))
        on, t_us = rng.integers(2, size=EVENTS).astype(np.uint8), np.arange(EVENTS, dtype=np.int64)
        memory = EventMemory(roi, geometry)
        per_event = spent_us(lambda m=memory, e=(t_us, x, y, on): m.add(*e)) / EVENTS  # type: ignore[misc]
        memory = EventMemory(roi, geometry)
        memory.add(t_us, x, y, on)
        memory.advance(EVENTS, 0.0)
        per_tick = spent_us(lambda m=memory: m.advance(EVENTS, 1.0))  # type: ignore[misc]
        image, ticks = memory.image.copy(), count(step=750)
        bearing = Bearing(Unrest(0.0, 1e9), ROI_MARGIN_PX, image)  # never certain, so that every look is whole
        look = spent_us(lambda b=bearing, i=image, t=ticks: b.look(i, next(t)))  # type: ignore[misc]
        print(f"{side:>8d}x{side:<3d}{1000 * per_event:>14.1f}{per_tick:>13.0f}{look:>24.0f}")


def spent_us(work: Callable[[], object]) -> float:
    """Return the median CPU time of *work* in microseconds."""
    spent = []
    for _ in range(ROUNDS):
        begun = time.thread_time()
        work()
        spent.append(1e6 * (time.thread_time() - begun))
    return median(spent)


if __name__ == "__main__":
    main()
