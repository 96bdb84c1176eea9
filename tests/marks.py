"""How well a driver knows where its lens is while it sweeps, with an adapter whose latency nobody told it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from elpd_drivers.sim.rig import SimulatedTruth

from elpd.units import NS_PER_MS, HostNs

if TYPE_CHECKING:
    from elpd.ports import RigParts
    from elpd.records import FocusResult

CRUISE_SPS = 12_000.0
ADAPTER_NS = 400_000
"""How long the adapter takes to pass a command on, which nobody has told the driver."""


def worst_at_speed(parts: RigParts, result: FocusResult) -> float:
    """Return the largest error of the lens's own position, in steps, while it swept at its full speed."""
    assert isinstance(parts.truth, SimulatedTruth)
    motor = parts.truth.mechanism
    begun_ns = parts.clock.now_ns() - round(result.duration_ms * NS_PER_MS)
    names = [phase.name for phase in result.phases]
    ends_ms = np.cumsum([phase.ms for phase in result.phases])
    begin_ms, end_ms = ends_ms[names.index("sweep") - 1], ends_ms[names.index("sweep")]
    worst = 0.0
    for ms in range(int(begin_ms), int(end_ms)):
        when = HostNs(begun_ns + ms * NS_PER_MS)
        around = np.array([when - NS_PER_MS, when, when + NS_PER_MS])
        true = motor.motor_steps(around)
        if abs(true[2] - true[1]) > CRUISE_SPS / 1000 and abs(true[1] - true[0]) > CRUISE_SPS / 1000:
            worst = max(worst, abs(parts.lens.position_at(when).steps - float(true[1])))
    return worst
