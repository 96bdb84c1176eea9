"""Clocks: the host's own, and the camera's as the host sees it.

A camera stamps events with its own microseconds; commands to the lens are stamped with the host's nanoseconds. What
ties them together is that a packet cannot arrive before its last event happened: over many packets the *smallest* delay
seen is the shortest path, every larger one is queueing. So the offset is tracked by its minimum (Klipper's clocksync
and NTP use the same idea), inside a sliding window so that slow drift is followed. The shortest path
itself cannot be seen from one side; it is a number of the camera (``Latency.min_latency_us``) or of a calibration.
"""

from __future__ import annotations

import time
from collections import deque

from elpd.units import NS_PER_US, HostNs, SensorUs


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
    """Sensor microseconds <-> host nanoseconds, by minimum-delay tracking.

    Parameters
    ----------
    min_latency_us
        Shortest delay between an event and the receipt of its packet, in us.
    window_ns
        How far back delays count. Crystals drift by some 10 ppm: over 2 s that is 20 us.

    """

    def __init__(self, min_latency_us: float = 0.0, window_ns: int = 2_000_000_000) -> None:
        self._min_latency_ns = round(min_latency_us * NS_PER_US)
        self._window_ns = window_ns
        self._minima: deque[tuple[int, int]] = deque()  # (received_ns, offset_ns), offsets increasing

    @property
    def known(self) -> bool:
        """Whether any packet has been seen."""
        return bool(self._minima)

    def saw(self, complete_until_us: SensorUs, received_ns: HostNs) -> None:
        """Take one packet's pair of stamps into account."""
        offset_ns = received_ns - complete_until_us * NS_PER_US
        while self._minima and self._minima[-1][1] >= offset_ns:
            self._minima.pop()
        self._minima.append((received_ns, offset_ns))
        while self._minima[0][0] < received_ns - self._window_ns:
            self._minima.popleft()

    def restart(self) -> None:
        """Forget everything: the camera's clock jumped or the camera was reopened."""
        self._minima.clear()

    def to_host(self, when: SensorUs) -> HostNs:
        """Return the host's instant of a sensor stamp."""
        return HostNs(when * NS_PER_US + self._offset_ns())

    def to_sensor(self, when: HostNs) -> SensorUs:
        """Return the sensor's stamp of a host instant, rounded down."""
        return SensorUs((when - self._offset_ns()) // NS_PER_US)

    def _offset_ns(self) -> int:
        if not self._minima:
            raise ValueError("the sensor's clock is not known before its first packet")
        return self._minima[0][1] - self._min_latency_ns
