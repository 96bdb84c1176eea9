"""How old what the loop decides by is: each packet's way from the sensor to the host, and its wait there."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from elpd.units import HostNs

REMEMBERED = 512
"""Packets of a cycle, the newest."""

TO_HOST, TO_LOOP = "sensor to host", "host to loop"


class Delays:
    """The newest packets' delays, in us.

    The first counts from the end of what a packet holds to its receipt: the least latency that the camera is known by,
    and what the USB's batching adds to it. The second is its wait until the loop of a sweep had it.
    """

    def __init__(self) -> None:
        self._to_host: deque[float] = deque(maxlen=REMEMBERED)
        self._to_loop: deque[float] = deque(maxlen=REMEMBERED)

    def received(self, at: HostNs, received: HostNs) -> None:
        """Take a packet whose last instant was *at*, by the sensor's clock as it is known."""
        self._to_host.append(max(0.0, (received - at) / 1e3))

    def taken(self, received: HostNs, now: HostNs) -> None:
        """Take a packet that a sweep's loop has in hand."""
        self._to_loop.append(max(0.0, (now - received) / 1e3))

    def by_stage(self) -> Mapping[str, tuple[float, ...]]:
        """Return what there is, by the name of the stage."""
        kept = {TO_HOST: self._to_host, TO_LOOP: self._to_loop}
        return {name: tuple(values) for name, values in kept.items() if values}
