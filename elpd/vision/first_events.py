"""Latch when each pixel first brightened while an aperture opened over the scene.

Stage 1 of a focus cycle with an event-only camera: the sensor is dark, an aperture opens, and each pixel answers with
its first ON event at a time that depends on its brightness alone (EvTemMap, ECCV 2024, arXiv 2403.06443). Keeping one
time per pixel would be enough if sensors had no noise. They have: dark pixels fire ON events by leakage and shot noise
at 0.1 to 10 Hz each, so of a million pixels thousands have fired *before* the light reached their threshold.

The idea against that: keep the first three ON times of each pixel and believe the earliest one that its neighbourhood
supports. Light comes through a lens, whose point spread covers more than one pixel, so a pixel that truly sees light
is never alone: at least two of its eight neighbours fire before it, or about when it does. A noise event strikes one
pixel at a random time, mostly long before its neighbours. A pixel of which no time can be believed is hot (its
neighbours have fired together) or merely dark (they have not).

Latching is O(1) per event and the same however the stream is cut; memory is 14 bytes per pixel, whatever the length of
the recording. Nothing here knows transmittance or intensity: that is ``elpd.vision.temporal_map``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import UsageError
from elpd.events.bits import prefetch
from elpd.events.jit import kernel
from elpd.events.stream import PacketDecoder

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.events.registers import Integer
    from elpd.records import CameraPacket, Geometry

SLOTS = 3
"""ON times kept per pixel. At 5 Hz of noise, 100 ms of waiting exhausts them in 1.4 % of the pixels."""

EMPTY = np.int32(2**31 - 1)
"""No event yet. Larger than any time, so that comparisons treat it as "later than everything"."""

MAX_INTERVAL_US = int(EMPTY) - 1

SUPPORT = 2
"""Neighbours that must fire with or before a pixel. One would let pairs of noise events vouch for each other."""

TOLERANCE_SIGMA = 5.0
"""How much earlier than its supporters a pixel may be, in standard deviations of the jitter."""

MIN_JITTER = 0.002
"""A floor for simulations without mismatch. Low, because times count from the interval's begin, not the opening."""

NORMAL_QUARTILE = 0.3186
"""A quarter of normal deviates are smaller than this in magnitude."""

HOT_LIMIT = 8.0
"""A pixel is hot when it fired this many Poisson standard deviations more often than the median before the opening."""

# What became of a pixel: the slot that is believed, or why none is.
HOT = np.uint8(SLOTS)
UNFIRED = np.uint8(SLOTS + 1)

N_ON, N_BEFORE, N_AFTER, N_OUTSIDE = range(4)

LISTED = 512
"""Events listed at a time."""


@kernel(
    'void(Array(int64, 1, "C", readonly=True), Array(uint16, 1, "C", readonly=True),'
    ' Array(uint16, 1, "C", readonly=True), Array(uint8, 1, "C", readonly=True), int64, int64, int64, int64,'
    " int32[:, ::1], uint16[::1], int64[::1], int64[:, ::1])"
)
def latch_first_on(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    begin_us: int,
    end_us: int,
    width: int,
    height: int,
    slots: NDArray[np.int32],
    before: NDArray[np.uint16],
    tally: NDArray[np.int64],
    listed: NDArray[np.int64],
) -> None:
    """Add events to *slots* (3, height*width) and count the ON events *before* the interval, saturating.

    In two steps over some events: those that count are listed (pixel and time in the rows of *listed*) without a branch
    on their polarity, which nobody can predict, and their pixels asked for, which no near cache holds; then latched.
    """
    n_on = n_before = n_after = 0
    n_outside: Integer = 0
    room = listed.shape[1]
    begun = 0
    while begun < t_us.size:
        until = min(begun + room, t_us.size)
        n: Integer = 0
        for i in range(begun, until):
            is_on = np.int64(on[i] == 1)
            inside = np.int64(x[i] < width) & np.int64(y[i] < height)
            k = np.int64(y[i]) * width + np.int64(x[i])
            listed[0, n], listed[1, n] = k, t_us[i]
            prefetch(slots, k)
            n += is_on & inside
            n_outside += is_on & ~inside & 1
        begun = until
        for i in range(n):
            k, t = listed[0, i], listed[1, i]
            if t < begin_us:
                n_before += 1
                if before[k] < 65535:
                    before[k] += np.uint16(1)
            elif t >= end_us:
                n_after += 1
            else:
                n_on += 1
                time = np.int32(t - begin_us)
                if slots[0, k] == EMPTY:
                    slots[0, k] = time
                elif slots[1, k] == EMPTY:
                    slots[1, k] = time
                elif slots[2, k] == EMPTY:
                    slots[2, k] = time
    tally[N_ON] += n_on
    tally[N_BEFORE] += n_before
    tally[N_AFTER] += n_after
    tally[N_OUTSIDE] += n_outside


@kernel()
def sort_few(values: NDArray[np.int32], count: int) -> None:
    """Sort the first *count* values in place, by insertion."""
    for i in range(1, count):
        value = values[i]
        j = i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value


@kernel("int64(int32[:, ::1], uint8[:, ::1], int32[:, ::1], uint8[:, ::1], int32[:, :, ::1], float64)", allocates=True)
def believe(
    times: NDArray[np.int32],
    choice: NDArray[np.uint8],
    new_times: NDArray[np.int32],
    new_choice: NDArray[np.uint8],
    slots: NDArray[np.int32],
    jitter: float,
) -> int:
    """Move each pixel whose *choice* its neighbours contradict to its next slot; return how many moved.

    One Jacobi pass: everything is judged by *times* as they stood, so the order of pixels does not matter.
    A time stands when ``SUPPORT`` neighbours fired earlier or at most a tolerance later, and as many later or at most
    a tolerance earlier. The tolerance is ``TOLERANCE_SIGMA * jitter`` times the neighbours' median time. Too early,
    with no better slot: hot. Too late: the light's event was missed, which counts as unfired, and so does a pixel with
    at most ``SUPPORT`` fired neighbours, alone in the dark.
    """
    height, width = times.shape
    near = np.empty(8, np.int32)
    moved = 0
    for row in range(height):
        for column in range(width):
            slot = choice[row, column]
            own = times[row, column]
            new_times[row, column] = own
            new_choice[row, column] = slot
            if slot >= HOT:
                continue
            margin = TOLERANCE_SIGMA * jitter * own
            fired = silent = early = late = 0
            for r in range(max(row - 1, 0), min(row + 2, height)):
                for c in range(max(column - 1, 0), min(column + 2, width)):
                    if r == row and c == column:
                        continue
                    value = times[r, c]
                    if value == EMPTY:
                        silent += 1
                        continue
                    early += value <= own + margin
                    late += value >= own - margin
                    near[fired] = value
                    fired += 1
            late += silent
            limit = np.float64(EMPTY)
            verdict = UNFIRED
            if fired > SUPPORT:
                if early >= SUPPORT and late >= SUPPORT:
                    continue
                sort_few(near, fired)
                tolerance = TOLERANCE_SIGMA * jitter * near[fired // 2]
                too_early = near[SUPPORT - 1] > own + tolerance
                too_late = late < SUPPORT and near[fired - SUPPORT + silent] < own - tolerance
                if not too_early and not too_late:
                    continue
                limit = min(near[fired - 1] + tolerance, limit)
                if too_early:
                    verdict = HOT
            moved += 1
            following = slot + 1
            if following < HOT and slots[following, row, column] < limit:
                new_choice[row, column] = following
                new_times[row, column] = slots[following, row, column]
            else:
                new_choice[row, column] = verdict
                new_times[row, column] = EMPTY
    return moved


@dataclass(frozen=True, slots=True)
class FirstTimes:
    """The believed first ON times of one opening.

    ``times_us`` is (height, width) int32 relative to ``begin_us``, ``EMPTY`` where nothing is believed. ``hot`` marks
    pixels that fired too early for their neighbours, ``unfired`` those that did not fire, too late, or alone.
    ``fired_fraction`` counts every pixel with an ON event in the interval, believed or not; ``second_thoughts`` how
    many pixels had their first event taken for noise and a later one believed.
    """

    begin_us: int
    times_us: NDArray[np.int32]
    hot: NDArray[np.bool_]
    unfired: NDArray[np.bool_]
    fired_fraction: float
    second_thoughts: int


class FirstEventMap:
    """The first ON times of every pixel inside ``[begin_us, end_us)``, gathered packet by packet.

    Parameters
    ----------
    geometry
        The sensor's size in pixels. Events outside it are counted (``n_outside``) and ignored.
    begin_us, end_us
        The interval on the sensor's clock. Without *begin_us* it starts at the first event seen; without *end_us* it
        lasts as long as events come, at most 35 minutes.

    Raises
    ------
    UsageError
        If the interval is empty or longer than 35 minutes.
    """

    def __init__(self, geometry: Geometry, begin_us: int | None = None, end_us: int | None = None) -> None:
        if begin_us is not None and end_us is not None and not 0 < end_us - begin_us <= MAX_INTERVAL_US:
            raise UsageError(
                f"an aperture opening of {end_us - begin_us} us cannot be mapped (limit 1 to {MAX_INTERVAL_US} us); "
                "give the interval's begin and end in microseconds of the sensor's clock"
            )
        self.geometry = geometry
        self._begin_us = begin_us
        self._end_us = end_us
        self._slots = np.full((SLOTS, geometry.height, geometry.width), EMPTY, np.int32)
        self._before = np.zeros((geometry.height, geometry.width), np.uint16)
        self._tally = np.zeros(4, np.int64)
        self._listed = np.empty((2, LISTED), np.int64)
        self._decoder: PacketDecoder | None = None
        self.first_us: int | None = None
        self.last_us: int | None = None

    @property
    def begin_us(self) -> int | None:
        """Where the interval begins; ``None`` until the first event if it was not given."""
        return self._begin_us

    @property
    def n_on(self) -> int:
        """ON events inside the interval."""
        return int(self._tally[N_ON])

    @property
    def n_before(self) -> int:
        """ON events before the interval: noise, by definition."""
        return int(self._tally[N_BEFORE])

    @property
    def n_outside(self) -> int:
        """Events with coordinates outside the sensor."""
        return int(self._tally[N_OUTSIDE])

    @property
    def complete(self) -> bool:
        """Whether events at or past the interval's end have come, so that nothing more can change."""
        return self._end_us is not None and self.last_us is not None and self.last_us >= self._end_us

    def add_packet(self, packet: CameraPacket) -> None:
        """Add a camera's packet, events or words.

        Words are decoded here, with the decoder's state carried from packet to packet: times are those of the stream
        since its first packet *here*. Who has a decoder of the stream already gives its arrays to ``add`` instead.
        """
        if self._decoder is None:
            self._decoder = PacketDecoder(self.geometry)
        events = self._decoder.feed(packet)
        self.add(events.t, events.x, events.y, events.p)

    def add(
        self,
        t_us: NDArray[Any],
        x: NDArray[Any],
        y: NDArray[Any],
        on: NDArray[Any],
    ) -> None:
        """Add events: equally long one-dimensional arrays of any integer type, *on* is 1 (or True) for ON.

        Arrays that are C-contiguous ``int64, uint16, uint16, uint8`` are not copied.
        """
        if t_us.size == 0:
            return
        t_us = np.ascontiguousarray(t_us, dtype=np.int64)
        if self.first_us is None:
            self.first_us = int(t_us[0])
        self.last_us = int(t_us[-1])
        if self._begin_us is None:
            self._begin_us = self.first_us
        end_us = self._begin_us + MAX_INTERVAL_US
        if self._end_us is not None:
            end_us = min(end_us, self._end_us)
        latch_first_on(
            t_us,
            np.ascontiguousarray(x, dtype=np.uint16),
            np.ascontiguousarray(y, dtype=np.uint16),
            np.ascontiguousarray(on, dtype=np.uint8),
            self._begin_us,
            end_us,
            self.geometry.width,
            self.geometry.height,
            self._slots.reshape(SLOTS, -1),
            self._before.reshape(-1),
            self._tally,
            self._listed,
        )

    def raw_times_us(self) -> NDArray[np.int32]:
        """Return the very first ON times, relative to ``begin_us``, noise included; ``EMPTY`` where unfired. A view."""
        first: NDArray[np.int32] = self._slots[0]
        return first

    def hot_before(self) -> NDArray[np.bool_]:
        """Mark pixels that fired far too often before the interval (closed aperture): (height, width).

        The limit is ``HOT_LIMIT`` Poisson standard deviations above the median count, and at least three events.
        """
        typical = float(np.median(self._before))
        limit = max(typical + HOT_LIMIT * np.sqrt(max(typical, self._before.mean())), 3.0)
        hot: NDArray[np.bool_] = self._before >= limit
        return hot

    def believed(self, passes: int = 4) -> FirstTimes:
        """Choose each pixel's first ON time that its neighbours support.

        Raises
        ------
        UsageError
            If no ON event came inside the interval.
        """
        if self._begin_us is None or self.n_on == 0:
            raise UsageError(
                "no ON event came while the aperture opened; "
                "check that the aperture moves, that light reaches the sensor, and the interval"
            )
        times = self._slots[0].copy()
        fired = times != EMPTY
        choice = np.where(fired, np.uint8(0), UNFIRED)
        hot = self.hot_before() & fired
        choice[hot] = HOT
        times[hot] = EMPTY
        new_times, new_choice = np.empty_like(times), np.empty_like(choice)
        jitter = relative_jitter(times)
        for _ in range(passes):
            moved = believe(times, choice, new_times, new_choice, self._slots, jitter)
            times, new_times = new_times, times
            choice, new_choice = new_choice, choice
            if moved == 0:
                break
        return FirstTimes(
            begin_us=self._begin_us,
            times_us=times,
            hot=choice == HOT,
            unfired=choice == UNFIRED,
            fired_fraction=float(fired.mean()),
            second_thoughts=int(((choice > 0) & (choice < HOT)).sum()),
        )


def relative_jitter(times_us: NDArray[np.int32]) -> float:
    """Return the standard deviation of a first-ON time around what its neighbours suggest, relative to that time.

    Relative, because threshold mismatch and photon noise both act on intensity, so that their effect in time grows
    with time. From the mixed second difference of every ninth 2x2 block, which slopes and straight edges do not
    touch; from its lower quartile, because with noise before the opening most blocks may hold a noise event.
    At least ``MIN_JITTER``.
    """
    corner, right, below, across = (
        times_us[row::3, column::3].astype(np.float32)[: (times_us.shape[0] - 1) // 3, : (times_us.shape[1] - 1) // 3]
        for row in (0, 1)
        for column in (0, 1)
    )
    latest = np.maximum(np.maximum(corner, right), np.maximum(below, across))
    fired = latest < EMPTY
    if fired.sum() < 8:
        return MIN_JITTER
    scatter = np.abs(corner - right - below + across)[fired] / 2
    middle = (corner + right + below + across)[fired] / 4
    return max(float(np.quantile(scatter / np.maximum(middle, 1.0), 0.25)) / NORMAL_QUARTILE, MIN_JITTER)
