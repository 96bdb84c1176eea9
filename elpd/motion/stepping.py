"""A lens that cannot be stopped, driven so that it need not be: in moves short enough to be let run out.

Some controllers (Theia's MCR) read nothing while a motor moves. A sweep on one of them is a row of moves from rest to
rest; the next begins as soon as the one before is over, unless somebody has said *stop* meanwhile. Events tell the same
of each as of one long sweep, because a pixel's two crossings are compared by where the lens was, not by when. So what
was impossible, to stop on the moment, becomes a stop that takes one move at the most, and the cycle, which plans with
what a stop takes, sweeps past focus and returns.

The price is time: the answer, the next command and the start of every move.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from elpd.ports import Closeable, Remarks
from elpd.records import CommandStamp, LensFlag
from elpd.units import NS_PER_S, Steps

if TYPE_CHECKING:
    from collections.abc import Sequence

    from elpd.ports import Clock, Lens
    from elpd.records import LensCapabilities, LensLimits, LensReport, PositionEstimate, StopMode
    from elpd.units import HostNs

MOVE_DOF = 4.0
"""Depths of focus that one move goes: as far beyond focus as a stop may end, and four times what a start costs."""


@dataclass(frozen=True, slots=True)
class _Wish:
    """Where to go, or how fast and until when."""

    speed_sps: float
    target: Steps | None = None
    until: HostNs | None = None


class SteppingLens:
    """``elpd.ports.Lens`` on one that cannot be stopped.

    Parameters
    ----------
    lens
        Such a lens. Its moves are bounded, and one is not begun before the one before is over.
    clock
        Its time.
    move_steps
        How far one move goes at the most while a velocity is asked for, steps.
    sweep_sps
        The speed of a sweep, by which the longest stop is told, steps/s.
    """

    def __init__(self, lens: Lens, clock: Clock, move_steps: float, sweep_sps: float) -> None:
        self._lens, self._clock = lens, clock
        self._move_steps = max(1, math.floor(move_steps))
        self._sweep_sps = min(sweep_sps, lens.limits.max_speed_sps)
        self._wish: _Wish | None = None
        self._moving = False
        self._begun_ns = 0

    @property
    def limits(self) -> LensLimits:
        """The lens's."""
        return self._lens.limits

    @property
    def capabilities(self) -> LensCapabilities:
        """A stop that comes at the end of a move: now at the best, after a whole one at the worst."""
        longest_ms = 1000.0 * self._move_steps / self._sweep_sps
        return replace(
            self._lens.capabilities,
            native_velocity=False,
            abrupt_stop=False,
            stop_on_command=True,
            stop_onset_ms=longest_ms / 2,
            stop_onset_sigma_ms=longest_ms / math.sqrt(12),
        )

    @property
    def remarks(self) -> Sequence[str]:
        """The lens's."""
        return self._lens.remarks if isinstance(self._lens, Remarks) else ()

    def home(self, deadline: HostNs) -> LensReport:
        """Find the reference. Raises what the lens raises, ``UsageError`` while a move is under way among it."""
        self._wish = None
        report = self._lens.home(deadline)
        self._moving = False
        return report

    def move_to(self, target: Steps, speed_sps: float) -> CommandStamp:
        """Go to a place, after the move under way if there is one."""
        return self._begin("move_to", _Wish(speed_sps, target=target))

    def run(self, velocity_sps: float, until: HostNs) -> CommandStamp:
        """Go on in one direction, move by move; a reversal waits for the move under way."""
        return self._begin("run", _Wish(velocity_sps, until=until))

    def stop(self, mode: StopMode) -> CommandStamp:
        """Begin no other move. From any thread, at once."""
        self._wish = None
        return self._lens.stop(mode)

    def poll(self) -> LensReport | None:
        """Return the newest report if there is a new one; begin the next move where one has ended."""
        report = self._lens.poll()
        if report is not None and not report.moving and report.earliest_ns >= self._begun_ns:
            self._moving = False
        wish = self._wish
        if wish is None:
            return report
        if not self._moving:
            self._go(wish)
        if report is None or not self._moving:
            return report
        return replace(report, flags=report.flags | LensFlag.MOVING)  # at rest for a moment, on its way

    def position_at(self, when: HostNs) -> PositionEstimate:
        """Return where the motor was at *when*."""
        return self._lens.position_at(when)

    def close(self) -> None:
        """Begin no other move, and give the lens back. Idempotent."""
        self._wish = None
        if isinstance(self._lens, Closeable):
            self._lens.close()

    def _begin(self, name: str, wish: _Wish) -> CommandStamp:
        self._wish = wish
        if not self._moving:
            return self._go(wish)
        now = self._clock.now_ns()
        return CommandStamp(name, now, now)

    def _go(self, wish: _Wish) -> CommandStamp:
        """Begin the next move of *wish*; a place is gone to at once, and ends it."""
        now = self._clock.now_ns()
        here = self._lens.position_at(now).steps
        target = wish.target
        if target is None:
            assert wish.until is not None, "a wish has a place or an end"
            way = min(self._move_steps, abs(wish.speed_sps) * max(wish.until - now, 0) / NS_PER_S)
            aim = round(here + math.copysign(way, wish.speed_sps))
            target = Steps(min(max(aim, self.limits.min_steps), self.limits.max_steps))
        if wish.target is not None or target == round(here):
            self._wish = None
        stamp = self._lens.move_to(target, abs(wish.speed_sps))
        if target != round(here):
            self._moving, self._begun_ns = True, stamp.done_ns
        return stamp
