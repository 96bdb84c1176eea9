"""What a GRBL executes: planned blocks, the segments that are prepared of them, holds, switches and homing.

Motion is executed in segments of 10 ms, some of which are prepared ahead, the running one among them; a hold or a jog
cancel changes the first that is not yet prepared. Consecutive blocks do not blend: each ends at rest.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.motion.kinematics import Knot, Piece, approach, in_segments, lay_out, ramp, state_at
from elpd.units import NS_PER_MS, NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from elpd_drivers.sim.boards.grbl_text import GrblSettings
    from elpd_drivers.sim.lens import SimulatedLens

SEGMENT_S = 0.010
SEGMENT_NS = round(SEGMENT_S * NS_PER_S)
PLANNER_BLOCKS = 15
HARD_LIMIT, SOFT_LIMIT, RESET_IN_MOTION, HOMING_RESET, NOT_FOUND = 1, 2, 3, 6, 9
"""The numbers of alarms."""


@dataclass(frozen=True, slots=True)
class _Block:
    target_pulses: float
    speed_sps: float
    jog: bool


@dataclass(slots=True)
class _Motion:
    """What the stepper executes: the profile as planned, when it began, and when it ends."""

    profile: list[Knot]
    begin_ns: int
    end_ns: int
    prepared: int
    holding: bool = False

    def prepared_until_ns(self, now_ns: int) -> int:
        """Return the end of the last segment that is prepared at *now_ns*."""
        running = (now_ns - self.begin_ns) // SEGMENT_NS
        return min(self.begin_ns + (running + self.prepared) * SEGMENT_NS, self.end_ns)


class GrblStepper:
    """The X axis of a GRBL.

    Parameters
    ----------
    lens
        What it turns.
    settings
        The board's ``$`` settings.
    prepared
        How many segments run before a stop bites.
    alarm
        What to call when a switch ends a motion, or homing does not find one: number and instant.
    homing_over
        What to call when homing has ended well.
    """

    def __init__(
        self,
        lens: SimulatedLens,
        settings: GrblSettings,
        prepared: int,
        alarm: Callable[[int, int], None],
        homing_over: Callable[[int], None],
    ) -> None:
        self.lens, self.settings, self._prepared = lens, settings, prepared
        self._alarm, self._homing_over = alarm, homing_over
        self.state = "Idle"
        self.offset = 0
        """From the lens's pulses to the board's count."""
        self.homed = False
        self.held = False
        """Whether a feed hold waits to be resumed."""
        self.blocks: deque[_Block] = deque()
        self.motion: _Motion | None = None
        self.homing: list[Callable[[int], None]] = []
        self.homing_due_ns: int | None = None
        self.switch_ns: int | None = None

    def events(self) -> list[tuple[int, Callable[[int], None]]]:
        """Return what happens next of itself, and when."""
        events: list[tuple[int, Callable[[int], None]]] = []
        if self.switch_ns is not None:
            events.append((self.switch_ns, self.switch))
        if self.motion is not None:
            events.append((self.motion.end_ns, self.ended))
        if self.homing_due_ns is not None:
            events.append((self.homing_due_ns, self.home_on))
        return events

    def feed_mm_min(self, at_ns: int) -> float:
        """Return the speed at the end of the last segment that is prepared: what the firmware reports."""
        if self.motion is None:
            return 0.0
        _, ahead_sps = state_at(self.motion.profile, self.motion.prepared_until_ns(at_ns))
        return abs(ahead_sps) / self.steps_per_mm * 60

    # --- motion ----------------------------------------------------------------------------------------------------

    @property
    def steps_per_mm(self) -> float:
        """``$100``."""
        return self.settings[100]

    def target_pulses(self, x_mm: float, at_ns: int, *, relative: bool) -> float:
        """Return where a motion ends; a relative one counts from the end of what is planned already."""
        begin = 0
        if relative:
            planned = self.blocks[-1].target_pulses if self.blocks else self.lens.pulses_at(at_ns)
            begin = round(planned) + self.offset
        return float(begin + round(x_mm * self.steps_per_mm) - self.offset)

    def inside(self, target_pulses: float) -> bool:
        """Say whether a target lies inside the travel."""
        return round(-self.settings[130] * self.steps_per_mm) <= target_pulses + self.offset <= 0

    def plan(self, target: float, feed_mm_min: float, at_ns: int, *, jog: bool) -> None:
        """Put a motion behind those that are planned; begin if there are none."""
        speed_sps = min(feed_mm_min, self.settings[110]) / 60 * self.steps_per_mm
        end = self.blocks[-1].target_pulses if self.blocks else round(self.lens.pulses_at(at_ns))
        if target == end or speed_sps <= 0:
            return
        self.blocks.append(_Block(target, speed_sps, jog))
        if self.motion is None and not self.held:
            self.start_block(at_ns)

    def start_block(self, at_ns: int) -> None:
        """Take up the next block, if there is one."""
        if not self.blocks:
            self.state = "Idle"
            return
        block = self.blocks[0]
        self.state = "Jog" if block.jog else "Run"
        steps = self.lens.pulses_at(at_ns)
        self._execute(approach(steps, 0.0, block.target_pulses, block.speed_sps, self._acceleration_sps2()), at_ns)

    def _execute(self, pieces: Sequence[Piece], at_ns: int, *, holding: bool = False) -> _Motion:
        """Let the stepper follow a profile from *at_ns* on, segment by segment."""
        profile = lay_out(at_ns, self.lens.pulses_at(at_ns), pieces)
        self.motion = motion = _Motion(profile, at_ns, max(profile[-1].begin_ns, at_ns), self._prepared, holding)
        self.lens.follow(at_ns, in_segments(pieces, SEGMENT_S))
        self._watch_switches(at_ns)
        return motion

    def hold(self, at_ns: int) -> None:
        """Brake from the first segment that is not yet prepared."""
        motion = self.motion
        if motion is None or motion.holding:
            return
        motion.holding = True
        onset_ns = motion.prepared_until_ns(at_ns)
        if onset_ns >= motion.end_ns:
            return  # the motion ends by itself within what is prepared
        _, velocity = state_at(motion.profile, onset_ns)
        pieces = ramp(velocity, 0.0, self._acceleration_sps2())
        begin_ns, earlier = motion.begin_ns, motion.profile
        braking = self._execute(pieces, onset_ns, holding=True)
        braking.profile = [*(knot for knot in earlier if knot.begin_ns < onset_ns), *braking.profile]
        braking.begin_ns = begin_ns

    def ended(self, at_ns: int) -> None:
        """Go on after the end of what was executed."""
        held = self.motion is not None and self.motion.holding
        self.motion = None
        if self.homing:
            self.homing_due_ns = at_ns + round(self.settings[26] * NS_PER_MS)
            return
        if self.held:
            return  # feed hold: the block is taken up again at ~
        if held:
            self.blocks.clear()
        elif self.blocks:
            self.blocks.popleft()
        self.start_block(at_ns)

    def _acceleration_sps2(self) -> float:
        return self.settings[120] * self.steps_per_mm

    def forget(self) -> None:
        """Drop what is planned and under way; whoever calls has halted the motor."""
        self.motion = None
        self.blocks.clear()
        self.homing = []
        self.homing_due_ns = self.switch_ns = None
        self.held = False

    # --- switches and homing ----------------------------------------------------------------------------------

    def _watch_switches(self, from_ns: int) -> None:
        self.switch_ns = None
        if self.settings[21] and not self.homing:
            times = [
                self.lens.reaches(-0.5, from_ns, upwards=False),
                self.lens.reaches(self.lens.travel_steps + 0.5, from_ns, upwards=True),
            ]
            self.switch_ns = min((when for when in times if when is not None), default=None)

    def switch(self, at_ns: int) -> None:
        """Let a switch act: the next of homing, or a hard limit."""
        self.switch_ns = None
        if self.homing:
            self.lens.halt(at_ns)
            self.motion = None
            self.homing_due_ns = at_ns + round(self.settings[26] * NS_PER_MS)
        elif self.motion is not None:
            self.lens.halt(at_ns)
            self._alarm(HARD_LIMIT, at_ns)

    def begin_homing(self, at_ns: int) -> None:
        """Seek the switch, back off, and once more slowly."""
        self.blocks.clear()
        self.state = "Home"
        self.homing = [
            lambda now: self._seek(self.settings[25], now),
            lambda now: self._pull_off(self.settings[25], now),
            lambda now: self._seek(self.settings[24], now),
            lambda now: self._pull_off(self.settings[24], now),
            self._homed,
        ]
        self.homing_due_ns = at_ns

    def home_on(self, at_ns: int) -> None:
        """Take the next part of homing."""
        self.homing_due_ns = None
        self.homing.pop(0)(at_ns)

    def _towards(self) -> float:
        return -1.0 if int(self.settings[23]) & 1 else 1.0

    def _seek(self, feed_mm_min: float, at_ns: int) -> None:
        towards, speed = self._towards(), feed_mm_min / 60 * self.steps_per_mm
        farthest = self.lens.pulses_at(at_ns) + towards * 1.5 * self.settings[130] * self.steps_per_mm
        self._execute(approach(self.lens.pulses_at(at_ns), 0.0, farthest, speed, self._acceleration_sps2()), at_ns)
        edge = -0.5 if towards < 0 else self.lens.travel_steps + 0.5
        self.switch_ns = self.lens.reaches(edge, at_ns, upwards=towards > 0)
        if self.switch_ns is None:
            self.lens.halt(at_ns)
            self._alarm(NOT_FOUND, at_ns)

    def _pull_off(self, feed_mm_min: float, at_ns: int) -> None:
        steps, speed = self.lens.pulses_at(at_ns), feed_mm_min / 60 * self.steps_per_mm
        target = round(steps) - self._towards() * round(self.settings[27] * self.steps_per_mm)
        self._execute(approach(steps, 0.0, target, speed, self._acceleration_sps2()), at_ns)
        self.switch_ns = None

    def _homed(self, at_ns: int) -> None:
        pulled = self.settings[27] * self.steps_per_mm
        machine = -self.settings[130] * self.steps_per_mm + pulled if self._towards() < 0 else -pulled
        self.offset = round(machine) - round(self.lens.pulses_at(at_ns))
        self.state, self.homed = "Idle", True
        self.homing = []
        self._homing_over(at_ns)
