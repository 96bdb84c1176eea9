"""After the stop: how late it was, and the way back to where focus was."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

from elpd.focus import safety
from elpd.focus.ended import Ended
from elpd.focus.stage import REST_LIMIT_MS
from elpd.records import Outcome
from elpd.units import NS_PER_MS, NS_PER_S, NS_PER_US, HostNs, after_ms

if TYPE_CHECKING:
    from elpd.focus.settings import CycleSettings
    from elpd.focus.stage import Stage
    from elpd.focus.watch import Watch
    from elpd.records import CommandStamp, LensReport

APPROACH_MARGIN_UM = 1.0
"""How much further than the backlash the final approach begins: what a motor's model may be wrong by, and a step."""

BRAKING_SHARE = 0.25
"""Of the final approach's way: so close before the turn the lens brakes, and the next command needs the time left."""

AFTERGLOW_MS = 8.0
"""So long after a halt in mid-motion pixels still answer to what was before it, and the mechanics ring."""

TURN_MS = 5.0
"""A turn is over within this time of the command that makes it."""

RETURN_SIGMAS = 6.0
"""Under a lamp, how certainly the way back must have undone what the way out had done."""

RETURN_SIGMAS_OF_NOISE = 3.0
"""Of as many noise events, how certainly the way back made too few of the scene's."""

RETURN_SHARE = 0.5
"""The way back leads over the same ground as the end of the way out, and beyond: half its events at the least.

Where the scene moves, events come whether the lens moves or not, and twice as many at one time as at another. There the
image has to become sharper again by half of what it had lost, which motion does not do to it.
"""


@dataclass(frozen=True, slots=True)
class Standstill:
    """How far the lens went after the stop, and the time from the closing of the deciding window to the last step."""

    um: float
    latency_us: int | None


def standstill(stage: Stage, watch: Watch, stop: CommandStamp, sign: int) -> Standstill:
    """Find the farthest place of the sweep: where the motor stood, or turned round."""
    lens, until = stage.parts.lens, after_ms(stage.now_ns(), TURN_MS)

    def farthest(begin_ns: int, end_ns: int, step_ns: int) -> tuple[float, int]:
        times = range(begin_ns, max(begin_ns + 1, end_ns), step_ns)
        return max((sign * lens.position_at(HostNs(when)).steps, -when) for when in times)

    _, when = farthest(stop.begun_ns, until, NS_PER_MS)
    steps, when = farthest(max(stop.begun_ns, -when - NS_PER_MS), min(until, -when + NS_PER_MS), NS_PER_MS // 8)
    if watch.decided_us is None:
        return Standstill(stage.to_um(sign * steps), None)
    decided_ns, rest_ns = stage.sensor_clock.to_host(watch.decided_us), -when
    while rest_ns > decided_ns and steps - sign * lens.position_at(HostNs(rest_ns)).steps < 1.0:
        rest_ns -= NS_PER_MS // 8
    return Standstill(stage.to_um(sign * steps), int(max(0, rest_ns - decided_ns) // NS_PER_US))


class WayBack:
    """The way back to where focus was: past it by more than the play, and then there from the sweep's own side.

    A controller that takes another target in mid-motion sets out before anybody knows where focus was to the
    micrometre, is told while it goes, and turns without resting: a turn takes no time but that of the ramps. The
    others rest before every move. It goes as fast as the lens can, unless it is to make as many events as another way
    of *speed_um_s* did.
    """

    def __init__(self, stage: Stage, settings: CycleSettings, sign: int, speed_um_s: float | None = None) -> None:
        self._stage = stage
        self._sign = sign
        self._backlash_um = settings.backlash_um
        self._speed_um_s = stage.to_um(stage.parts.lens.limits.max_speed_sps) if speed_um_s is None else speed_um_s
        self._in_flight = stage.parts.lens.capabilities.native_velocity
        self._aim_um: float | None = None

    def set_out(self, focus_um: float) -> None:
        """Send the lens past *focus_um*, as far as that is known yet. Does not wait."""
        aim_um = self._turn_um(focus_um)
        if self._aim_um is not None and abs(aim_um - self._aim_um) < self._stage.um_per_step:
            return
        self._aim_um = aim_um
        self._stage.send(aim_um, self._speed_um_s)

    def arrive(self, focus_um: float) -> LensReport:
        """Turn beyond *focus_um*, go there, and return the report that the lens rests there."""
        self.set_out(focus_um)
        turn_um = self._turn_um(focus_um)
        if self._in_flight:
            self._await_braking(turn_um, abs(focus_um - turn_um))
            turning_ns = self._stage.now_ns()
            rest = self._move(focus_um)
            if self._sign * (self._lowest_um(turning_ns) - turn_um) < APPROACH_MARGIN_UM:
                return rest
            self._move(turn_um)  # it turned too soon: the play may not have been taken up
        else:
            self._move(turn_um)
        return self._move(focus_um)

    def go_off(self, focus_um: float, distance_um: float) -> None:
        """Go off *focus_um*, to the side that the sweep came from, and rest there."""
        self._aim_um = None
        self._move(focus_um - self._sign * (self._backlash_um + distance_um))

    def _turn_um(self, focus_um: float) -> float:
        return self._stage.within_limits_um(focus_um - self._sign * (self._backlash_um + APPROACH_MARGIN_UM))

    def _move(self, target_um: float) -> LensReport:
        return self._stage.move(self._stage.within_limits_um(target_um), self._speed_um_s)

    def _await_braking(self, turn_um: float, approach_um: float) -> None:
        """Wait until the lens brakes towards the turn: from then on another target behind it changes only what follows.

        It needs braking from where it has come to its top speed at the latest, and that is far from the turn.
        """
        stage = self._stage
        until = after_ms(stage.now_ns(), stage.travel_limit_ms(turn_um, self._speed_um_s))
        while stage.now_ns() < until and self._sign * (stage.here_um() - turn_um) > BRAKING_SHARE * approach_um:
            stage.read()

    def _lowest_um(self, turning_ns: HostNs) -> float:
        """Return the farthest place of the way back, by the model that the reports have corrected since."""
        lens = self._stage.parts.lens
        times = range(turning_ns, after_ms(turning_ns, TURN_MS), NS_PER_MS // 4)
        lowest = min(self._sign * lens.position_at(HostNs(when)).steps for when in times)
        return self._stage.to_um(self._sign * lowest)


def come_to_rest(stage: Stage, watch: Watch, stop: CommandStamp, way: WayBack, sign: int) -> Standstill:
    """See the sweep to its end; return where and when that was.

    A controller that stops on the next step is told at once to go back to about where focus was: the events of the
    last step, and what is computed from them, arrive while it goes.
    """
    capabilities = stage.parts.lens.capabilities
    ended_ns = after_ms(stop.done_ns, capabilities.stop_onset_ms)
    watch.after.turn(stage.sensor_clock.to_sensor(ended_ns))
    if capabilities.abrupt_stop and capabilities.native_velocity:
        way.set_out(watch.after.roughly_um)
        watch.after.go_back(stage.sensor_clock.to_sensor(after_ms(ended_ns, AFTERGLOW_MS)))
        stage.hear(safety.CAMERA_SILENCE_MS)
    else:
        stage.rest(REST_LIMIT_MS)
        watch.after.go_back(stage.sensor_clock.to_sensor(stage.now_ns()))
    return standstill(stage, watch, stop, sign)


def verify(stage: Stage, watch: Watch, settings: CycleSettings, way: WayBack, rest: LensReport, focus_um: float) -> int:
    """See that the lens is where it was sent, and that the scene changed on the way: reports alone prove nothing.

    Where the scene moves, motion may hide what the lens did, so that the way is made a second time before anybody
    says that it did nothing.
    Returns the events above noise that the way back made. Raises ``Ended`` if either is not so.
    """
    error_um = stage.to_um(rest.steps) - focus_um
    if abs(error_um) > max(0.25 * settings.depth_of_focus_um, 2 * stage.um_per_step):
        raise Ended(
            Outcome.LENS_DID_NOT_MOVE,
            f"the lens rests {error_um:+.1f} um from where it was sent; check the motor current and the mechanics",
        )
    stage.hear(safety.CAMERA_SILENCE_MS)
    score = watch.after.return_score(focus_um)
    from_um = stage.position_um(watch.after.back_from_us)
    resting_hz, way_back_um = watch.resting_rate_hz, abs(from_um - focus_um)
    passed_s = (stage.now_ns() - stage.sensor_clock.to_host(watch.after.back_from_us)) / NS_PER_S
    out_s = way_back_um / settings.speed_um_s
    back, out = watch.after.events_back, watch.after.events_within(focus_um, from_um)
    seen, expected = back - round(resting_hz * passed_s), out - round(resting_hz * out_s)
    # Events scatter by the root of their number, and the noise that is subtracted was learnt from a number too.
    learnt = (resting_hz * (passed_s - RETURN_SHARE * out_s)) ** 2 / max(1, watch.resting_events)
    chance = RETURN_SIGMAS_OF_NOISE * sqrt(back + RETURN_SHARE**2 * out + learnt)
    if score is not None and score >= RETURN_SIGMAS:
        return seen
    sharpened = watch.after.sharpened_again()
    if sharpened is not None:
        if way_back_um > settings.depth_of_focus_um and sharpened < RETURN_SHARE:
            way.go_off(focus_um, way_back_um)
            stage.hear(safety.CAMERA_SILENCE_MS)
            watch.after.look()
            way.arrive(focus_um)
            stage.hear(safety.CAMERA_SILENCE_MS)
            sharpened = watch.after.sharpened_again() or 0.0
        if way_back_um > settings.depth_of_focus_um and sharpened < RETURN_SHARE:
            raise Ended(
                Outcome.LENS_DID_NOT_MOVE,
                f"the controller says that the lens went back {way_back_um:.0f} um, but the image became sharper by "
                f"{sharpened:.0%} of what it had lost on the way out (at least {RETURN_SHARE:.0%}); check the coupling "
                "between motor and lens",
            )
        return seen
    if way_back_um > settings.depth_of_focus_um and seen < RETURN_SHARE * expected - chance:
        raise Ended(
            Outcome.LENS_DID_NOT_MOVE,
            f"the controller says that the lens went back {way_back_um:.0f} um, but the scene did not change "
            f"({seen} events above noise, {expected} on the way out); check the coupling between motor and lens",
        )
    return seen
