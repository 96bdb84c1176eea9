"""A sweep under a lamp that flickers: only what whole periods of it leave behind counts."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from elpd.vision.whole_periods import WholePeriods

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.events.decoder import EventArrays
    from elpd.records import ElpSample
    from elpd.vision.memory import EventMemory
    from elpd.vision.whole_periods import NetEvents


class Lamplight:
    """Keeps the events of unfinished periods, and what the way back undoes.

    Parameters
    ----------
    heard:
        (height, width) of the sensor: the region and its margin.
    """

    def __init__(self, heard: NDArray[np.bool_]) -> None:
        self._heard = heard
        self.begin(0)

    def begin(self, at_us: int) -> None:
        """Begin a sweep: periods are counted from *at_us*."""
        self._periods = WholePeriods(self._heard, at_us)
        self._undone = np.zeros(self._heard.shape, np.int32)

    def add(self, events: EventArrays) -> None:
        """Take a packet's events."""
        self._periods.add(events.t, events.x, events.y, events.p)

    def close(self, sample: ElpSample) -> NetEvents:
        """Return the net events of the window of *sample*."""
        return self._periods.close(sample.begin_us, sample.end_us)

    def undo(self, net: NetEvents) -> None:
        """Take net events of the way back."""
        np.add.at(self._undone, (net.y, net.x), 2 * net.on.astype(np.int32) - 1)

    def return_score(self, memory: EventMemory, focus: float) -> float:
        """Return by how many standard deviations the way back undid what the way out from *focus* had done."""
        out = memory.change_beyond(focus).astype(np.float64)
        product = out * memory.cut(self._undone)
        return float(-product.sum() / max(np.sqrt(np.square(product).sum()), 1.0))


def weighed(sample: ElpSample, net: NetEvents, weights: NDArray[np.int16], inside_roi: NDArray[np.bool_]) -> ElpSample:
    """Return *sample* with the sums of the net events in its place: *weights* and *inside_roi* are (height, width)."""
    inside = inside_roi[net.y, net.x]
    weight = np.where(inside, weights[net.y, net.x], 0).astype(np.int64)
    sign = 2 * net.on.astype(np.int64) - 1
    n_on = int(net.on[inside].sum())
    return replace(
        sample,
        elp=-int(sign @ weight),
        energy=int(weight @ weight),
        n_on=n_on,
        n_off=int(inside.sum()) - n_on,
    )
