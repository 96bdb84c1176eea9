"""How a controller's reports are to be read: when each was sampled, and how far it may be from where the motor was.

A report is an interval, not a point; within it the sampling lies where replies have been seen to be sampled
(``reply_time``), unless it took so long that something has held it up. Its number is rounded, and rounding errors
average away only as far as they differ from one report to the next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.motion.reply_time import ReplyTime
from elpd.units import NS_PER_S

if TYPE_CHECKING:
    from elpd.motion.epoch import Epoch
    from elpd.records import LensReport


@dataclass(frozen=True, slots=True)
class Timing:
    """How well a controller's times are known, all one standard deviation.

    ``reply_ns`` is the usual time from the earliest possible instant of sampling to the actual one, and
    ``reply_sigma_ns`` how well that is known for one reply; which part of it all commands and reports share, so that
    they cannot average it away, is learnt (``reply_time``). ``quantum_steps`` is the resolution of a report in
    motion, ``rest_quantum_steps`` at rest (0 for a controller that counts whole steps and rests on one).
    ``ramp_steps`` is how far firmware's ramps stray from the model's while the speed changes. A reply that took longer
    than ``prompt_ns`` was held up, nobody knows on which side of its sampling.
    ``pace_sigma`` is by which share a motion may run faster or slower than it was told.
    """

    reply_ns: int
    reply_sigma_ns: int
    quantum_steps: float
    rest_quantum_steps: float = 0.0
    ramp_steps: float = 0.0
    prompt_ns: int = 10_000_000
    pace_sigma: float = 0.0


class Readings:
    """Reads the reports of one controller.

    Parameters
    ----------
    timing
        How they are to be trusted.
    """

    def __init__(self, timing: Timing) -> None:
        self.timing = timing
        self.reply = ReplyTime(timing.reply_ns, timing.reply_sigma_ns)
        self.held_ns = 0
        """How long the line is known to keep replies back, after they were sampled as promptly as ever."""

    def held_up(self, report: LensReport) -> bool:
        """Say whether nobody knows on which side of its sampling a reply was held up."""
        return report.latest_ns - report.earliest_ns > self.timing.prompt_ns + self.held_ns

    def sampled(self, report: LensReport) -> tuple[int, float]:
        """Return when a report was most likely sampled, in ns, and the standard deviation of that in seconds."""
        width = max(0, report.latest_ns - report.earliest_ns)
        if self.held_up(report):
            return report.earliest_ns + width // 2, width / math.sqrt(12) / NS_PER_S
        late = min(self.reply.usual_ns, width // 2)
        return report.earliest_ns + late, min(self.reply.chance_s, width / math.sqrt(12) / NS_PER_S)

    def variance(self, velocity_sps: float, sigma_s: float) -> float:
        """Return the variance of a report's number at a speed, its time known to *sigma_s*; steps squared."""
        quantum = self.timing.quantum_steps if velocity_sps else self.timing.rest_quantum_steps
        return quantum * quantum / 12 + (velocity_sps * sigma_s) ** 2

    def rounding_variance(self, epoch: Epoch, velocity_sps: float) -> float:
        """Return what no number of an epoch's reports averages away of their rounding, steps squared.

        Asked at regular intervals, a motor at some speeds is told with the same rounding error each time; and one that
        was stopped on its way, with the last one for ever. Marks are not rounded, and targets are known.
        """
        if velocity_sps:
            return 0.0 if epoch.marked else self.timing.quantum_steps**2 / 12 * epoch.alike
        stopped = epoch.motion.target_steps is None and epoch.number
        return self.timing.rest_quantum_steps**2 / 12 if stopped else 0.0
