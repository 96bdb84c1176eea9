"""Exact kinematics: motion under an acceleration limit, as pieces of constant acceleration.

Pure functions that both sides of the wire share: a driver's model of where its motor is, and the simulated boards'
planners. Everything is closed form; nothing is stepped through time, so there is no integration error to tune.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


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
