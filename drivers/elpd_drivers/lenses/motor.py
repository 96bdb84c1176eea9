"""What a driver knows of its motor: where it is, whether that means anything, and when it must be at rest.

The trajectory says where; here stands what makes it trustworthy. A report is believed only if it is possible, the
impossible is a fault when it is confirmed, and what should be at rest by now and is not has ignored a stop.
"""

from __future__ import annotations

import math
import threading
from typing import TYPE_CHECKING

from elpd.motion.trajectory import Trajectory
from elpd.records import LensFlag, LensReport
from elpd.units import NS_PER_MS, HostNs
from elpd_drivers.lenses.line import Trouble

if TYPE_CHECKING:
    from elpd.motion.commanded import Motion
    from elpd.motion.readings import Timing
    from elpd.records import PositionEstimate

CONFIRMATIONS = 3
"""How often in a row an impossible position must be reported to be a fault instead of a bad reply."""


MARK_SHARE = 0.25
"""A mark further from a multiple of its distance than this share of it might as well belong to the next one."""

RESUMES = 8
"""How often one command may be held up: a controller, or what lies between, that stands still for a moment."""


class Motor:
    """A trajectory, guarded by a lock, and the books around it.

    Parameters
    ----------
    timing
        How the controller's reports are to be trusted.
    slack_steps
        How far a report may lie from the model beyond eight standard deviations.
    grace_ms
        How long after its planned end a motion may still be reported under way.
    floor_steps
        Standard deviation that no estimate goes below.
    """

    def __init__(
        self, timing: Timing, *, slack_steps: float = 16.0, grace_ms: float = 50.0, floor_steps: float = 0.15
    ) -> None:
        self.referenced = False
        self.rest_due_ns: int | None = None
        self.rest_from_ns = 0
        self.look_ns: int | None = None
        """When to look whether the motion has ended, ``None`` if nobody waits for that."""
        self.report: LensReport | None = None
        self.newest_command = 0
        self.stops = 0
        self.stops_ignored = 0
        self.runs_on = False
        """Whether it was seen to run where a stop should have brought it to rest: more than a stop is needed."""
        self.written_ns = 0
        """How long the host took to write what is in force: a busy machine may have held it up before it left."""
        self._grace_ns = round(grace_ms * NS_PER_MS)
        self._slack_steps = slack_steps
        self._trajectory = Trajectory(timing, floor_steps=floor_steps)
        self._lock = threading.Lock()
        self._implausible = self._resumed = 0
        self._stopping = False

    # --- where it is -----------------------------------------------------------------------------------------------

    @property
    def known(self) -> bool:
        """Whether there has been a report to begin from."""
        return self._trajectory.known

    def position_at(self, when: HostNs) -> PositionEstimate:
        """Return position and standard deviation at *when*. Raises ``LensError`` if unknown."""
        with self._lock:
            return self._trajectory.position_at(when)

    def state_at(self, when: int) -> tuple[float, float]:
        """Return modelled position (steps) and velocity (steps/s) at *when*. Raises ``LensError`` if unknown."""
        with self._lock:
            host = HostNs(when)
            return self._trajectory.position_at(host).steps, self._trajectory.velocity_at(host)

    @property
    def planned_rest_ns(self) -> int | None:
        """When the motion commanded last ends, or None if it does not by itself."""
        with self._lock:
            return self._trajectory.at_rest_from()

    @property
    def under_way(self) -> bool:
        """Whether a motion was commanded whose end was not seen yet, or the newest report says so."""
        return self.rest_due_ns is not None or (self.report is not None and self.report.moving)

    @property
    def may_move(self) -> bool:
        """Whether it was not seen at rest since its last motion should have ended."""
        report = self.report
        return report is None or report.moving or (self.under_way and report.earliest_ns < self.rest_from_ns)

    # --- what it was told ------------------------------------------------------------------------------------------

    def command(self, motion: Motion, effective_ns: int, sigma_ns: float, *, grace_ms: float | None = None) -> int:
        """Note a command that takes effect at *effective_ns*; return the number to amend it by."""
        with self._lock:
            self.newest_command = self._trajectory.command(motion, effective_ns, sigma_ns)
            self._resumed = 0
            self._stopping = motion.target_steps is None and not motion.velocity_sps
            self._expect_rest(effective_ns, sigma_ns, grace_ms)
            return self.newest_command

    def amend(self, number: int, effective_ns: int, sigma_ns: float, *, still_ending: bool = True) -> None:
        """Learn when command *number* truly took effect, and with it (if *still_ending*) when it is over."""
        with self._lock:
            self._trajectory.amend(number, effective_ns, sigma_ns)
            if still_ending:
                self._expect_rest(effective_ns, sigma_ns, None)

    def _expect_rest(self, effective_ns: int, sigma_ns: float, grace_ms: float | None) -> None:
        """Note when the motion ends by the model, when to look whether it has, and when it must have."""
        grace_ns = self._grace_ns if grace_ms is None else round(grace_ms * NS_PER_MS)
        self.rest_from_ns = max(self._trajectory.at_rest_from() or effective_ns, effective_ns)
        self.look_ns = self.rest_from_ns + round(3 * sigma_ns)
        self.rest_due_ns = self.rest_from_ns + grace_ns

    # --- what it reports -------------------------------------------------------------------------------------------

    def mark(self, every_steps: int, when: HostNs) -> bool:
        """Learn that the count came to a multiple of *every_steps* at *when*, the rotor a step behind it.

        Says whether it is believed: only one multiple may be near enough to where the model has the motor.
        """
        with self._lock:
            if not self._trajectory.known:
                return False
            velocity = self._trajectory.velocity_at(when)
            behind = math.copysign(1.0, velocity) if velocity else 0.0
            count = self._trajectory.position_at(when).steps + behind
            nearest = round(count / every_steps) * every_steps
            if abs(count - nearest) > MARK_SHARE * every_steps:
                return False
            self._trajectory.mark(nearest - behind, when)
            return True

    def replies_are_held(self, held_ns: int) -> None:
        """Learn how long the line keeps replies back: so much of a report's interval says nothing of its sampling."""
        with self._lock:
            self._trajectory.replies_are_held(held_ns)

    def begin(self, report: LensReport) -> None:
        """Forget what was modelled and begin from *report*."""
        with self._lock:
            self._trajectory.begin(report)
            self._implausible = 0

    def believes(self, report: LensReport) -> bool:
        """Learn from a report and say so, or say that it cannot be true. Raises ``Trouble`` when that is confirmed.

        A motion that was held up on its way is confirmed too, but goes on from where it is.
        """
        with self._lock:
            if not self._trajectory.known:
                self._trajectory.begin(report)
                return True
            surprise = self._trajectory.expect(report)
            limit = 8 * surprise.sigma_steps + self._slack_steps
            if abs(surprise.steps) <= limit:
                self._implausible = 0
                self._trajectory.observe(report)
                return True
            confirmed = self._implausible + 1 >= CONFIRMATIONS and self._resumed < RESUMES
            if confirmed and self._trajectory.resume(report, self.written_ns):
                self._implausible, self._resumed = 0, self._resumed + 1
                self._expect_rest(report.latest_ns, 0.0, None)
                return True
        self._implausible += 1
        if self._implausible >= CONFIRMATIONS and self._stopping and report.moving:
            self.runs_on = True
            raise Trouble(
                f"the motor still runs after a stop, {surprise.steps:+.0f} steps from where it must rest (limit "
                f"{limit:.0f}); switch the controller off and on, look at its cable, then home it"
            )
        if self._implausible >= CONFIRMATIONS:
            raise Trouble(
                f"the controller reports a position {surprise.steps:+.0f} steps from where it must be "
                f"(limit {limit:.0f}), {self._implausible} times in a row; home it again"
            )
        return False

    def at_rest(self) -> None:
        """Note that the motion was seen to have ended."""
        self.rest_due_ns, self.stops_ignored = None, 0

    def overdue(self, report: LensReport) -> bool:
        """Say whether *report* moves when it should be at rest, and count how often that was so."""
        if self.rest_due_ns is None or not report.moving or report.earliest_ns < self.rest_due_ns:
            return False
        self.stops_ignored += 1
        return True

    def flagged(self, report: LensReport, more: LensFlag = LensFlag.NONE) -> LensReport:
        """Return *report* with what is known beside it."""
        flags = report.flags | more | (LensFlag.REFERENCED if self.referenced else LensFlag.POSITION_UNCERTAIN)
        return LensReport(report.steps, report.earliest_ns, report.latest_ns, report.velocity_sps, flags)
