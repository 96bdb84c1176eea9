"""Clocks: the host's own, and the camera's as the host sees it.

A camera stamps events with its own microseconds; commands to the lens are stamped with the host's nanoseconds. What
ties them together is that a packet cannot arrive before its last event happened: over many packets the *smallest* delay
seen is the shortest path, every larger one is queueing. So the offset is tracked by its minimum (Klipper's clocksync
and NTP use the same idea), and its drift by the line under the minima. The shortest path itself cannot be seen from
one side; it is a number of the camera (``Latency.min_latency_us``) or of a calibration.
"""

from __future__ import annotations

import time
from collections import deque
from itertools import pairwise
from typing import TYPE_CHECKING

from elpd.units import NS_PER_MS, NS_PER_US, HostNs, SensorUs

if TYPE_CHECKING:
    from collections.abc import Iterable


class MonotonicClock:
    """The host's CLOCK_MONOTONIC as an ``elpd.ports.Clock``."""

    def now_ns(self) -> HostNs:
        """Return the present instant."""
        return HostNs(time.monotonic_ns())

    def sleep_until(self, when: HostNs) -> None:
        """Sleep until *when*; return at once if it has passed."""
        remaining_ns = when - time.monotonic_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns / 1e9)


class SensorClock:
    """Sensor microseconds <-> host nanoseconds, by tracking the smallest delay.

    Delays count by intervals of 100 ms, each by its smallest. A straight line under all of them, the edge of their
    lower convex hull that spans the middle (Moon, Skelly and Towsley, INFOCOM 1999), is where a packet without any
    queueing would lie: its slope is the drift of the two crystals against each other, which over the seconds of a
    cycle is more than queueing leaves of the offset. What is too low for the line moves it at once; what is too high,
    and by more than a millisecond for a second, is a clock that stepped, and the past is forgotten.

    Parameters
    ----------
    min_latency_us
        Shortest delay between an event and the receipt of its packet, in us.
    window_ns
        How far back delays count.

    """

    def __init__(self, min_latency_us: float = 0.0, window_ns: int = 4_000_000_000) -> None:
        self._min_latency_ns = round(min_latency_us * NS_PER_US)
        self._window_us = window_ns // NS_PER_US
        self._lowest: deque[tuple[int, int]] = deque()  # (sensor us, offset ns) of each interval, oldest first
        self._interval_ends_us = 0
        self._newest_us = 0
        self._slope, self._drift_known = 0.0, False  # ns of offset per us
        self._reference_us = 0
        self._base_ns = 0
        self._late_ns: list[float] = []

    @property
    def known(self) -> bool:
        """Whether any packet has been seen."""
        return bool(self._lowest)

    @property
    def drift_ppm(self) -> float:
        """How much faster the host's clock runs than the sensor's; 0 until half a second has been seen."""
        return 1e3 * self._slope

    @property
    def bound_us(self) -> float:
        """How far ``to_host`` may be off, ``min_latency_us`` being right; infinite for the first three intervals.

        From how late the best packet of an interval usually is: the best of them all is less so.
        """
        late_ns = self._late_ns
        if len(late_ns) < FEWEST_INTERVALS:
            return float("inf")
        usual_ns = sorted(late_ns)[len(late_ns) // 2]
        span_us = self._newest_us - self._lowest[0][0]
        drifted_ns = 0.0 if self._drift_known else MOST_DRIFT * span_us
        lateness_ns = max(usual_ns, min(late_ns[-FEWEST_INTERVALS:]))
        return (RESOLUTION_NS + LATENESS_FACTOR * lateness_ns + drifted_ns) / NS_PER_US

    def saw(self, complete_until_us: SensorUs, received_ns: HostNs) -> None:
        """Take one packet's pair of stamps into account."""
        offset_ns = received_ns - complete_until_us * NS_PER_US
        if not self._lowest or complete_until_us < self._newest_us - STEP_NS // NS_PER_US:
            self._begin(complete_until_us, offset_ns)
            return
        self._newest_us = max(self._newest_us, complete_until_us)
        late_ns = offset_ns - self._line_ns(complete_until_us)
        if late_ns < -STEP_NS:
            self._begin(complete_until_us, offset_ns)
            return
        if complete_until_us >= self._interval_ends_us:
            self._lowest.append((complete_until_us, offset_ns))
            self._interval_ends_us = complete_until_us + INTERVAL_US
            self._fit()
            return
        at_us, lowest_ns = self._lowest[-1]
        if offset_ns - lowest_ns < self._slope * (complete_until_us - at_us):
            self._lowest[-1] = (complete_until_us, offset_ns)
        if late_ns < 0:
            self._base_ns += round(late_ns)

    def restart(self) -> None:
        """Forget everything: the camera's clock jumped or the camera was reopened."""
        self._lowest.clear()
        self._late_ns = []
        self._slope, self._drift_known = 0.0, False

    def to_host(self, when: SensorUs) -> HostNs:
        """Return the host's instant of a sensor stamp."""
        self._check()
        return HostNs(when * NS_PER_US + self._line_ns(when) - self._min_latency_ns)

    def to_sensor(self, when: HostNs) -> SensorUs:
        """Return the sensor's stamp of a host instant, rounded down."""
        self._check()
        about_us = (when - self._base_ns + self._min_latency_ns) // NS_PER_US
        return SensorUs((when - self._line_ns(about_us) + self._min_latency_ns) // NS_PER_US)

    def _line_ns(self, when_us: int) -> int:
        return self._base_ns + round(self._slope * (when_us - self._reference_us))

    def _check(self) -> None:
        if not self._lowest:
            raise ValueError("the sensor's clock is not known before its first packet")

    def _begin(self, at_us: int, offset_ns: int) -> None:
        """Start anew at a packet; the crystals' drift stays what it was."""
        self._lowest.clear()
        self._lowest.append((at_us, offset_ns))
        self._late_ns = []
        self._newest_us, self._interval_ends_us = at_us, at_us + INTERVAL_US
        self._reference_us, self._base_ns = at_us, offset_ns

    def _fit(self) -> None:
        """Lay the line under the intervals' smallest delays; the newest interval has only begun."""
        lowest = self._lowest
        while lowest[0][0] < self._newest_us - self._window_us:
            lowest.popleft()
        recent = [offset_ns - self._line_ns(at_us) for at_us, offset_ns in list(lowest)[-1 - STEP_INTERVALS : -1]]
        if len(recent) == STEP_INTERVALS and min(recent) > STEP_NS:
            while len(lowest) > STEP_INTERVALS + 1:
                lowest.popleft()
        reference_us, reference_ns = lowest[-1]
        if reference_us - lowest[0][0] >= DRIFT_SPAN_US:
            middle_us = (lowest[0][0] + reference_us) // 2
            self._slope = min(max(_slope_at(lowest, middle_us), -MOST_DRIFT), MOST_DRIFT)
            self._drift_known = True
        above = [offset_ns - reference_ns - self._slope * (at_us - reference_us) for at_us, offset_ns in lowest]
        self._reference_us, self._base_ns = reference_us, reference_ns + round(min(above))
        self._late_ns = [late_ns - min(above) for late_ns in above[:-1]]


INTERVAL_US = 100_000
FEWEST_INTERVALS = 3
DRIFT_SPAN_US = 500_000
"""Over less, what queueing leaves of a delay looks like a drift."""

MOST_DRIFT = 0.2
"""ns per us, 200 ppm: two crystals of 100 ppm each, the worst that are sold."""

STEP_NS = NS_PER_MS
STEP_INTERVALS = 10
"""A queue that lasts a second is not on a camera's way to its host: packets are stamped where they arrive."""

RESOLUTION_NS = NS_PER_US
LATENESS_FACTOR = 4
"""The line touches two intervals whose best packets were as late as any: at the end of a window of half a second that
is twice the error, and twice again for the tail; of simulated streams one instant in two thousand lies outside."""


def _slope_at(points: Iterable[tuple[int, int]], middle: int) -> float:
    """Return the slope of the lower convex hull's edge over *middle*; points are in order of their first coordinate."""
    hull: list[tuple[int, int]] = []
    for x, y in points:
        while len(hull) > 1 and (hull[-1][0] - hull[-2][0]) * (y - hull[-2][1]) <= (hull[-1][1] - hull[-2][1]) * (
            x - hull[-2][0]
        ):
            hull.pop()
        hull.append((x, y))
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 >= middle:
            return (y1 - y0) / (x1 - x0)
    return 0.0
