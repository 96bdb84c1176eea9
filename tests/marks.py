"""How well a driver knows where its lens is while it sweeps, with an adapter whose latency nobody told it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from elpd_drivers.sim.rig import SimulatedTruth

from elpd.units import NS_PER_MS, HostNs

if TYPE_CHECKING:
    from elpd.ports import RigParts

CRUISE_SPS = 12_000.0
ADAPTER_NS = 400_000
"""How long the adapter takes to pass a command on, which nobody has told the driver."""


def worst_at_speed(parts: RigParts) -> float:
    """Return the largest error of the lens's own position, in steps, while it swept at its full speed."""
    assert isinstance(parts.truth, SimulatedTruth)
    motor, now = parts.truth.mechanism, parts.clock.now_ns()
    worst = 0.0
    for ms in range(30, 215):
        when = HostNs(now - ms * NS_PER_MS)
        around = np.array([when - NS_PER_MS, when, when + NS_PER_MS])
        true = motor.motor_steps(around)
        if abs(true[2] - true[1]) > CRUISE_SPS / 1000 and abs(true[1] - true[0]) > CRUISE_SPS / 1000:
            worst = max(worst, abs(parts.lens.position_at(when).steps - float(true[1])))
    return worst
