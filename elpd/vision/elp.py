"""The Event Laplacian Product, window by window, straight from what a camera delivers.

ELP is linear in the events: ``ELP = -Σ p·w(x, y)`` with p = ±1 and w the Laplacian of the reference (the paper's eq.
for the product of event frame and image Laplacian, summed the other way round). So no event frame is built: each
event is one table look-up and one add, and for raw words decoding and summing are one pass. All sums are exact
integers: they do not depend on how the stream was cut into packets.

``ElpWindows`` is the one user-facing object. It holds the decoder's registers, the open window and the weight table,
and hands a packet to the kernel of its encoding. It knows windows only as an ascending list of edge times; whether
those are even in time or in travel of the lens is for its caller to say.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import UsageError
from elpd.events.epoch import enter_epoch
from elpd.events.layout import event_columns
from elpd.events.registers import (
    counters,
    forget_addresses,
    new_state,
    new_triggers,
    rate_controller,
    take_triggers,
)
from elpd.records import Encoding
from elpd.vision import elp_addresses, elp_lanes
from elpd.vision.elp_weights import weight_table
from elpd.vision.elp_windows import (
    CURSOR,
    EARLY,
    LATE,
    N_EDGES,
    N_ROWS,
    NEVER,
    NOW,
    OPEN_ENDED,
    OUT_OF_SENSOR,
    OUTSIDE,
    PAUSED,
    ROW_COLUMNS,
    ROW_DTYPE,
    new_window,
)
from elpd.vision.elp_words import new_buckets

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.records import CameraPacket, Trigger

EDGES_AHEAD = 256
MAX_EMPTY_WINDOWS = 4096
ROWS_AT_ONCE = 1024


class ElpWindows:
    """Sum events into ELP windows.

    Parameters
    ----------
    weights : (height, width) integers
        The Laplacian of the reference over the whole sensor, within ±32766.
    inside : (height, width) bool, optional
        The region of interest, of any shape; hot pixels may be left out. All pixels by default.
    window_us : int, optional
        Even windows of this length, for ever. Without it, windows are what ``extend_edges`` says.
    origin_us : int, optional
        Where the first of the even windows begins; by default at the multiple of *window_us* at or before the first
        time stamp. Events before it are counted as early.
    rate_cap : bool
        Refuse the events of a pixel beyond 8 within a leaky 5 ms (``elp_words.CAP_EVENTS``, ``CAP_US``).
    support_us : int
        Beside the rate cap, refuse events that no other pixel of their 2x2 cell fired so shortly before
        (``elpd.vision.background``); 0: do not. Only with *rate_cap*.

    Notes
    -----
    A stream that jumps ahead by more than 4096 even windows gives one long window over the gap instead of an endless
    row of empty ones; its ``end_us - begin_us`` shows it.
    """

    def __init__(
        self,
        weights: NDArray[Any],
        inside: NDArray[np.bool_] | None = None,
        *,
        window_us: int | None = None,
        origin_us: int | None = None,
        rate_cap: bool = False,
        support_us: int = 0,
    ) -> None:
        if window_us is not None and window_us < 1:
            raise UsageError(f"a window must last 1 us at least; got {window_us}")
        self._table = weight_table(weights, inside)
        self._window_us = window_us
        self._window = new_window()
        self._window[OPEN_ENDED] = window_us is None
        self._edges = np.empty(EDGES_AHEAD, np.int64)
        self._rows = np.empty((ROWS_AT_ONCE, ROW_COLUMNS), np.int64)
        self._closed = self._rows.view(ROW_DTYPE).reshape(-1)
        self._state = new_state()
        self._triggers = new_triggers()
        if support_us < 0 or (support_us > 0 and not rate_cap):
            raise UsageError(f"support_us is 0 or more, and goes with rate_cap; got {support_us}")
        self._bucket = new_buckets(self._table.shape[0] if rate_cap else 1, support_us)
        self._arrays = elp_addresses.arrays_to_windows_capped if rate_cap else elp_addresses.arrays_to_windows
        self._pending = elp_lanes.scratch()
        self._words = (
            {
                Encoding.EVT3: elp_lanes.kernels()[1],
                Encoding.EVT2: elp_addresses.evt2_to_windows_capped,
                Encoding.EVT21: elp_addresses.evt21_to_windows_capped,
            }
            if rate_cap
            else {
                Encoding.EVT3: elp_lanes.kernels()[0],
                Encoding.EVT2: elp_addresses.evt2_to_windows,
                Encoding.EVT21: elp_addresses.evt21_to_windows,
            }
        )
        if origin_us is not None:
            self._append(np.array([origin_us], np.int64))

    def extend_edges(self, edges_us: Sequence[int] | NDArray[np.int64]) -> None:
        """Append window edges: ascending, after those there are, and after the newest event seen.

        Until an edge after it is appended, the last edge begins a window without end, which is not reported.

        Raises
        ------
        UsageError
            If the edges do not ascend, or time has passed the first of them, or windows are even.
        """
        edges = np.asarray(edges_us, np.int64).reshape(-1)
        if self._window_us is not None:
            raise UsageError("even windows make their own edges; leave window_us out to give edges")
        if edges.size == 0:
            return
        n_edges = int(self._window[N_EDGES])
        if (np.diff(edges) <= 0).any() or (n_edges > 0 and edges[0] <= self._edges[n_edges - 1]):
            raise UsageError("window edges must ascend, and follow the edges given before")
        if self._window[CURSOR] == n_edges - 1 and n_edges > 0 and edges[0] <= self._window[NOW]:
            raise UsageError(
                f"time has reached {self._window[NOW]} us already; an edge at {edges[0]} us comes too late, "
                "give edges further ahead"
            )
        self._append(edges)

    def set_weights(self, weights: NDArray[Any], inside: NDArray[np.bool_] | None = None) -> None:
        """Weigh events by another reference from now on; the open window goes on.

        Raises ``UsageError`` as the constructor does, and for a sensor of another size.
        """
        table = weight_table(weights, inside)
        if table.shape != self._table.shape:
            raise UsageError(f"the new weights of {weights.shape} are for another sensor; make a new ElpWindows")
        self._table = table

    def feed(self, packet: CameraPacket) -> NDArray[Any]:
        """Sum a packet; return the windows it closed.

        Returns
        -------
        (n,) of ``ROW_DTYPE``
            ``begin_us end_us elp energy n_on n_off n_capped``, oldest first: a view, valid until the next call.

        Raises
        ------
        UsageError
            For data that is not what its encoding says.
        """
        if packet.gap_before:
            forget_addresses(self._state)
        until_us = NEVER if packet.complete_until_us is None else packet.complete_until_us
        if packet.encoding is Encoding.ARRAY:
            return self.feed_arrays(*event_columns(packet.data), complete_until_us=until_us)
        enter_epoch(packet, self._state)
        sum_words = self._words[packet.encoding]
        scratch = (self._bucket, *self._pending)
        words = packet.data
        window = self._window
        window[N_ROWS] = 0
        position = sum_words(
            words, 0, self._state, self._triggers, self._table, window, self._edges, self._rows, until_us, *scratch
        )
        while window[PAUSED]:
            self._make_room()
            position = sum_words(
                words, position, self._state, self._triggers, self._table, window, self._edges, self._rows, until_us,
                *scratch,
            )  # fmt: skip
        return self._closed[: window[N_ROWS]]

    def feed_arrays(
        self,
        t: NDArray[Any],
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        p: NDArray[np.uint8],
        *,
        complete_until_us: int = NEVER,
    ) -> NDArray[Any]:
        """Sum events given as columns of any stride, t int64 or uint32; return the windows closed, as ``feed``."""
        window = self._window
        scratch = (self._bucket, *self._pending)
        window[N_ROWS] = 0
        position = self._arrays(
            t, x, y, p, 0, self._table, window, self._edges, self._rows, complete_until_us, *scratch
        )
        while window[PAUSED]:
            self._make_room()
            position = self._arrays(
                t, x, y, p, position, self._table, window, self._edges, self._rows, complete_until_us, *scratch
            )
        return self._closed[: window[N_ROWS]]

    def take_triggers(self) -> tuple[Trigger, ...]:
        """Return the trigger edges met in words since the last call."""
        return take_triggers(self._state, self._triggers)

    @property
    def counters(self) -> dict[str, int]:
        """What was met that is in no window, and what was odd.

        ``late`` events went to the open window after theirs had closed; ``early`` came before the first edge;
        ``outside`` lie outside the region, ``out_of_sensor`` (of them) outside the sensor; the rest as in
        ``elpd.events.registers.COUNTERS``.
        """
        window = self._window
        odd = counters(self._state)
        del odd["x_out_of_range"], odd["y_out_of_range"]
        return {
            "late": int(window[LATE]),
            "early": int(window[EARLY]),
            "outside": int(window[OUTSIDE]),
            "out_of_sensor": int(window[OUT_OF_SENSOR]),
            **odd,
        }

    @property
    def rate_controller(self) -> tuple[int, int] | None:
        """Events before and after the camera's rate controller so far; ``None`` if the stream never said."""
        return rate_controller(self._state)

    def _make_room(self) -> None:
        """Answer a kernel's pause: more rows, or more edges."""
        if self._window[N_ROWS] == self._rows.shape[0]:
            self._rows = np.concatenate((self._rows, np.empty_like(self._rows)))
            self._closed = self._rows.view(ROW_DTYPE).reshape(-1)
            return
        step = self._window_us
        assert step is not None, "open-ended windows pause for rows only"
        now = int(self._window[NOW])
        n_edges = int(self._window[N_EDGES])
        if n_edges == 0:
            first = now // step * step
        else:
            first = int(self._edges[n_edges - 1]) + step
            if now - first > MAX_EMPTY_WINDOWS * step:
                first += (now - first) // step * step
        self._append(first + step * np.arange(EDGES_AHEAD, dtype=np.int64))

    def _append(self, edges: NDArray[np.int64]) -> None:
        """Append edges, forgetting those whose windows are closed."""
        done = max(int(self._window[CURSOR]), 0)
        kept = self._edges[done : int(self._window[N_EDGES])]
        self._edges = np.concatenate((kept, edges))
        self._window[CURSOR] -= done
        self._window[N_EDGES] = self._edges.shape[0]
