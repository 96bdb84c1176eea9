"""After the stop: how late it was, and the way back to where focus was."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.focus import safety
from elpd.focus.ended import Ended
from elpd.records import Outcome
from elpd.units import NS_PER_MS, NS_PER_S, NS_PER_US, HostNs

if TYPE_CHECKING:
    from elpd.focus.settings import CycleSettings
    from elpd.focus.stage import Stage
    from elpd.focus.watch import Watch
    from elpd.records import LensReport

APPROACH_MARGIN_UM = 2.0
"""How much further than the backlash the final approach begins."""

RETURN_SIGMAS = 6.0
"""Under a lamp, how certainly the way back must have undone what the way out had done."""

RETURN_SHARE = 0.5
"""The way back leads over the same ground as the way out, and beyond: half its events at the least."""


def latency_us(stage: Stage, watch: Watch, rest: LensReport) -> int | None:
    """Return the time from the closing of the deciding window to the motor's last step."""
    if watch.decided_us is None:
        return None
    decided_ns = stage.sensor_clock.to_host(watch.decided_us)
    lens, when = stage.parts.lens, HostNs(rest.latest_ns)
    while when > decided_ns and abs(lens.position_at(when).steps - rest.steps) < 1.0:
        when = HostNs(when - NS_PER_MS // 8)
    return int(max(0, when - decided_ns) // NS_PER_US)


@dataclass(frozen=True, slots=True)
class WayBack:
    """Where the lens came to rest, and what was counted when it set out."""

    rest: LensReport
    begun_ns: HostNs
    events_before: int


def go_back(stage: Stage, watch: Watch, settings: CycleSettings, focus_um: float, sign: int) -> WayBack:
    """Go to where focus was, from the side the sweep came from: past it by more than the play, and then there."""
    limits = stage.parts.lens.limits
    begun_ns, events_before = stage.now_ns(), watch.events_in_cycle
    stage.listener = watch.count

    def move(target_um: float) -> LensReport:
        bounded = min(max(stage.to_steps(target_um), limits.min_steps), limits.max_steps)
        return stage.move(stage.to_um(bounded), settings.speed_um_s, limits.acceleration_sps2)

    move(focus_um - sign * (settings.backlash_um + APPROACH_MARGIN_UM))
    return WayBack(move(focus_um), begun_ns, events_before)


def verify(
    stage: Stage, watch: Watch, settings: CycleSettings, way: WayBack, *, focus_um: float, stop_um: float
) -> int:
    """See that the lens is where it was sent, and that the scene changed on the way: reports alone prove nothing.

    Returns the events above noise that the way back made. Raises ``Ended`` if either is not so.
    """
    error_um = stage.to_um(way.rest.steps) - focus_um
    if abs(error_um) > max(0.25 * settings.depth_of_focus_um, 2 * stage.um_per_step):
        raise Ended(
            Outcome.LENS_DID_NOT_MOVE,
            f"the lens rests {error_um:+.1f} um from where it was sent; check the motor current and the mechanics",
        )
    stage.hear(safety.CAMERA_SILENCE_MS)
    resting_hz, way_back_um = watch.resting_rate_hz, abs(stop_um - focus_um)
    seen = watch.events_in_cycle - way.events_before
    seen -= round(resting_hz * (stage.now_ns() - way.begun_ns) / NS_PER_S)
    expected = watch.events_within(focus_um, stop_um) - round(resting_hz * way_back_um / settings.speed_um_s)
    score = watch.return_score(focus_um)
    if score is not None and score >= RETURN_SIGMAS:
        return seen
    if way_back_um > settings.depth_of_focus_um and seen < RETURN_SHARE * expected:
        raise Ended(
            Outcome.LENS_DID_NOT_MOVE,
            f"the controller says that the lens went back {way_back_um:.0f} um, but the scene did not change "
            f"({seen} events above noise, {expected} on the way out); check the coupling between motor and lens",
        )
    return seen
