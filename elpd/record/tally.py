"""What a recording holds, counted while it goes by.

One pass, bounded memory: events, times, steps back, trigger edges, frames, and at the end what is known to be missing
and why. `elpd decode`, `convert` and `record` all count with it, so that their numbers can be compared.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.epoch import EPOCH_STEP_US

if TYPE_CHECKING:
    from collections.abc import Mapping

    from elpd.events.stream import EventChunk

SMALL_STEP_BACK_US = 64
"""Real streams step back by some microseconds; more is worth a warning."""

ODDITIES = {
    "padding": "padding words (0x9999)",
    "reserved": "reserved words",
    "stray_continued": "continuation words that continue nothing",
    "triggers_lost": "trigger edges did not fit",
}


class Tally:
    """Counts of a recording.

    Attributes
    ----------
    events, on, triggers, frames, imu : int
    first_us, last_us : int or None
        Times of the first and last event, in stream order.
    step_back_us : int
        The largest step back in time.
    epochs : int
        How often time jumped back so far that it must be another epoch.
    """

    def __init__(self) -> None:
        self.events = self.on = self.triggers = self.frames = self.imu = 0
        self.first_us: int | None = None
        self.last_us: int | None = None
        self.step_back_us = 0
        self.epochs = 0

    def add(self, chunk: EventChunk) -> None:
        """Count the next chunk."""
        self.triggers += len(chunk.triggers)
        self.frames += len(chunk.frames)
        self.imu += len(chunk.imu)
        if chunk.t.size == 0:
            return
        self.events += chunk.t.size
        self.on += int(chunk.p.sum())
        t = chunk.t if self.last_us is None else np.concatenate(([self.last_us], chunk.t))
        steps = np.diff(t)
        self.step_back_us = max(self.step_back_us, -int(steps.min(initial=0)))
        self.epochs += int((steps < -EPOCH_STEP_US).sum())
        self.first_us = int(chunk.t[0]) if self.first_us is None else self.first_us
        self.last_us = int(chunk.t[-1])

    def warnings(self, notes: Mapping[str, Any], counted: Mapping[str, int]) -> list[str]:
        """Return what is odd about a recording read through, as sentences.

        *notes* are its reader's, *counted* its decoder's (``EventStream.counters``).
        """
        counters = Counter(counted)
        found = list(notes.get("warnings", []))
        found += [f"{counters[name]} {text}" for name, text in ODDITIES.items() if counters[name]]
        if self.events == 0:
            found.append("the file holds no events")
        if self.epochs:
            found.append(f"time jumps back {self.epochs} times, by up to {self.step_back_us} us: the clock was reset")
        elif self.step_back_us > SMALL_STEP_BACK_US:
            found.append(f"time steps back by up to {self.step_back_us} us")
        return found


def losses(
    notes: Mapping[str, Any], counted: Mapping[str, int], rate_controller: tuple[int, int] | None
) -> tuple[int, list[str]]:
    """Add up what is known to be missing, and say why."""
    counters = Counter(counted)
    lost, reasons = int(notes.get("lost", 0)), list(notes.get("lost_reason", []))
    outside = counters["x_out_of_range"] + counters["y_out_of_range"]
    if outside:
        lost += outside
        reasons.append(f"{outside} events lie outside the sensor or belong to no row")
    if rate_controller is not None and rate_controller[0] > rate_controller[1]:
        dropped = rate_controller[0] - rate_controller[1]
        lost += dropped
        reasons.append(f"the camera's rate controller dropped {dropped} events")
    return lost, reasons
