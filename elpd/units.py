"""Time bases and lengths as types.

Three clocks and two rulers meet in a focus cycle, and every classic mistake of such software is a number of one of
them used as another. They are ``NewType``s, so that mypy tells them apart and they cost nothing at run time.
Converting between them is a named function in one place: clocks in ``elpd.timebase``, rulers in ``elpd.motion``.
"""

from typing import NewType

HostNs = NewType("HostNs", int)
"""Nanoseconds of the controlling host's monotonic clock."""

SensorUs = NewType("SensorUs", int)
"""Microseconds of the camera's own clock, unwrapped."""

Steps = NewType("Steps", int)
"""Microsteps of the lens motor, in the controller's own count."""

NS_PER_US = 1_000
NS_PER_MS = 1_000_000
NS_PER_S = 1_000_000_000
US_PER_S = 1_000_000


def after_ms(start: HostNs, ms: float) -> HostNs:
    """Return the instant *ms* milliseconds after *start*."""
    return HostNs(start + round(ms * NS_PER_MS))
