"""Events become samples of the Event Laplacian Product, one per window.

``ELP = -Σ p·w(x, y)`` is linear in the events (paper, equations 6 and 7, with the event frame summed away), so the
meter is a table look-up and an add. What matters is where windows end. Evidence accumulates with the *travel* of the
lens, not with time, so where its path is known a window is a fifth of a depth of focus of travel, and the same numbers
serve every speed; where nothing is known a window is a fixed number of events in the region.

A window is closed by the first event or promise at or after its end, never by the end of a recording: what was decided
then depends on nothing that came later.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from elpd.events.jit import kernel
from elpd.records import ElpSample
from elpd.units import SensorUs

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Roi
    from elpd.vision.filters import PixelCap
    from elpd.vision.reference import Reference
    from elpd.vision.ruler import Ruler

TRAVEL_PER_DEPTH_OF_FOCUS = 0.2
"""Travel of one window; between 0.15 and 0.3 nothing changes."""

PIXELS_PER_EVENT = 128
MIN_EVENTS_PER_WINDOW = 256


@kernel(
    "void(int64[::1], uint16[::1], uint16[::1], uint8[::1], int16[:, ::1], int64, int64, int64, int64, "
    "int64[::1], int64[:, ::1])"
)
def sum_windows(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    weights: NDArray[np.int16],
    x0: int,
    y0: int,
    x1: int,
    y1: int,
    edges_us: NDArray[np.int64],
    sums: NDArray[np.int64],
) -> None:
    """Add events to the windows between ascending *edges_us*; those outside edges or region are passed over.

    *sums*, (windows, 4) ``int64``, is added to: elp, energy, ON count, OFF count.
    """
    windows = edges_us.size - 1
    k = 0
    for i in range(t_us.size):
        if t_us[i] < edges_us[0]:
            continue
        while k < windows and t_us[i] >= edges_us[k + 1]:
            k += 1
        if k == windows:
            return
        if x[i] < x0 or x[i] >= x1 or y[i] < y0 or y[i] >= y1:
            continue
        w = np.int64(weights[y[i], x[i]])
        sums[k, 1] += w * w
        if on[i]:
            sums[k, 0] -= w
            sums[k, 2] += 1
        else:
            sums[k, 0] += w
            sums[k, 3] += 1


class Windows(Protocol):
    """Where windows end: exactly one of the two is finite."""

    def edge_after(self, begin_us: int) -> int | None:
        """Return when the window that begins at *begin_us* ends, or ``None`` if events decide."""
        ...

    @property
    def events(self) -> int:
        """How many events in the region end a window, where ``edge_after`` gives ``None``."""
        ...


@dataclass(frozen=True, slots=True)
class WindowsByTime:
    """Windows of a fixed duration."""

    duration_us: int
    events: int = 0

    def edge_after(self, begin_us: int) -> int | None:
        """Return the end of the window."""
        return begin_us + self.duration_us


@dataclass(frozen=True, slots=True)
class WindowsByTravel:
    """Windows of a fixed travel of the lens, along a path that is known."""

    ruler: Ruler
    travel: float
    events: int = 0

    def edge_after(self, begin_us: int) -> int | None:
        """Return when the lens has gone *travel* further, at most a tenth of a second later."""
        start = self.ruler.position(begin_us)
        step = 1
        while step < 100_000 and abs(self.ruler.position(begin_us + step) - start) < self.travel:
            step *= 2
        low, high = step // 2, step
        while high - low > 1:
            middle = (low + high) // 2
            if abs(self.ruler.position(begin_us + middle) - start) < self.travel:
                low = middle
            else:
                high = middle
        return begin_us + max(1, high)


@dataclass(frozen=True, slots=True)
class WindowsByEvents:
    """Windows of a fixed number of events in the region (and all others of the last one's time stamp)."""

    events: int

    def edge_after(self, begin_us: int) -> int | None:
        """Return nothing: events decide."""
        del begin_us
        return None

    @classmethod
    def for_roi(cls, roi: Roi) -> WindowsByEvents:
        """Return windows that hold enough events to say something, whatever the region's size."""
        return cls(max(MIN_EVENTS_PER_WINDOW, roi.width * roi.height // PIXELS_PER_EVENT))


class Meter:
    """Turns events into samples.

    Parameters
    ----------
    roi:
        Events outside are not counted.
    windows:
        Where windows end.
    ruler:
        Where the lens was, for the samples' positions; may be absent.
    begin_us:
        Start of the first window; earlier events are passed over.
    cap:
        Silences pixels that fire too often; may be absent.
    """

    def __init__(
        self, roi: Roi, windows: Windows, begin_us: int, ruler: Ruler | None = None, cap: PixelCap | None = None
    ) -> None:
        self._cap = cap
        self._refused_us = np.empty(0, dtype=np.int64)
        self.roi = roi
        self.windows = windows
        self.ruler = ruler
        self._weights: NDArray[np.int16] | None = None
        self._begin_us = begin_us
        self._sums = np.zeros((1, 4), dtype=np.int64)
        self._last_us = begin_us

    def set_reference(self, reference: Reference) -> None:
        """Use another picture from the next event on."""
        self._weights = reference.weights

    def feed(
        self,
        t_us: NDArray[np.int64],
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        on: NDArray[np.uint8],
        complete_until_us: int | None = None,
    ) -> list[ElpSample]:
        """Count events (in time order, none before what was fed) and return the windows that closed.

        *complete_until_us* promises that no earlier event will follow; without it the last event's stamp does.
        """
        weights = self._weights
        if weights is None:
            weights = np.zeros((self.roi.y + self.roi.height, self.roi.x + self.roi.width), dtype=np.int16)
        known_until = max(int(t_us[-1]) if t_us.size else self._last_us, complete_until_us or self._last_us)
        t_us, x, y, on = self._capped(t_us, x, y, on)
        samples: list[ElpSample] = []
        index = 0
        while True:
            edge = self._next_edge(t_us, x, y, index)
            if edge is None or edge > known_until:
                self._add(t_us[index:], x[index:], y[index:], on[index:], weights, known_until + 1)
                break
            until = int(np.searchsorted(t_us, edge, side="left"))
            self._add(t_us[index:until], x[index:until], y[index:until], on[index:until], weights, edge)
            samples.append(self._close(edge))
            index = until
        self._last_us = known_until
        return samples

    def _capped(
        self, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], on: NDArray[np.uint8]
    ) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
        if self._cap is None:
            return t_us, x, y, on
        keep = self._cap.keep(t_us, x, y)
        self._refused_us = np.concatenate([self._refused_us, t_us[~keep & self._inside(x, y)]])
        return t_us[keep], x[keep], y[keep], on[keep]

    def _next_edge(
        self, t_us: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], index: int
    ) -> int | None:
        fixed = self.windows.edge_after(self._begin_us)
        if fixed is not None:
            return fixed
        missing = self.windows.events - int(self._sums[0, 2] + self._sums[0, 3])
        if missing <= 0:
            return self._last_us + 1
        # A stretch long enough to hold the missing events in most cases; doubled until it does.
        reach = 4 * missing
        while True:
            part = slice(index, index + reach)
            inside = np.flatnonzero(self._inside(x[part], y[part]) & (t_us[part] >= self._begin_us))
            if inside.size >= missing:
                return int(t_us[index + int(inside[missing - 1])]) + 1
            if index + reach >= t_us.size:
                return None
            reach *= 2

    def _inside(self, x: NDArray[np.uint16], y: NDArray[np.uint16]) -> NDArray[np.bool_]:
        roi = self.roi
        return (x >= roi.x) & (x < roi.x + roi.width) & (y >= roi.y) & (y < roi.y + roi.height)

    def _add(
        self,
        t_us: NDArray[np.int64],
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        on: NDArray[np.uint8],
        weights: NDArray[np.int16],
        end_us: int,
    ) -> None:
        roi = self.roi
        edges = np.array([self._begin_us, max(end_us, self._begin_us + 1)], dtype=np.int64)
        right, bottom = roi.x + roi.width, roi.y + roi.height
        sum_windows(t_us, x, y, on, weights, roi.x, roi.y, right, bottom, edges, self._sums)

    def _close(self, end_us: int) -> ElpSample:
        elp, energy, n_on, n_off = (int(one) for one in self._sums[0])
        position = travel = float("nan")
        if self.ruler is not None and self.ruler.in_um:
            position = self.ruler.position(0.5 * (self._begin_us + end_us))
            travel = abs(self.ruler.position(end_us) - self.ruler.position(self._begin_us))
        n_capped = int(np.searchsorted(self._refused_us, end_us, side="left"))
        self._refused_us = self._refused_us[n_capped:]
        sample = ElpSample(
            SensorUs(self._begin_us), SensorUs(end_us), elp, energy, n_on, n_off, n_capped, position, travel
        )
        self._begin_us = end_us
        self._sums[:] = 0
        return sample
