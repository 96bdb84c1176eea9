"""Where the motor was at any instant: commanded motion, corrected by what the controller reported.

A position that was read back is old by its own wire time, and at 4 mm/s a tenth of a millisecond is 0.4 um. So no
report is ever used as "the position now". A driver tells this model what it commanded and when the bytes left, and the
model lays the motion out as exact pieces of constant acceleration. What is not known are three numbers per command
(``lessons``): how late it took effect, how far the motor was from where the model had it, and how much faster it runs
than it was told. Every report that arrives corrects the three by a Kalman step, in the epoch of the command that was in
force when it was *sampled*, however late it is; all later epochs are then laid out again. Past positions therefore get
better with time, which is what a focus cycle needs: it looks up the instant of the crossing some milliseconds after it.

The first two sensitivities are not derived by hand for each kind of motion: each epoch is laid out three times, as it
is, begun a little later, and begun a little further. That covers ramps, reversals, absolute targets (whose end does not
depend on either) and firmware that steps its speed in segments, with one formula. Where a command turns out to have
taken effect much earlier or later than supposed (a stop behind a segment buffer), the epoch is laid out anew around the
better value and its reports are gone through again: a Gauss-Newton step.

What it refuses to do: guess before the first report, or beyond its memory. It holds no clock, no port and no thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.errors import LensError
from elpd.motion.commanded import REST, Motion
from elpd.motion.epoch import FURTHER_STEPS, Epoch
from elpd.motion.kinematics import Knot, lay_out, state_at
from elpd.motion.readings import Readings
from elpd.records import LensFlag, LensReport, PositionEstimate
from elpd.units import NS_PER_S, HostNs

if TYPE_CHECKING:
    from elpd.motion.lessons import Sensitivity
    from elpd.motion.readings import Timing


_MAX_REPORTS = 256
_RELAY_S = 2e-4
_RELAYS = 4
MARK_NS = 2_000
"""A mark's edge leaves with the step, and a camera stamps it to the microsecond."""
PLACES = 64
"""Of so many of a motion's newest reports it is seen whether they were rounded alike."""
SCATTER_FROM = 3
"""After so many reports of a motion the next one's surprise tells of its time."""
_CLEARLY = 1.0
"""By so many standard deviations one motion must explain a report better than another to be taken for it."""
_UNLIKELY = 3.0
"""Standard deviations beyond which a report at rest shows that the model's own are too small."""
HELD_UP_NS = 100_000_000
"""How late or early a motion may be on its way and still be the one commanded.

Late, when the controller stood still for a moment; early, when its acknowledgement, by which the motion's beginning was
dated, lay in an adapter. Whatever holds it or the line up for longer is a fault already: it has answered nothing for
longer than any driver's silence limit. A position from further along is one that it was not sent to at that time.
"""


@dataclass(frozen=True, slots=True)
class Surprise:
    """How far a report lay from what the model expected, and the expected standard deviation of that, in steps."""

    steps: float
    sigma_steps: float


class Trajectory:
    """The motor's position as a function of time.

    Parameters
    ----------
    timing
        How the controller's reports are to be trusted.
    floor_steps
        Standard deviation that no estimate goes below: what the model leaves out (step shape, rounding).
    history_s
        How far back positions can be asked for.
    """

    def __init__(self, timing: Timing, *, floor_steps: float = 0.15, history_s: float = 20.0) -> None:
        self._readings = Readings(timing)
        self._floor_variance = floor_steps * floor_steps
        self._history_ns = round(history_s * NS_PER_S)
        self._epochs: list[Epoch] = []
        self._commands = 0

    def replies_are_held(self, held_ns: int) -> None:
        """Learn how long the line keeps replies back, after they were sampled as promptly as ever."""
        self._readings.held_ns = held_ns

    @property
    def known(self) -> bool:
        """Whether there has been a report to begin from."""
        return bool(self._epochs)

    def begin(self, report: LensReport) -> None:
        """Forget everything and begin from *report*: at rest, or at the velocity that it tells."""
        velocity = report.velocity_sps or 0.0
        when, _ = self._readings.sampled(report)
        epoch = Epoch(when, when, Motion(math.inf, velocity), 0.0)
        epoch.steps, epoch.variance = report.steps, self._readings.variance(velocity, 0.0)
        epoch.path = lay_out(when, report.steps, epoch.motion.pieces(report.steps, velocity))
        epoch.further = lay_out(when, report.steps + FURTHER_STEPS, epoch.motion.pieces(report.steps, velocity))
        epoch.forget_lessons(self._readings.timing.pace_sigma)
        self._epochs = [epoch]

    def command(self, motion: Motion, effective_ns: int, sigma_ns: float) -> int:
        """Note that *motion* takes over at *effective_ns*, give or take *sigma_ns*; return a number to amend it by.

        Commands that were to take effect later than this one are superseded. Does nothing before the first report.
        """
        self._commands += 1
        if not self._epochs:
            return self._commands
        while len(self._epochs) > 1 and self._epochs[-1].start_ns >= effective_ns:
            self._epochs.pop()
        start = max(effective_ns, self._epochs[-1].start_ns)
        self._epochs.append(Epoch(start, start, motion, sigma_ns / NS_PER_S, self._commands))
        self._follow(len(self._epochs) - 1)
        self._forget(start - self._history_ns)
        return self._commands

    def amend(self, number: int, effective_ns: int, sigma_ns: float) -> None:
        """Learn when command *number* truly took effect (its acknowledgement came). Unknown numbers are ignored."""
        for index in range(1, len(self._epochs)):
            epoch = self._epochs[index]
            if epoch.number == number:
                epoch.nominal_ns, epoch.delay_sigma_s = effective_ns, sigma_ns / NS_PER_S
                self._start_at(index, effective_ns)
                self._follow_from(index)
                return

    def expect(self, report: LensReport) -> Surprise:
        """Say how far *report* is from the model, without learning from it. Raises ``LensError`` before ``begin``."""
        when, sigma_s = self._readings.sampled(report)
        index = self._index(when)
        epoch = self._epochs[index]
        steps, velocity, h = epoch.depends(when)
        reading = self._readings.variance(self._fastest(report, velocity), sigma_s)
        variance = self._variance(epoch, velocity, h) + self._early_variance(index, when, velocity) + reading
        return Surprise(report.steps - steps, math.sqrt(variance))

    def observe(self, report: LensReport) -> None:
        """Learn from *report*, in the epoch in which it was sampled. Begins from it if it is the first."""
        if not self._epochs:
            self.begin(report)
            return
        width_ns = report.latest_ns - report.earliest_ns
        if width_ns > 2 * MARK_NS and self._readings.reply.took(width_ns):
            self._follow_from(1)
        when, _ = self._readings.sampled(report)
        index = self._index(when)
        if self._not_begun(index, report):
            self._postpone(index, when)
            index -= 1
        epoch = self._epochs[index]
        if epoch.hears_nothing_new(report, when):
            return
        if epoch.marked and report.moving and width_ns > 2 * MARK_NS:
            return  # its latency, which all reports share, would outvote the marks
        if not report.moving and self._rests_elsewhere(epoch, report, when):
            self._epochs.insert(index + 1, Epoch(when, when, REST, 0.0, epoch.number, (report.steps, 0.0)))
            self._follow_from(index + 1)
            return
        if len(epoch.reports) == _MAX_REPORTS:
            del epoch.reports[: _MAX_REPORTS // 2]
        epoch.reports.append(report)
        self._learn_scatter(index, report)
        self._correct(index, report)
        if report.moving and self._readings.timing.quantum_steps and not epoch.marked:
            times_ns = [self._readings.sampled(one)[0] for one in epoch.reports[-PLACES:]]
            even = [at for at in times_ns if not epoch.motion.changing_speed(state_at(epoch.path, at)[1])]
            epoch.note_places(even, self._readings.timing.quantum_steps)
        if self._relay(index):
            self._follow_from(index)
        elif index + 1 < len(self._epochs):
            self._follow_from(index + 1)

    def mark(self, steps: float, when_ns: int) -> None:
        """Learn that the motor was at *steps* at *when_ns*, to a microsecond: a mark beside which no latency counts."""
        index = self._index(when_ns)
        epoch = self._epochs[index]
        if not epoch.marked:
            epoch.marked, epoch.reports = True, []
            self._follow_from(index)
        half = min(MARK_NS, self._readings.timing.reply_ns)
        self.observe(LensReport(steps, HostNs(when_ns - half), HostNs(when_ns + half), None, LensFlag.MOVING))

    def resume(self, report: LensReport, written_ns: int = 0) -> bool:
        """Let the motion under way go on from where *report* has it, if it is only early or late on its way.

        That is a motor that is where the model had it up to ``HELD_UP_NS`` (and the *written_ns* that the host took to
        write its command) ago, or will have it ``HELD_UP_NS`` from now, under this command or, for a stop that bit
        late, one before. Anything else is not believed: returns False, and nothing has changed.
        """
        when, _ = self._readings.sampled(report)
        held_up_ns = HELD_UP_NS + written_ns
        index = self._index(when)
        present = self._epochs[index]
        if when <= present.start_ns or present.number == 0:
            return False
        superseded_ns = when
        for epoch in reversed(self._epochs[: index + 1]):
            if superseded_ns < when - held_up_ns:
                break
            superseded_ns = epoch.start_ns
            velocity = epoch.passed(report.steps, when + HELD_UP_NS, HELD_UP_NS + held_up_ns)
            if velocity is not None:
                anchor = (report.steps, velocity if report.moving else 0.0)
                self._epochs.insert(index + 1, Epoch(when, when, present.motion, 0.0, present.number, anchor))
                self._follow_from(index + 1)
                return True
        return False

    def position_at(self, when: HostNs) -> PositionEstimate:
        """Return position and one standard deviation at *when*, past or (as commanded) future.

        Raises ``LensError`` before the first report and beyond the history.
        """
        when, index, steps, velocity, h = self._state(when)
        variance = self._variance(self._epochs[index], velocity, h) + self._early_variance(index, when, velocity)
        return PositionEstimate(steps, math.sqrt(variance))

    def velocity_at(self, when: HostNs) -> float:
        """Return the modelled velocity in steps/s at *when*."""
        return self._state(when)[3]

    def at_rest_from(self) -> int | None:
        """Return when the motion commanded last ends, in ns, or None if it does not end by itself."""
        if not self._epochs:
            return None
        last = self._epochs[-1].path[-1]
        return None if last.velocity_sps or last.acceleration_sps2 else last.begin_ns

    # --- below: how it is done -----------------------------------------------------------------------------------

    def _not_begun(self, index: int, report: LensReport) -> bool:
        """Say whether *report* still tells of the motion before epoch *index*, which should be over by now.

        It says no more than that: when the command will take effect remains as unknown as it was, but for the past.
        """
        epoch, before = self._epochs[index], self._epochs[index - 1]
        if (
            index == 0
            or epoch.reports
            or epoch.anchor is not None
            or not epoch.delay_sigma_s
            or self._readings.held_up(report)
        ):
            return False
        when, sigma_s = self._readings.sampled(report)
        if when - epoch.nominal_ns > _UNLIKELY * epoch.delay_sigma_s * NS_PER_S:
            return False
        steps, velocity, h = before.depends(when)
        variance = self._variance(before, velocity, h) + self._readings.variance(velocity, sigma_s)
        off, off_if_begun = report.steps - steps, report.steps - epoch.depends(when)[0]
        return off * off < _UNLIKELY**2 * variance and off_if_begun**2 - off * off > _CLEARLY**2 * variance

    def _postpone(self, index: int, when: int) -> None:
        """Let epoch *index* begin after *when*."""
        epoch = self._epochs[index]
        epoch.not_before_ns = when
        later_s, _ = epoch.begins()
        self._start_at(index, max(when, epoch.nominal_ns + round(later_s * NS_PER_S)))
        self._follow_from(index)

    def _rests_elsewhere(self, epoch: Epoch, report: LensReport, when: int) -> bool:
        """Say whether a motor at rest, by itself and by the model, is not where a model too sure of itself has it.

        At rest the controller's own count is exact, whatever was supposed of the way there.
        """
        if state_at(epoch.path, when)[1] != 0.0:
            return False
        surprise = self.expect(report)
        return abs(surprise.steps) > _UNLIKELY * surprise.sigma_steps

    def _state(self, when: HostNs) -> tuple[HostNs, int, float, float, Sensitivity]:
        if not self._epochs:
            raise LensError("lens: position asked for before the controller reported any; poll it first")
        oldest = self._epochs[0]
        if when < oldest.start_ns:
            if oldest.start_ns - when > self._history_ns or oldest.path[0].velocity_sps:
                raise LensError(
                    f"lens: position asked for {(oldest.start_ns - when) / 1e6:.1f} ms before the oldest that is "
                    f"remembered (history {self._history_ns / NS_PER_S:.0f} s); ask sooner"
                )
            when = HostNs(oldest.start_ns)  # the first report found it at rest
        index = self._index(when)
        return (when, index, *self._epochs[index].depends(when))

    def _index(self, when: int) -> int:
        for index in range(len(self._epochs) - 1, 0, -1):
            if self._epochs[index].start_ns <= when:
                return index
        return 0

    def _fastest(self, report: LensReport, velocity: float) -> float:
        """Return the velocity that a reply's time is uncertain at: a stop may lie inside a wide interval."""
        if not self._readings.held_up(report):
            return velocity
        ends = (report.earliest_ns, report.latest_ns)
        return max(velocity, *(state_at(self._epochs[self._index(end)].path, end)[1] for end in ends), key=abs)

    def _follow_from(self, index: int) -> None:
        for later in range(max(index, 1), len(self._epochs)):
            self._follow(later)
            for _ in range(_RELAYS):
                if not self._relay(later):
                    break
                self._follow(later)

    def _follow(self, index: int) -> None:
        """Lay epoch *index* out from the state in which its predecessor leaves the motor; go through its reports."""
        before, epoch = self._epochs[index - 1], self._epochs[index]
        start, motion = epoch.start_ns, epoch.motion
        steps, velocity, h = before.depends(start)
        epoch.steps, epoch.variance = steps, before.lessons.variance(h) + motion.rounding_steps**2
        if epoch.anchor is not None:
            steps, velocity = epoch.anchor
            epoch.steps, epoch.variance = (
                steps,
                self._readings.variance(velocity, self._readings.reply.chance_s),
            )
        epoch.path = lay_out(start, steps, motion.pieces(steps, velocity))
        further = steps + FURTHER_STEPS
        epoch.further = lay_out(start, further, motion.pieces(further, velocity))
        epoch.later_s = min(epoch.delay_sigma_s, _RELAY_S)
        if epoch.later_s:
            late = start + round(epoch.later_s * NS_PER_S)
            late_steps, late_velocity, _ = before.depends(late)
            epoch.later = [Knot(start, steps, velocity, 0.0)]
            epoch.later += lay_out(late, late_steps, motion.pieces(late_steps, late_velocity))
        epoch.forget_lessons(self._readings.timing.pace_sigma)
        for report in epoch.reports:
            self._correct(index, report)

    def _relay(self, index: int) -> bool:
        """Move an epoch's start to where its delay says, if that is far; say whether it moved."""
        epoch = self._epochs[index]
        shift = round(epoch.lessons.delay * NS_PER_S)
        if index == 0 or abs(epoch.lessons.delay) < _RELAY_S or not epoch.reports:
            return False
        moved = self._start_at(index, epoch.start_ns + shift)
        return abs(moved) > _RELAY_S * NS_PER_S / 2

    def _start_at(self, index: int, start_ns: int) -> int:
        """Begin epoch *index* at *start_ns*, between its neighbours; reports go to the epoch they were sampled in."""
        before, epoch = self._epochs[index - 1], self._epochs[index]
        start = max(start_ns, before.start_ns)
        if index + 1 < len(self._epochs):
            start = min(start, self._epochs[index + 1].start_ns)
        moved, epoch.start_ns = start - epoch.start_ns, start
        early = [report for report in epoch.reports if self._readings.sampled(report)[0] < start]
        late = [report for report in before.reports if self._readings.sampled(report)[0] >= start]
        if early or late:
            epoch.reports = late + [report for report in epoch.reports if report not in early]
            before.reports = [report for report in before.reports if report not in late] + early
            if index > 1:
                self._follow(index - 1)
        return moved

    def _correct(self, index: int, report: LensReport) -> None:
        epoch = self._epochs[index]
        when, sigma_s = self._readings.sampled(report)
        steps, velocity, h = epoch.depends(when)
        reading = self._readings.variance(self._fastest(report, velocity), sigma_s)
        noise = reading + self._model_variance(epoch, velocity) + self._early_variance(index, when, velocity)
        epoch.lessons.correct(report.steps - steps, h, noise)

    def _learn_scatter(self, index: int, report: LensReport) -> None:
        """Learn how replies scatter in time, where a motion's other numbers have been learnt."""
        epoch = self._epochs[index]
        when, _ = self._readings.sampled(report)
        steps, velocity, h = epoch.depends(when)
        if (
            self._readings.held_up(report)
            or epoch.marked
            or len(epoch.reports) <= SCATTER_FROM
            or epoch.motion.changing_speed(velocity)
        ):
            return
        others = epoch.lessons.variance(h) + self._model_variance(epoch, velocity)
        others += self._readings.variance(velocity, 0.0) + self._early_variance(index, when, velocity)
        self._readings.reply.scattered(report.steps - steps, velocity, others)

    def _variance(self, epoch: Epoch, velocity: float, h: Sensitivity) -> float:
        common = 0.0 if epoch.marked else velocity * self._readings.reply.common_s
        learnt = max(epoch.lessons.variance(h), self._readings.rounding_variance(epoch, velocity))
        return learnt + common * common + self._model_variance(epoch, velocity)

    def _early_variance(self, index: int, when: int, velocity: float) -> float:
        """Return what it adds that the command after epoch *index* may have begun before its time."""
        if index + 1 == len(self._epochs):
            return 0.0
        strays = self._epochs[index + 1].strays_if_begun_early(when, velocity)
        return strays * strays

    def _model_variance(self, epoch: Epoch, velocity: float) -> float:
        strays = self._readings.timing.ramp_steps if epoch.motion.changing_speed(velocity) else 0.0
        return self._floor_variance + strays * strays

    def _forget(self, before: int) -> None:
        while len(self._epochs) > 2 and self._epochs[1].start_ns < before:
            del self._epochs[0]
