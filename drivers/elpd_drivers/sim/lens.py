"""A stepper-driven lens: physics only. What speaks a protocol stands in ``boards``; what reads a config, elsewhere.

The controller's pulses are a path of exact pieces (constant acceleration each), so that a position at any instant is
evaluated, not integrated, and asking often or rarely gives the same answer to the last bit. Between pulses and glass
stand the imperfections that matter to a focus cycle, each a memory that only changes when the motion does:

- end stops: the rotor stays where it is while pulses go on, and leaves as soon as they reverse (steps are lost
  silently);
- backlash: a play between rotor and carriage, invisible to whoever counts pulses;
- ringing: every jump of speed leaves the carriage swinging, for some milliseconds;
- microstep error: the rotor's position within an electrical cycle is not quite proportional;
- faults, for tests: stuck, slipping, stalling above a speed.

Positions of pulses and rotor are in microsteps from the lower limit switch, the carriage's in um.
"""

from __future__ import annotations

import cmath
import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.motion.kinematics import Piece, approach, ramp
from elpd.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

STEPS_PER_ELECTRICAL_CYCLE = 4 * 64

LAST_STEP_S = 4e-3
"""A halted motor is at rest within this time: at 250 steps/s and more it takes the step under way."""


@dataclass(frozen=True, slots=True)
class LensMechanics:
    """The parameters of a simulated lens.

    ``travel_um`` is the distance between the two limit switches, ``overtravel_um`` that from each of them on to its
    end stop; ``backlash_um`` is the full play between rotor and carriage.
    After a jump of speed dv the carriage swings with amplitude ``ring_fraction * dv / (2 pi ring_hz)`` (0.64 um for
    an abrupt stop from 4 mm/s), dying away with ``ring_decay_ms``. ``stall_sps`` is the speed above which the rotor
    loses the field and stands still until the pulses have stopped, ``None`` for never.
    """

    um_per_step: float = 0.3125
    travel_um: float = 2500.0
    overtravel_um: float = 20.0
    backlash_um: float = 4.0
    ring_fraction: float = 0.15
    ring_hz: float = 150.0
    ring_decay_ms: float = 4.0
    microstep_error_um: float = 0.0
    stall_sps: float | None = None


@dataclass(slots=True)
class _Stretch:
    """A piece of the path in which the pulses do not reverse, with the memories' state at its beginning."""

    begin_ns: int
    end_ns: int
    pulses: float
    velocity_sps: float
    acceleration_sps2: float
    rotor: float
    carriage: float
    follows: bool

    def pulses_at(self, when_ns: int) -> float:
        dt = (when_ns - self.begin_ns) / NS_PER_S
        return self.pulses + dt * (self.velocity_sps + 0.5 * self.acceleration_sps2 * dt)

    def velocity_at(self, when_ns: int) -> float:
        return self.velocity_sps + self.acceleration_sps2 * (when_ns - self.begin_ns) / NS_PER_S


FOR_EVER_NS = 1 << 62


class SimulatedLens:
    """A motor, a screw and a carriage.

    Commands take effect at the instant given, which must not lie before an earlier command's. The path beyond it is
    replaced. Positions may be asked for at any instant within ``history_s`` before the last command or ``advance``.

    Parameters
    ----------
    mechanics
        What the lens is like.
    start_um
        Where rotor and carriage stand to begin with, in um from the lower limit switch.
    history_s
        How long the past is remembered.
    """

    def __init__(
        self, mechanics: LensMechanics | None = None, *, start_um: float = 1250.0, history_s: float = 10.0
    ) -> None:
        self.mechanics = mechanics or LensMechanics()
        self.travel_steps = self.mechanics.travel_um / self.mechanics.um_per_step
        start = start_um / self.mechanics.um_per_step
        if not 0.0 <= start <= self.travel_steps:
            raise ValueError(f"start_um is {start_um:g}, outside the travel of 0 to {self.mechanics.travel_um:g} um")
        self._lowest = -self.mechanics.overtravel_um / self.mechanics.um_per_step
        self._highest = self.travel_steps - self._lowest
        self._play = self.mechanics.backlash_um / self.mechanics.um_per_step / 2
        self._history_ns = round(history_s * NS_PER_S)
        self._stuck = False
        self._stretches = [_Stretch(-FOR_EVER_NS, FOR_EVER_NS, start, 0.0, 0.0, start, start, follows=True)]
        self._rings: list[tuple[int, complex]] = []

    # --- what boards command ---------------------------------------------------------------------------------------

    def set_velocity(self, at_ns: int, velocity_sps: float, acceleration_sps2: float) -> None:
        """Ramp to a signed velocity and keep it."""
        self.follow(at_ns, ramp(self.velocity_at(at_ns), velocity_sps, acceleration_sps2))

    def move_to(self, at_ns: int, target_steps: float, speed_sps: float, acceleration_sps2: float) -> None:
        """Move to a number of pulses (in the lens's own count, see ``pulses_at``) and rest there."""
        velocity = self.velocity_at(at_ns)
        self.follow(at_ns, approach(self.pulses_at(at_ns), velocity, target_steps, speed_sps, acceleration_sps2))

    def halt(self, at_ns: int) -> None:
        """Stop without a ramp, on the next whole step: a controller never rests between two steps.

        One that has only just set out, or has nearly arrived, is so slow that the next step would be long in coming:
        it rests on the nearest, of two as near on the one ahead.
        """
        steps, velocity = self.pulses_at(at_ns), self.velocity_at(at_ns)
        if velocity == 0.0:
            self.follow(at_ns, ramp(0.0, 0.0, 1.0))
            return
        rest = math.ceil(steps - 1e-6) if velocity > 0 else math.floor(steps + 1e-6)
        last_s = (rest - steps) / velocity
        if last_s > LAST_STEP_S:
            nearest = math.floor(steps + 0.5 + 1e-6) if velocity > 0 else math.ceil(steps - 0.5 - 1e-6)
            last_s, velocity = LAST_STEP_S, (nearest - steps) / LAST_STEP_S
        self.follow(at_ns, (Piece(max(last_s, 0.0), velocity, 0.0), Piece(math.inf, 0.0, 0.0)))

    def follow(self, at_ns: int, pieces: Iterable[Piece]) -> None:
        """Replace the path from *at_ns* on by *pieces*, laid end to end; the last one lasts for ever."""
        before = self._at(at_ns - 1)
        self._lay(at_ns, pieces, follows=before.follows or before.velocity_at(at_ns) == 0.0)

    def _lay(self, at_ns: int, pieces: Iterable[Piece], *, follows: bool) -> None:
        pulses, rotor, carriage = self._state(at_ns)
        velocity_before = self._at(at_ns - 1).velocity_at(at_ns)
        while self._stretches and self._stretches[-1].begin_ns >= at_ns:
            self._stretches.pop()
        while self._rings and self._rings[-1][0] >= at_ns:
            self._rings.pop()
        if self._stretches:
            self._stretches[-1].end_ns = at_ns
        begin_ns, left_s = at_ns, 0.0
        for piece in pieces:
            if piece.duration_s <= 0.0:
                continue
            self._ring(begin_ns, piece.velocity_sps - velocity_before)
            for part in _monotone(piece):
                follows = self._keeps_up(part, follows=follows)
                # durations add up in seconds, so that rounding to nanoseconds does not add up too
                left_s += part.duration_s
                end_ns = FOR_EVER_NS if math.isinf(left_s) else at_ns + round(left_s * NS_PER_S)
                v, a = part.velocity_sps, part.acceleration_sps2
                self._stretches.append(_Stretch(begin_ns, end_ns, pulses, v, a, rotor, carriage, follows))
                if end_ns == FOR_EVER_NS:
                    break
                dt = part.duration_s
                pulses += dt * (v + 0.5 * a * dt)
                velocity_before = v + a * dt
                _, rotor, carriage = self._state(end_ns)
                begin_ns = end_ns
        self.advance(at_ns)

    def advance(self, until_ns: int) -> None:
        """Forget what lies further back than the history."""
        horizon = until_ns - self._history_ns
        stale = 0
        while stale < len(self._stretches) - 1 and self._stretches[stale].end_ns < horizon:
            stale += 1
        if stale > 64:
            del self._stretches[:stale]
            del self._rings[: bisect_right(self._rings, horizon, key=_first)]

    # --- what boards may know --------------------------------------------------------------------------------------

    def pulses_at(self, when_ns: int) -> float:
        """Return how far the pulses went, in steps: what an open-loop controller believes."""
        return self._at(when_ns).pulses_at(when_ns)

    def velocity_at(self, when_ns: int) -> float:
        """Return the speed of the pulses, steps/s."""
        return self._at(when_ns).velocity_at(when_ns)

    def rotor_at(self, when_ns: int) -> float:
        """Return where the rotor is, in steps from the lower limit switch: what the switches see."""
        return self._state(when_ns)[1]

    def rest_from_ns(self) -> int | None:
        """Return when the path comes to rest for good, or None if it never does."""
        last = self._stretches[-1]
        return None if last.velocity_sps or last.acceleration_sps2 else last.begin_ns

    def reaches(self, rotor_steps: float, from_ns: int, *, upwards: bool) -> int | None:
        """Return when the rotor first goes beyond *rotor_steps*, at or after *from_ns*, on the path as planned.

        To the nanosecond, rounded up; None if it never does.
        """
        for stretch in self._stretches:
            if stretch.end_ns <= from_ns:
                continue
            begin = max(stretch.begin_ns, from_ns)
            if _beyond(self._state(begin)[1], rotor_steps, upwards=upwards):
                return begin
            gap = rotor_steps - stretch.rotor
            elapsed_s = _first_passage(gap, stretch.velocity_sps, stretch.acceleration_sps2)
            if not stretch.follows or elapsed_s is None or (gap > 0.0) != upwards:
                continue
            when = stretch.begin_ns + math.ceil(elapsed_s * NS_PER_S) + 1
            if begin <= when < stretch.end_ns:
                return when
        return None

    # --- what the optics see ---------------------------------------------------------------------------------------

    def motor_steps(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the pulses at *times_ns* (any shape), float64, in steps."""
        _, pulses, _, _ = self._evaluate(times_ns)
        return pulses

    def carriage_um(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the carriage's position at *times_ns* (any shape), float64, in um from the lower limit switch."""
        times, _, _, carriage = self._evaluate(times_ns)
        position = carriage * self.mechanics.um_per_step
        if self._rings:
            position += self._ringing_um(times)
        return position

    # --- faults, for tests -----------------------------------------------------------------------------------------

    def stick(self, at_ns: int) -> None:
        """Let the rotor stand still from *at_ns* on, whatever the pulses do."""
        self._stuck = True
        self._replan(at_ns)

    def release(self, at_ns: int) -> None:
        """Let the rotor follow again."""
        self._stuck = False
        self._replan(at_ns)

    def slip(self, at_ns: int, steps: float) -> None:
        """Lose *steps* at once: the rotor stays behind the pulses by so many more, for good."""
        self._replan(at_ns)
        stretch = self._at(at_ns)
        stretch.rotor = min(max(stretch.rotor - steps, self._lowest), self._highest)
        rest = [s for s in self._stretches if s.begin_ns > at_ns]
        for before, after in zip([stretch, *rest], rest, strict=False):
            _, after.rotor, after.carriage = self._within(before, after.begin_ns)

    # --- below: how it is done -------------------------------------------------------------------------------------

    def _replan(self, at_ns: int) -> None:
        """Lay the rest of the path out again, from the state at *at_ns*."""
        now = self._at(at_ns)
        rest = [s for s in self._stretches if s.begin_ns > at_ns]
        pieces = [_piece(now, at_ns, now.end_ns), *(_piece(s, s.begin_ns, s.end_ns) for s in rest)]
        self._lay(at_ns, pieces, follows=True)

    def _keeps_up(self, part: Piece, *, follows: bool) -> bool:
        if self._stuck:
            return False
        if part.velocity_sps == 0.0:
            follows = True
        limit = self.mechanics.stall_sps
        if limit is None:
            return follows
        end_sps = part.velocity_sps
        if math.isfinite(part.duration_s):
            end_sps += part.acceleration_sps2 * part.duration_s
        return follows and max(abs(part.velocity_sps), abs(end_sps)) <= limit

    def _ring(self, at_ns: int, jump_sps: float) -> None:
        mechanics = self.mechanics
        swing_um = mechanics.ring_fraction * jump_sps * mechanics.um_per_step / (2 * math.pi * mechanics.ring_hz)
        if abs(swing_um) > 1e-3:
            so_far = 0j
            if self._rings:
                before_ns, phasor = self._rings[-1]
                so_far = phasor * cmath.exp(self._swinging() * ((at_ns - before_ns) / NS_PER_S))
            self._rings.append((at_ns, so_far - swing_um))

    def _swinging(self) -> complex:
        """Return what a swing's phasor is multiplied by in a second is the exponential of."""
        return complex(-1e3 / self.mechanics.ring_decay_ms, 2 * math.pi * self.mechanics.ring_hz)

    def _at(self, when_ns: int) -> _Stretch:
        index = bisect_right(self._stretches, when_ns, key=_begin) - 1
        return self._stretches[max(index, 0)]

    def _state(self, when_ns: int) -> tuple[float, float, float]:
        return self._within(self._at(when_ns), when_ns)

    def _within(self, stretch: _Stretch, when_ns: int) -> tuple[float, float, float]:
        pulses = stretch.pulses_at(when_ns)
        rotor = stretch.rotor
        if stretch.follows:
            rotor = min(max(rotor + pulses - stretch.pulses, self._lowest), self._highest)
        return pulses, rotor, min(max(stretch.carriage, rotor - self._play), rotor + self._play)

    def _evaluate(
        self, times_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return times, pulses, rotor and carriage (all in steps); the vector form of ``_within``."""
        times = np.asarray(times_ns, dtype=np.int64)
        if not times.size:
            return times, np.zeros(times.shape), np.zeros(times.shape), np.zeros(times.shape)
        first = max(bisect_right(self._stretches, int(times.min()), key=_begin) - 1, 0)
        last = max(bisect_right(self._stretches, int(times.max()), key=_begin), 1)
        stretches = self._stretches[first:last]
        begins = np.array([s.begin_ns for s in stretches], dtype=np.int64)
        rows = [
            (s.pulses, s.velocity_sps, s.acceleration_sps2, s.rotor, s.carriage, float(s.follows)) for s in stretches
        ]
        table = np.array(rows, dtype=np.float64)
        index = np.maximum(np.searchsorted(begins, times, side="right") - 1, 0)
        row = table[index]
        dt = (times - begins[index]) / NS_PER_S
        gone = dt * (row[..., 1] + 0.5 * row[..., 2] * dt)
        rotor = np.clip(row[..., 3] + gone * row[..., 5], self._lowest, self._highest)
        carriage = np.clip(row[..., 4], rotor - self._play, rotor + self._play)
        wobble = self.mechanics.microstep_error_um / self.mechanics.um_per_step
        if wobble:
            carriage = carriage + wobble * np.sin(rotor * (2 * np.pi / STEPS_PER_ELECTRICAL_CYCLE))
        return times, row[..., 0] + gone, rotor, carriage

    def _ringing_um(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the swing at *times*: of all jumps so far, which from the newest on decay as one."""
        first = max(bisect_right(self._rings, int(times.min()), key=_first) - 1, 0)
        rings = self._rings[first : bisect_right(self._rings, int(times.max()), key=_first)]
        if not rings:
            return np.zeros(times.shape)
        begins = np.array([at_ns for at_ns, _ in rings], dtype=np.int64)
        phasors = np.array([phasor for _, phasor in rings], dtype=np.complex128)
        index = np.searchsorted(begins, times, side="right") - 1
        dt = np.maximum((times - begins[index]) / NS_PER_S, 0.0)
        swing: NDArray[np.float64] = (phasors[index] * np.exp(self._swinging() * dt)).imag
        return np.where(index < 0, 0.0, swing)


def _begin(stretch: _Stretch) -> int:
    return stretch.begin_ns


def _first(ring: tuple[int, complex]) -> int:
    return ring[0]


def _piece(stretch: _Stretch, begin_ns: int, end_ns: int) -> Piece:
    duration_s = math.inf if end_ns == FOR_EVER_NS else (end_ns - begin_ns) / NS_PER_S
    return Piece(duration_s, stretch.velocity_at(begin_ns), stretch.acceleration_sps2)


def _monotone(piece: Piece) -> tuple[Piece, ...]:
    """Split a piece where its velocity changes sign."""
    v, a, duration = piece.velocity_sps, piece.acceleration_sps2, piece.duration_s
    if a == 0.0 or v * a >= 0.0 or -v / a >= duration:
        return (piece,)
    turn = -v / a
    return Piece(turn, v, a), Piece(duration - turn, 0.0, a)


def _beyond(steps: float, limit: float, *, upwards: bool) -> bool:
    return steps > limit if upwards else steps < limit


def _first_passage(gap: float, v: float, a: float) -> float | None:
    """Return the smallest positive time at which ``v t + a t²/2`` equals *gap*, for motion that does not reverse."""
    if a == 0.0:
        return gap / v if v and gap / v > 0.0 else None
    root = v * v + 2 * a * gap
    if root < 0.0:
        return None
    # the stable form of the quadratic's roots
    q = -(v + math.copysign(math.sqrt(root), v or a))
    times = [t for t in (q / a, -2 * gap / q if q else math.nan) if t > 0.0]
    return min(times, default=None)
