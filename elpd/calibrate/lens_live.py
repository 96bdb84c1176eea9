"""A lens's calibration on the rig: run and stop, home again, and listen to how long replies take. No camera needed.

Every motion is an errand or a run that ends by itself inside the limits; whatever goes wrong, the strongest stop goes
out. Stops are sent at instants spread over the controller's own rhythm, or a segment buffer would look like a constant.

Lost steps no controller tells. But how long homing takes from a place tells how far the switch is, and the difference
between two places tells its speed; so homing from the same place before and after the runs compares the count with the
switch, on any controller that homes, to about a poll's way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.calibrate.quantity import Quantity
from elpd.calibrate.stops import Cruise, StopTrial
from elpd.errors import LensError, UsageError
from elpd.motion.braking import braking_from
from elpd.motion.errand import REST_MS, Errands
from elpd.ports import LearnsStops
from elpd.records import LensFlag, StopMode
from elpd.units import NS_PER_MS, NS_PER_S, after_ms

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from elpd.ports import Clock, Lens
    from elpd.records import LensReport
    from elpd.scale import LensScale

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Of the highest speed: the lowest makes the onset, the highest the ramp."""

START_MS = 60.0
"""From a command to run to a steady speed, beside the ramp: a planner's time, and two segments."""

CRUISE_MS = 70.0
"""How long reports of the steady speed are taken."""

RHYTHM_MS = 20.0
"""Stops are spread over this time: two of the longest segments known (10 ms), and several reports."""

GOLDEN = 0.6180339887498949
POLL_MS = 0.25
EDGE_UM = 20.0
"""No calibration comes nearer to a limit."""

LEAST_SHARE = 0.1
"""Of the speed asked for: with less room than that takes, nothing is measured."""

HOME_LIMIT_MS = 60_000.0
HOME_NEAR, HOME_FAR = 0.02, 0.06
"""Where homing is timed from, in parts of the travel from the reference."""

HOMINGS = 3
LOOK_S = 0.0125
"""A driver that waits for the end of homing may miss an answer and ask again after this: no homing is timed better."""


@dataclass(frozen=True, slots=True)
class LensEvidence:
    """What the rig showed. ``round_trips_ns`` is how wide each report's interval was."""

    trials: tuple[StopTrial, ...]
    round_trips_ns: tuple[int, ...]
    lost_steps: Quantity
    acceleration_sps2: float
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Homings:
    """How long homing took, s, from a place and from one that is *way_steps* further from the switch."""

    near_steps: float
    way_steps: float
    near_s: tuple[float, ...]
    far_s: tuple[float, ...]


class LensBench:
    """A lens that is being calibrated.

    Parameters
    ----------
    clock, lens, scale
        The lens, what tells its time, and its ruler.
    speed_um_s
        The speed at which it sweeps: the highest that it is stopped from.
    repeats
        Stops in each direction at each speed.
    progress
        Told in a few words what is going on.
    """

    def __init__(
        self,
        clock: Clock,
        lens: Lens,
        scale: LensScale,
        *,
        speed_um_s: float,
        repeats: int,
        progress: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._clock, self._lens, self._scale = clock, lens, scale
        self._errands = Errands(clock, lens, scale)
        self._speed_um_s = speed_um_s
        self._repeats = repeats
        self._progress = progress
        self._widths: list[int] = []
        self._notes: list[str] = []
        self._count = 0

    def measure(self, *, homing: bool) -> LensEvidence:
        """Take everything.

        Raises ``UsageError`` where the lens cannot stop on command, has no room or is not referenced and may not home,
        ``DeviceError`` when machinery breaks; the strongest stop has been sent.
        """
        lens = self._lens
        if not (lens.capabilities.stop_on_command and isinstance(lens, LearnsStops)):
            raise UsageError(
                "this lens controller cannot stop on command: there is no stop to calibrate (a ruler measured with a "
                "gauge can be given with --table)"
            )
        try:
            homing = homing and lens.capabilities.homing
            if homing:
                self._progress("home")
                self._errands.home(HOME_LIMIT_MS)
            elif not self._referenced():
                raise UsageError("the lens does not know where it is; home it first (`elpd home`)")
            before = self._homing_times() if homing else None
            modes = [StopMode.RAMPED]
            if lens.capabilities.abrupt_stop:
                modes.append(StopMode.ABRUPT)
            else:
                self._notes.append("abrupt stops were not tried: on this controller they cost the position")
            trials = [trial for mode in modes for trial in self._stops(mode)]
            lost = self._lost(before)
        except BaseException:  # whatever it was, no lens is left running
            lens.stop(StopMode.ABRUPT)
            raise
        acceleration = lens.limits.acceleration_sps2
        return LensEvidence(tuple(trials), tuple(self._widths), lost, acceleration, tuple(self._notes))

    # --- stops ---

    def _stops(self, mode: StopMode) -> list[StopTrial]:
        low_um, high_um = self._errands.limits_um
        room_um = high_um - low_um - 2 * EDGE_UM
        top_um_s = self._highest(room_um)
        trials = []
        for share in SHARES:
            speed_um_s = share * top_um_s
            self._progress(f"{mode.name.lower()} stops from {speed_um_s:.0f} um/s")
            way_um = self._way_um(speed_um_s)
            middle_um = 0.5 * (low_um + high_um)
            for _ in range(self._repeats):
                for sign in (1, -1):
                    self._errands.move_to(middle_um - sign * 0.5 * way_um, self._speed_um_s)
                    trials.append(self._stop(mode, sign, speed_um_s))
        return trials

    def _highest(self, room_um: float) -> float:
        """Return the highest speed that the travel has room for, at most the one asked for."""
        limits = self._lens.limits
        asked_um_s = min(self._speed_um_s, limits.max_speed_sps * self._um_per_step)
        top_um_s = asked_um_s
        while self._way_um(top_um_s) > room_um:
            top_um_s *= 0.9
            if top_um_s < LEAST_SHARE * asked_um_s:
                raise UsageError(
                    f"a run and a stop from {asked_um_s:.0f} um/s take {self._way_um(asked_um_s):.0f} um, the travel "
                    f"has {room_um:.0f}; lower lens.speed_um_s or widen lens.min_um and lens.max_um"
                )
        note = f"the travel has room for stops from {top_um_s:.0f} um/s at the most ({asked_um_s:.0f} were asked for)"
        if top_um_s < asked_um_s and note not in self._notes:
            self._notes.append(note)
        return top_um_s

    def _way_um(self, speed_um_s: float) -> float:
        """Return the way of a run and a stop, with half as much again for what is not known yet."""
        limits, um = self._lens.limits, self._um_per_step
        ramp_um = speed_um_s**2 / (2 * limits.acceleration_sps2 * um)
        stop_um = ramp_um + braking_from(speed_um_s, self._lens.capabilities, limits, um).longest_um
        return 1.5 * (ramp_um + stop_um + speed_um_s * (START_MS + CRUISE_MS + RHYTHM_MS) / 1000.0)

    def _stop(self, mode: StopMode, sign: int, speed_um_s: float) -> StopTrial:
        lens, clock = self._lens, self._clock
        speed_sps = sign * speed_um_s / self._um_per_step
        begun_ns = clock.now_ns()
        ramp_ms = 1000.0 * abs(speed_sps) / lens.limits.acceleration_sps2
        self._count += 1
        steady_ns = after_ms(begun_ns, START_MS + ramp_ms)
        stop_ns = after_ms(steady_ns, CRUISE_MS + RHYTHM_MS * (GOLDEN * self._count % 1.0))
        lens.run(speed_sps, after_ms(stop_ns, 1000.0 + ramp_ms))
        before: list[LensReport] = []
        while clock.now_ns() < stop_ns:
            report = self._poll()
            if report is not None and report.earliest_ns >= steady_ns and report.moving:
                before.append(report)
            clock.sleep_until(min(stop_ns, after_ms(clock.now_ns(), POLL_MS)))
        sent_ns = lens.stop(mode).done_ns
        rest, moving_ns, still_ns = self._settled(sent_ns)
        cruise = Cruise(
            np.array([one.steps for one in before]),
            np.array([one.earliest_ns for one in before], np.int64),
            np.array([one.latest_ns for one in before], np.int64),
        )
        settled_ms = (0.5 * (moving_ns + still_ns) - sent_ns) / NS_PER_MS
        doubt_ms = 0.5 * (still_ns - moving_ns) / NS_PER_MS
        return StopTrial(mode, speed_sps, cruise, sent_ns, rest.steps, settled_ms, doubt_ms)

    def _settled(self, sent_ns: int) -> tuple[LensReport, int, int]:
        """Wait for rest; return the report that says so, when motion was reported last and when rest was first."""
        clock = self._clock
        deadline = after_ms(clock.now_ns(), REST_MS)
        moved_ns, first = sent_ns, None
        while clock.now_ns() < deadline:
            report = self._poll()
            if report is not None and report.earliest_ns >= sent_ns:
                if report.moving or (first is not None and report.steps != first.steps):
                    moved_ns, first = report.earliest_ns, None
                elif first is None:
                    first = report
                elif report.earliest_ns - first.earliest_ns >= RHYTHM_MS * NS_PER_MS:
                    return report, moved_ns, first.earliest_ns
            clock.sleep_until(after_ms(clock.now_ns(), POLL_MS))
        raise LensError(
            f"lens: not at rest {REST_MS:.0f} ms after a stop; check that it obeys STOP and nothing else drives it"
        )

    def _poll(self) -> LensReport | None:
        report = self._lens.poll()
        if report is not None:
            self._widths.append(report.latest_ns - report.earliest_ns)
        return report

    @property
    def _um_per_step(self) -> float:
        low, high = self._lens.limits.min_steps, self._lens.limits.max_steps
        return self._scale.um_per_step_at(self._scale.to_um(0.5 * (low + high)))

    # --- lost steps ---

    def _referenced(self) -> bool:
        deadline = after_ms(self._clock.now_ns(), REST_MS)
        while self._clock.now_ns() < deadline:
            report = self._poll()
            if report is not None:
                return LensFlag.REFERENCED in report.flags
            self._clock.sleep_until(after_ms(self._clock.now_ns(), POLL_MS))
        raise LensError(f"lens: no report within {REST_MS:.0f} ms; check the cable")

    def _homing_times(self) -> _Homings:
        """Time homing from two places."""
        self._progress("time homing")
        near, far = self._places()
        near_s = tuple(self._homing_s(near) for _ in range(HOMINGS))
        return _Homings(near, abs(far - near), near_s, tuple(self._homing_s(far) for _ in range(HOMINGS)))

    def _places(self) -> tuple[float, float]:
        """Return two places inside the travel, in steps, on the side of the reference: there homing is short."""
        limits = self._lens.limits
        here = self._lens.position_at(self._clock.now_ns()).steps
        travel = limits.max_steps - limits.min_steps
        up = here - limits.min_steps <= limits.max_steps - here
        end = max(here, limits.min_steps) if up else min(here, limits.max_steps)
        way = travel if up else -travel
        return end + HOME_NEAR * way, end + HOME_FAR * way

    def _homing_s(self, from_steps: float) -> float:
        self._errands.move_to(self._scale.to_um(from_steps), self._speed_um_s)
        begun_ns = self._clock.now_ns()
        self._errands.home(HOME_LIMIT_MS)
        return (self._clock.now_ns() - begun_ns) / NS_PER_S

    def _lost(self, before: _Homings | None) -> Quantity:
        """Compare the count with the switch after all those stops."""
        if before is None:
            why = "the lens was not homed again (its controller cannot, or --no-home was given)"
            return Quantity.none(why, "steps")
        self._progress("home again")
        return lost_steps(before.way_steps, before.near_s, before.far_s, self._homing_s(before.near_steps))


def lost_steps(way: float, near_s: Sequence[float], far_s: Sequence[float], after_s: float) -> Quantity:
    """Return how many steps further from the switch the motor is than its count says, from times of homing.

    *near_s* are times from one place, *far_s* from another that is *way* steps further from the switch, and *after_s*
    is the time from the first place by a count that may be wrong.
    """
    near, far = float(np.mean(near_s)), float(np.mean(far_s))
    if far <= near:
        return Quantity.none("homing from further away did not take longer, so its time tells nothing", "steps")
    speed_sps = way / (far - near)
    spread_s = math.hypot(float(np.std(near_s, ddof=1)), float(np.std(far_s, ddof=1))) / math.sqrt(2.0)
    sigma_s = math.hypot(spread_s * math.sqrt(1.0 + 1.0 / len(near_s)), LOOK_S / math.sqrt(6.0))
    return Quantity.of(speed_sps * (after_s - near), speed_sps * sigma_s, "steps")
