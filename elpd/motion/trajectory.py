"""Where the motor was at any instant: commanded motion, corrected by what the controller reported.

A position that was read back is old by its own wire time, and at 4 mm/s a tenth of a millisecond is 0.4 um. So no
report is ever used as "the position now". A driver tells this model what it commanded and when the bytes left, and
the model lays the motion out as exact pieces of constant acceleration. What is not known are two numbers per
command: how late it took effect (``delay``) and how far the motor was from where the model had it (``offset``).
Every report that arrives corrects the two by a Kalman step, in the epoch of the command that was in force when it was
*sampled*, however late it is; all later epochs are then laid out again. Past positions therefore get better with
time, which is what a focus cycle needs: it looks up the instant of the crossing some milliseconds after it.

The sensitivities are not derived by hand for each kind of motion: each epoch is laid out three times, as it is, begun
a little later, and begun a little further. That covers ramps, reversals, absolute targets (whose end does not depend
on either) and firmware that steps its speed in segments, with one formula.

What it refuses to do: guess before the first report, or beyond its memory. It holds no clock, no port and no thread.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from elpd.errors import LensError
from elpd.records import LensReport, PositionEstimate
from elpd.units import NS_PER_S, HostNs

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

# --- exact kinematics ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Piece:
    """A stretch of constant acceleration: how long, the speed it begins with, and the acceleration."""

    duration_s: float
    velocity_sps: float
    acceleration_sps2: float


@dataclass(frozen=True, slots=True)
class Knot:
    """Where a piece begins; it holds until the next knot, the last one for ever."""

    begin_ns: int
    steps: float
    velocity_sps: float
    acceleration_sps2: float

    def at(self, when_ns: int) -> tuple[float, float]:
        """Return position (steps) and velocity (steps/s) at *when_ns*."""
        dt = (when_ns - self.begin_ns) / NS_PER_S
        return (
            self.steps + dt * (self.velocity_sps + 0.5 * self.acceleration_sps2 * dt),
            self.velocity_sps + self.acceleration_sps2 * dt,
        )


def ramp(velocity_sps: float, target_sps: float, acceleration_sps2: float) -> tuple[Piece, ...]:
    """Return the pieces from one speed to another; the last is the new speed, for ever."""
    hold = Piece(math.inf, target_sps, 0.0)
    change = target_sps - velocity_sps
    if change == 0.0 or math.isinf(acceleration_sps2):
        return (hold,)
    return (
        Piece(abs(change) / acceleration_sps2, velocity_sps, math.copysign(acceleration_sps2, change)),
        hold,
    )


def approach(
    steps: float, velocity_sps: float, target_steps: float, speed_sps: float, acceleration_sps2: float
) -> tuple[Piece, ...]:
    """Return the pieces that end at rest on *target_steps*, quickest within the speed and acceleration.

    Any initial velocity is allowed: away from the target, faster than *speed_sps*, or too fast to stop in time (then
    the motion brakes, overshoots and returns).
    """
    a = acceleration_sps2
    pieces: list[Piece] = []
    to_go = target_steps - steps
    if abs(velocity_sps) * velocity_sps / (2 * a) * math.copysign(1.0, to_go) > abs(to_go):
        pieces.append(Piece(abs(velocity_sps) / a, velocity_sps, -math.copysign(a, velocity_sps)))
        to_go -= velocity_sps * abs(velocity_sps) / (2 * a)
        velocity_sps = 0.0
    way = math.copysign(1.0, to_go)
    distance, u = abs(to_go), way * velocity_sps
    if u > speed_sps:
        cruise = speed_sps
        pieces.append(Piece((u - cruise) / a, way * u, -way * a))
        changing = (u * u - cruise * cruise) / (2 * a)
    else:
        cruise = min(speed_sps, math.sqrt(a * distance + u * u / 2))
        if cruise > u:
            pieces.append(Piece((cruise - u) / a, way * u, way * a))
        changing = (cruise * cruise - u * u) / (2 * a)
    cruising = distance - changing - cruise * cruise / (2 * a)
    if cruise > 0.0:
        if cruising > 0.0:
            pieces.append(Piece(cruising / cruise, way * cruise, 0.0))
        pieces.append(Piece(cruise / a, way * cruise, -way * a))
    pieces.append(Piece(math.inf, 0.0, 0.0))
    return tuple(pieces)


def in_segments(pieces: Sequence[Piece], segment_s: float) -> tuple[Piece, ...]:
    """Return the same motion as firmware executes it that holds its speed for a segment at a time (GRBL: 10 ms).

    Each segment runs at its mean speed, so positions agree at every segment's end; the last one may be shorter.
    """
    knots = lay_out(0, 0.0, pieces)
    end_s = sum(piece.duration_s for piece in pieces if math.isfinite(piece.duration_s))
    stepped: list[Piece] = []
    begin_s, begin_steps = 0.0, 0.0
    while end_s - begin_s > 1e-9:
        last_s = min(begin_s + segment_s, end_s)
        steps, _ = state_at(knots, round(last_s * NS_PER_S))
        stepped.append(Piece(last_s - begin_s, (steps - begin_steps) / (last_s - begin_s), 0.0))
        begin_s, begin_steps = last_s, steps
    return (*stepped, pieces[-1])


def lay_out(begin_ns: int, steps: float, pieces: Iterable[Piece]) -> list[Knot]:
    """Put pieces end to end from *begin_ns* and *steps*."""
    knots: list[Knot] = []
    elapsed_s = 0.0
    for piece in pieces:
        begin = begin_ns + round(elapsed_s * NS_PER_S)
        knots.append(Knot(begin, steps, piece.velocity_sps, piece.acceleration_sps2))
        if math.isinf(piece.duration_s):
            break
        dt = piece.duration_s
        steps += dt * (piece.velocity_sps + 0.5 * piece.acceleration_sps2 * dt)
        elapsed_s += dt
    return knots


def state_at(knots: Sequence[Knot], when_ns: int) -> tuple[float, float]:
    """Return position and velocity on a laid-out path; before its first knot, the first knot's own state."""
    index = bisect_right(knots, when_ns, key=_begin) - 1
    if index < 0:
        return knots[0].steps, knots[0].velocity_sps
    return knots[index].at(when_ns)


def _begin(knot: Knot) -> int:
    return knot.begin_ns


# --- commands ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Motion:
    """What was commanded: a velocity, an absolute target, or a halt (``velocity_sps`` 0, infinite acceleration).

    ``speed_sps`` bounds the way to ``target_steps`` and is unused otherwise. ``segment_s`` is the length of the
    firmware's constant-speed segments, 0 for none.
    """

    acceleration_sps2: float
    velocity_sps: float = 0.0
    target_steps: float | None = None
    speed_sps: float = 0.0
    segment_s: float = 0.0

    def pieces(self, steps: float, velocity_sps: float) -> tuple[Piece, ...]:
        """Plan the motion from a state."""
        if self.target_steps is None:
            pieces = ramp(velocity_sps, self.velocity_sps, self.acceleration_sps2)
        else:
            pieces = approach(steps, velocity_sps, self.target_steps, self.speed_sps, self.acceleration_sps2)
        return in_segments(pieces, self.segment_s) if self.segment_s else pieces


REST = Motion(acceleration_sps2=math.inf)
"""A halt without a ramp."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How well a controller's times are known, all one standard deviation.

    ``reply_ns`` is the usual time from the earliest possible instant of sampling to the actual one, and
    ``reply_sigma_ns`` its scatter from one reply to the next. ``common_sigma_ns`` is what all commands and reports
    share (an adapter's latency): reports cannot average it away. ``quantum_steps`` is the resolution of a report in
    motion, ``rest_quantum_steps`` at rest (0 for a controller that counts whole steps and rests on one).
    """

    reply_ns: int
    reply_sigma_ns: int
    common_sigma_ns: int
    quantum_steps: float
    rest_quantum_steps: float = 0.0


@dataclass(slots=True)
class _Epoch:
    """One command in force: its three layouts, what was learnt about it, and the reports that taught it."""

    begin_ns: int
    motion: Motion
    delay_sigma_s: float
    steps: float = 0.0
    velocity_sps: float = 0.0
    variance: float = 0.0
    path: list[Knot] = field(default_factory=list)
    later: list[Knot] = field(default_factory=list)
    further: list[Knot] = field(default_factory=list)
    offset: float = 0.0
    delay: float = 0.0
    p_oo: float = 0.0
    p_od: float = 0.0
    p_dd: float = 0.0
    reports: list[LensReport] = field(default_factory=list)


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

    _FURTHER_STEPS = 1.0
    _MAX_REPORTS = 256

    def __init__(self, timing: Timing, *, floor_steps: float = 0.15, history_s: float = 20.0) -> None:
        self._timing = timing
        self._floor_variance = floor_steps * floor_steps
        self._history_ns = round(history_s * NS_PER_S)
        self._epochs: list[_Epoch] = []

    @property
    def known(self) -> bool:
        """Whether there has been a report to begin from."""
        return bool(self._epochs)

    def begin(self, report: LensReport) -> None:
        """Forget everything and begin from *report*: at rest, or at the velocity that it tells."""
        velocity = report.velocity_sps or 0.0
        when, _ = self._sampled(report)
        variance = self._reading_variance(velocity, 0.0)
        epoch = _Epoch(when, Motion(math.inf, velocity), 0.0, report.steps, velocity, variance)
        self._lay(epoch)
        self._epochs = [epoch]

    def command(self, motion: Motion, effective_ns: int, sigma_ns: float) -> None:
        """Note that *motion* takes over at *effective_ns*, give or take *sigma_ns*.

        Commands that were to take effect later than this one are superseded. Does nothing before the first report.
        """
        if not self._epochs:
            return
        while len(self._epochs) > 1 and self._epochs[-1].begin_ns >= effective_ns:
            self._epochs.pop()
        epoch = _Epoch(max(effective_ns, self._epochs[-1].begin_ns), motion, sigma_ns / NS_PER_S)
        self._epochs.append(epoch)
        self._follow(len(self._epochs) - 1)
        self._forget(epoch.begin_ns - self._history_ns)

    def expect(self, report: LensReport) -> Surprise:
        """Say how far *report* is from the model, without learning from it. Raises ``LensError`` before ``begin``."""
        when, sigma_s = self._sampled(report)
        epoch = self._epochs[self._index(when)]
        steps, velocity, h_offset, h_delay = self._model(epoch, when)
        return Surprise(report.steps - steps, math.sqrt(self._spread(epoch, velocity, h_offset, h_delay, sigma_s)))

    def observe(self, report: LensReport) -> None:
        """Learn from *report*, in the epoch in which it was sampled. Begins from it if it is the first."""
        if not self._epochs:
            self.begin(report)
            return
        when, _ = self._sampled(report)
        index = self._index(when)
        epoch = self._epochs[index]
        if epoch.reports and self._says_nothing_new(epoch, report, when):
            return
        if len(epoch.reports) == self._MAX_REPORTS:
            del epoch.reports[: self._MAX_REPORTS // 2]
        epoch.reports.append(report)
        self._correct(epoch, report)
        for later in range(index + 1, len(self._epochs)):
            self._follow(later)

    def position_at(self, when: HostNs) -> PositionEstimate:
        """Return position and one standard deviation at *when*, past or (as commanded) future.

        Raises ``LensError`` before the first report and beyond the history.
        """
        steps, _, sigma = self._state(when)
        return PositionEstimate(steps, sigma)

    def velocity_at(self, when: HostNs) -> float:
        """Return the modelled velocity in steps/s at *when*."""
        return self._state(when)[1]

    def at_rest_from(self) -> int | None:
        """Return when the motion commanded last ends, in ns, or None if it does not end by itself."""
        if not self._epochs:
            return None
        last = self._epochs[-1].path[-1]
        return None if last.velocity_sps or last.acceleration_sps2 else last.begin_ns

    # --- below: how it is done -----------------------------------------------------------------------------------

    def _state(self, when: int) -> tuple[float, float, float]:
        if not self._epochs:
            raise LensError("lens: position asked for before the controller reported any; poll it first")
        oldest = self._epochs[0].begin_ns
        if when < oldest:
            if oldest - when > self._history_ns or self._epochs[0].velocity_sps:
                raise LensError(
                    f"lens: position asked for {(oldest - when) / 1e6:.1f} ms before the oldest that is remembered "
                    f"(history {self._history_ns / NS_PER_S:.0f} s); ask sooner"
                )
            when = oldest  # the first report found it at rest
        epoch = self._epochs[self._index(when)]
        steps, velocity, h_offset, h_delay = self._model(epoch, when)
        return steps, velocity, math.sqrt(self._spread(epoch, velocity, h_offset, h_delay, None))

    def _index(self, when: int) -> int:
        for index in range(len(self._epochs) - 1, 0, -1):
            if self._epochs[index].begin_ns <= when:
                return index
        return 0

    def _sampled(self, report: LensReport) -> tuple[int, float]:
        """Return when the report was most likely sampled, and the standard deviation of that in seconds."""
        width = max(0, report.latest_ns - report.earliest_ns)
        late = min(self._timing.reply_ns, width // 2)
        return report.earliest_ns + late, min(self._timing.reply_sigma_ns, width / math.sqrt(12)) / NS_PER_S

    @staticmethod
    def _says_nothing_new(epoch: _Epoch, report: LensReport, when: int) -> bool:
        """At rest the same rounded number again is the same rounding error again, not more evidence."""
        return report.steps == epoch.reports[-1].steps and state_at(epoch.path, when)[1] == 0.0 and not report.moving

    def _follow(self, index: int) -> None:
        """Lay epoch *index* out again from the state in which its predecessor leaves the motor."""
        before, epoch = self._epochs[index - 1], self._epochs[index]
        steps, velocity, h_offset, h_delay = self._model(before, epoch.begin_ns)
        epoch.steps, epoch.velocity_sps = steps, velocity
        epoch.variance = (
            h_offset * h_offset * before.p_oo + 2 * h_offset * h_delay * before.p_od + h_delay * h_delay * before.p_dd
        )
        self._lay(epoch)
        for report in epoch.reports:
            self._correct(epoch, report)

    def _lay(self, epoch: _Epoch) -> None:
        begin, steps, velocity, motion = epoch.begin_ns, epoch.steps, epoch.velocity_sps, epoch.motion
        shift_s = max(epoch.delay_sigma_s, 1e-6)
        later_ns, later_steps = begin + round(shift_s * NS_PER_S), steps + velocity * shift_s
        further = steps + self._FURTHER_STEPS
        epoch.path = lay_out(begin, steps, motion.pieces(steps, velocity))
        epoch.later = [Knot(begin, steps, velocity, 0.0)]
        epoch.later += lay_out(later_ns, later_steps, motion.pieces(later_steps, velocity))
        epoch.further = lay_out(begin, further, motion.pieces(further, velocity))
        epoch.offset = epoch.delay = epoch.p_od = 0.0
        epoch.p_oo, epoch.p_dd = epoch.variance, epoch.delay_sigma_s**2

    def _model(self, epoch: _Epoch, when: int) -> tuple[float, float, float, float]:
        """Return position, velocity, and how the position depends on the epoch's offset and delay."""
        steps, velocity = state_at(epoch.path, when)
        h_offset = (state_at(epoch.further, when)[0] - steps) / self._FURTHER_STEPS
        h_delay = 0.0
        if epoch.delay_sigma_s:
            h_delay = (state_at(epoch.later, when)[0] - steps) / max(epoch.delay_sigma_s, 1e-6)
        return steps + h_offset * epoch.offset + h_delay * epoch.delay, velocity, h_offset, h_delay

    def _spread(self, epoch: _Epoch, velocity: float, h_offset: float, h_delay: float, sigma_s: float | None) -> float:
        """Return the variance of the model (and of a report sampled with *sigma_s*, if there is one), in steps²."""
        learnt = h_offset * h_offset * epoch.p_oo + 2 * h_offset * h_delay * epoch.p_od + h_delay * h_delay * epoch.p_dd
        common = velocity * self._timing.common_sigma_ns / NS_PER_S
        reading = 0.0 if sigma_s is None else self._reading_variance(velocity, sigma_s)
        return learnt + common * common + self._floor_variance + reading

    def _reading_variance(self, velocity: float, sigma_s: float) -> float:
        quantum = self._timing.quantum_steps if velocity else self._timing.rest_quantum_steps
        return quantum * quantum / 12 + (velocity * sigma_s) ** 2

    def _correct(self, epoch: _Epoch, report: LensReport) -> None:
        """Take one Kalman step on (offset, delay)."""
        when, sigma_s = self._sampled(report)
        steps, velocity, h_o, h_d = self._model(epoch, when)
        to_o = h_o * epoch.p_oo + h_d * epoch.p_od
        to_d = h_o * epoch.p_od + h_d * epoch.p_dd
        spread = h_o * to_o + h_d * to_d + self._reading_variance(velocity, sigma_s) + self._floor_variance
        surprise = report.steps - steps
        gain_o, gain_d = to_o / spread, to_d / spread
        epoch.offset += gain_o * surprise
        epoch.delay += gain_d * surprise
        epoch.p_oo -= gain_o * to_o
        epoch.p_od -= gain_o * to_d
        epoch.p_dd -= gain_d * to_d

    def _forget(self, before: int) -> None:
        while len(self._epochs) > 2 and self._epochs[1].begin_ns < before:
            del self._epochs[0]
