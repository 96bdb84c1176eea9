"""How an SCF4's lens is homed, by the host: the board has no homing of its own, and its papers leave three questions.

Which of ``G90`` and ``G91`` makes moves relative? The maker's page says one, the examples the other. The counter is
set to 8, and a move to 8 is asked for: relative it goes 8 steps, absolute it goes none, so the answer costs 8 steps
however it turns out. How fast is a code of ``M240``? A move is timed, at two codes, and that the speed is the inverse
of the code is checked. Does a forced move end at the edge of the photo-interrupter by itself? It is watched and stopped
at the edge, and its length is bounded, so either will do.

The edge is crossed slowly, always from above; it lies between the last count on one side and the first on the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from elpd.units import NS_PER_S
from elpd_drivers.lenses.line import Trouble
from elpd_drivers.lenses.scf4_wire import HOMED_COUNT, LONGEST_MOVE, SLOWEST_CODE

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from elpd.records import LensLimits

PROBE_STEPS = 8
PROBE_CODE = 600
"""The speed of the maker's examples: they turn every lens of theirs with it."""

BACK_OFF_STEPS = 100
TIMED_STEPS = 3000
ENOUGH, EDGE_STEPS, TIMINGS = 8, 4, 5
"""Positions that a move must have shown to be timed, how wide the edge may be, and how often each is tried."""

ALIKE = 0.02
QUIET = 3
"""So many equal readings in a row without motion are rest: a move may take a moment to begin."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One reading: the count (unwrapped), the photo-interrupter, and between which instants that was so."""

    count: int
    interrupter: bool
    moving: bool
    earliest_ns: int
    latest_ns: int


@dataclass(frozen=True, slots=True)
class Found:
    """What homing has found out: the word for relative moves, and steps per second times the code of ``M240``."""

    relative: str
    speed_scale: float


class Homing:
    """The steps of homing, one reading at a time: ``run`` is a generator that is sent each reading as it comes.

    Parameters
    ----------
    say
        Sends a command.
    recount
        Called when the counter has been set anew.
    limits
        The travel, in steps from the edge.
    interrupter_above
        What the photo-interrupter reads above its edge.
    known
        What the config says already; it is checked.
    """

    def __init__(
        self,
        say: Callable[[str], None],
        recount: Callable[[], None],
        limits: LensLimits,
        *,
        interrupter_above: bool,
        relative: str,
        speed_scale: float | None,
    ) -> None:
        self._say, self._recount, self._limits = say, recount, limits
        self._above, self._relative, self._speed_scale = interrupter_above, relative, speed_scale
        self._reach = min(round(1.2 * (limits.max_steps - limits.min_steps)) + 200, LONGEST_MOVE)

    def run(self) -> Generator[None, Seen, Found]:
        """Find everything out; end at rest on the edge, with the counter set. Raises ``Trouble``."""
        self._say("M0 A")
        yield from self._rest()
        for text in ("M238", "M230 A", f"M240 A{PROBE_CODE}"):
            self._say(text)
        relative = yield from self._which_is_relative()
        self._say(relative)
        seen = yield from self._rest()
        yield from self._cross(-1 if seen.interrupter == self._above else 1)
        edge = yield from self._find_edge()
        seen = yield from self._rest()
        yield from self._set_count(HOMED_COUNT + round(seen.count - edge))
        scale = yield from self._time_moves()
        self._say("M239")
        yield from self._rest()
        return Found(relative, scale)

    # --- one step each ---------------------------------------------------------------------------------------------

    def _rest(self) -> Generator[None, Seen, Seen]:
        quiet, before = 0, None
        while True:
            seen = yield
            same = before is not None and seen.count == before.count
            quiet = quiet + 1 if same and not seen.moving else 0
            if quiet == QUIET:
                return seen
            before = seen

    def _set_count(self, count: int) -> Generator[None, Seen, None]:
        self._say(f"G92 A{count}")
        self._recount()
        seen = yield from self._rest()
        if seen.count != count:
            raise Trouble(f"the counter was set to {count} (G92) and reads {seen.count}; this firmware is not known")

    def _which_is_relative(self) -> Generator[None, Seen, str]:
        moved: dict[str, int] = {}
        for word in ("G91", "G90"):
            yield from self._set_count(PROBE_STEPS)
            self._say(word)
            self._say(f"G0 A{PROBE_STEPS}")
            seen = yield from self._rest()
            moved[word] = seen.count - PROBE_STEPS
        relative = [word for word, steps in moved.items() if steps == PROBE_STEPS]
        absolute = [word for word, steps in moved.items() if steps == 0]
        if len(relative) != 1 or len(absolute) != 1:
            raise Trouble(
                f"at {PROBE_STEPS}, G0 A{PROBE_STEPS} went {moved['G91']} steps after G91 and {moved['G90']} after "
                f"G90; one should go {PROBE_STEPS} and the other none; see that the motor is free and initialised"
            )
        if self._relative not in {"", relative[0]}:
            raise Trouble(f"lens.relative is {self._relative}, but {relative[0]} is relative on this board; correct it")
        return relative[0]

    def _find_edge(self) -> Generator[None, Seen, float]:
        """Cross the edge slowly from above; where a busy machine looked away just then, do it again."""
        for _ in range(TIMINGS):
            self._say(f"M240 A{PROBE_CODE}")
            yield from self._back_off()
            self._say(f"M240 A{SLOWEST_CODE}")
            edge, width = yield from self._cross(-1)
            if width <= EDGE_STEPS:
                return edge
        raise Trouble(
            f"the edge of the photo-interrupter lies within {width} steps (limit {EDGE_STEPS}), {TIMINGS} times "
            "crossed: positions come too seldom; see lens.query_ms, and home it on a quieter machine"
        )

    def _cross(self, way: int) -> Generator[None, Seen, tuple[float, int]]:
        """Go until the photo-interrupter changes; return the count where it did, and how far around it may be."""
        seen = yield from self._rest()
        begin, side = seen.count, seen.interrupter
        self._say("M231 A")
        self._say(f"G0 A{way * self._reach}")
        quiet = 0
        while seen.interrupter == side:
            before = seen.count
            seen = yield
            quiet = 0 if seen.moving or seen.count != before else quiet + 1
            if seen.interrupter == side and (quiet > QUIET or abs(seen.count - begin) >= self._reach):
                self._say("M0 A")
                raise Trouble(
                    f"the photo-interrupter did not change within {abs(seen.count - begin)} steps (it reads "
                    f"{int(side)}); check lens.pi_above, lens.max_um, and that the motor turns"
                )
        self._say("M0 A")
        self._say("M230 A")
        return (before + seen.count) / 2, abs(seen.count - before)

    def _back_off(self) -> Generator[None, Seen, None]:
        """Go above the edge, wherever a fast crossing has ended."""
        seen = yield from self._rest()
        above = seen.count
        while abs(seen.count - above) <= self._reach:
            was_above = seen.interrupter == self._above
            self._say(f"G0 A{BACK_OFF_STEPS}")
            seen = yield from self._rest()
            if was_above and seen.interrupter == self._above:
                return
        raise Trouble("the lens does not come back from the edge of its photo-interrupter; check lens.pi_above")

    def _time_moves(self) -> Generator[None, Seen, float]:
        """Go away and come back at half the speed; return what a speed times its code is."""
        up, down = self._limits.max_steps, -self._limits.min_steps
        way = 1 if up >= down else -1
        target = HOMED_COUNT + way * min(max(up, down), TIMED_STEPS)
        there, there_sigma = yield from self._timed(target, PROBE_CODE)
        back, back_sigma = yield from self._timed(HOMED_COUNT, 2 * PROBE_CODE)
        self._refuse_unlike(
            there, back, 5 * (there_sigma + back_sigma), "at half the speed", "the codes are no periods"
        )
        if self._speed_scale is None:
            if there_sigma > ALIKE / 4:
                raise Trouble(
                    f"the speed is {there:.0f} steps/s over the code of M240, give or take {100 * there_sigma:.1f} %; "
                    f"limit {100 * ALIKE / 4:.1f} %; home it on a quieter machine, or set lens.speed_scale"
                )
            return there
        self._refuse_unlike(self._speed_scale, there, 5 * there_sigma, "measured", "correct lens.speed_scale")
        return self._speed_scale

    def _timed(self, target: int, code: int) -> Generator[None, Seen, tuple[float, float]]:
        """Go to a count at a code; return speed times code, and its relative standard error.

        A busy machine may have looked away meanwhile: what was seen too seldom or too vaguely is done again, and all
        that was seen counts.
        """
        self._say(f"M240 A{code}")
        seen = yield from self._rest()
        begin = seen.count
        moves: list[list[Seen]] = []
        for tries_left in reversed(range(TIMINGS)):
            readings = yield from self._watched(begin, target)
            moves.append(readings)
            speed, sigma = _speed(moves, code)
            if sigma <= ALIKE / 4 or (tries_left == 0 and np.isfinite(sigma)):
                return speed, sigma
            if tries_left:
                self._say(f"G0 A{begin - target}")
                yield from self._rest()
        raise Trouble(
            f"only {sum(len(one) for one in moves)} positions came during {TIMINGS} moves of {abs(target - begin)} "
            f"steps (at least {ENOUGH} are needed to time them); see lens.query_ms, and that the motor turns"
        )

    def _watched(self, begin: int, target: int) -> Generator[None, Seen, list[Seen]]:
        """Go from one count to another; return what was seen between the ramps."""
        steps = target - begin
        self._say(f"G0 A{steps}")
        readings: list[Seen] = []
        quiet = 0
        while quiet < QUIET:
            seen = yield
            quiet = quiet + 1 if not seen.moving else 0
            if seen.moving and 0.1 < (seen.count - begin) / steps < 0.9:
                readings.append(seen)
        return readings

    @staticmethod
    def _refuse_unlike(one: float, other: float, slack: float, what: str, then: str) -> None:
        if abs(other / one - 1) > max(ALIKE, slack):
            raise Trouble(f"speed times code of M240 is {one:.0f}, and {other:.0f} {what}; {then}")


def _speed(moves: list[list[Seen]], code: int) -> tuple[float, float]:
    """Fit one speed to moves that were alike; return it times *code*, and its relative error (infinite: too few).

    Of each move those readings count whose instants are known best. The shortest shows how long the board takes to
    answer; what took longer was looked at late. When a move set out nobody knows, so that each is compared with its
    own mean.
    """
    widths_ns = [seen.latest_ns - seen.earliest_ns for move in moves for seen in move] or [0]
    usual_ns, shortest_ns = median(widths_ns), min(widths_ns)
    times, counts = [np.empty(0)], [np.empty(0)]
    for move in moves:
        good = [seen for seen in move if seen.latest_ns - seen.earliest_ns <= usual_ns]
        if len(good) > 1:
            at = np.array([seen.earliest_ns + shortest_ns / 2 for seen in good]) / NS_PER_S
            count = np.array([seen.count for seen in good], dtype=np.float64)
            times.append(at - at.mean())
            counts.append(count - count.mean())
    fitted = len(times)  # one number each, and the speed
    t, n = np.concatenate(times), np.concatenate(counts)
    spread = float(t @ t)
    if sum(len(move) for move in moves) < ENOUGH or len(t) <= fitted or spread == 0.0:
        return 0.0, np.inf
    slope = float(t @ n) / spread
    if slope == 0.0:
        return 0.0, np.inf
    residue = n - slope * t
    sigma = float(np.sqrt((residue @ residue) / (len(t) - fitted) / spread))
    return abs(slope) * code, sigma / abs(slope)
