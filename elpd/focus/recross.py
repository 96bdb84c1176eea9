"""More passes over focus, there and back, where one is not to be believed: the scene moves, or the light is dim.

Whatever answers late (photoreceptors, pixels that hold back less than a threshold, motion that dithers them) is late by
as much on the way back as on the way there, at the same speed: the mean of the two knows focus, and what is left is the
play between motor and carriage and what the motion did by chance. The chance is another one in each pass, so passes are
made until the answer is good enough or there have been enough of them. They are as fast as the sweep, because a scene
strays with time: a slow pass sees more of its motion.

In a still scene it is dim light that asks for another pass. Photoreceptors are late there by more than an answer may be
off, and what one pass tells of that hangs on which pixels are how dark. One way back does, at the sweep's speed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.focus import judging, safety
from elpd.focus.approach import APPROACH_MARGIN_UM

if TYPE_CHECKING:
    from elpd.focus.settings import CycleSettings
    from elpd.focus.stage import Stage
    from elpd.focus.watch import Watch
    from elpd.records import FocusEstimate
    from elpd.units import HostNs

REACH_DOF = 6.0
"""How far to both sides of focus a pass leads at full speed: a width of the curve, and the way by which pixels answer
late."""

MOST_DOUBT_DOF = 1.0
"""An answer that is off by more than this beside the reach has no second opinion."""

MOST_ROUNDS = 3
"""Rounds, there and back, at the most: six passes halve the error of one and a half, and take a quarter of a second."""

SIGMAS = 3.0
"""So many standard errors may a lag lie from what was taken off for it; a depth of focus has to hold them."""

ROUNDS_LEFT = 2.0
"""How many more rounds there must be time for, so that one is begun: the way to focus takes less than one."""


def is_needed(watch: Watch, first: FocusEstimate | None, settings: CycleSettings) -> bool:
    """Say whether one pass is not enough: the scene has been seen to move, or its photoreceptors are slow.

    In a still scene a doubtful answer may come of several depths as well; more passes would only make their mixture
    look certain, so an answer that would be doubtful with its lag known is refused as it is. Where motion was suspected
    at rest, the scene is taken for one that moves after all, and what the first pass said of it as still is forgotten.
    Where events were lost near focus, or a lamp flickers, other passes would not help.
    """
    if watch.after.gap_near_crossing or watch.lit:
        return False
    doubtful = first is None or first.sigma_um > judging.limit_um(settings)
    if not watch.scene_moves and doubtful and watch.motion_suspected and not watch.after.depths_um:
        watch.after.take_for_moving()
    return watch.scene_moves or _is_dim(watch, settings)


def _is_dim(watch: Watch, settings: CycleSettings) -> bool:
    """Say whether the lag alone may put an answer out of focus, and nothing else is in the way of one."""
    lag_um, but_for_it_um = watch.after.lag_um
    clear = but_for_it_um <= judging.limit_um(settings) and not watch.after.depths_um
    return clear and SIGMAS * lag_um > settings.depth_of_focus_um


def pass_again(
    stage: Stage,
    watch: Watch,
    settings: CycleSettings,
    first: FocusEstimate | None,
    sign: int,
    deadline_ns: HostNs,
) -> tuple[FocusEstimate | None, float]:
    """Go over focus again, there and back, until it is known or there is no more time.

    Returns what all passes say and the furthest place, um, in the sweep's direction.

    The way is bounded: a few times the reach, the ramps and the play; its time is the caller's phase ``recross``. The
    lens is left on the side that the sweep came from.
    """
    estimate, most_um = first, judging.limit_um(settings)
    furthest_um = stage.here_um()
    for done in range(MOST_ROUNDS):
        begun_ns = stage.now_ns()
        about_um = watch.after.peak_um if estimate is None else estimate.focus_um
        doubt_um = MOST_DOUBT_DOF * settings.depth_of_focus_um
        if estimate is not None:
            doubt_um = min(doubt_um, estimate.sigma_um)
        # The sweep itself is half of a round, but where motion may have misled it by chance there is another first.
        for way in (sign, -sign) if done or watch.scene_moves else (-sign,):
            rest_um = _pass(stage, watch, settings, about_um, doubt_um, way)
            furthest_um = sign * max(sign * furthest_um, sign * rest_um)
            estimate = watch.after.estimate()
        took_ns = stage.now_ns() - begun_ns
        if estimate is not None and estimate.sigma_um <= most_um:
            break
        if stage.now_ns() + ROUNDS_LEFT * took_ns > deadline_ns:
            break
    return estimate, furthest_um


def _pass(stage: Stage, watch: Watch, settings: CycleSettings, about_um: float, doubt_um: float, way: int) -> float:
    """Lead the lens over *about_um* in one direction; return where it rests, um."""
    limits = stage.parts.lens.limits
    speed_um_s = min(settings.speed_um_s, stage.to_um(limits.max_speed_sps))
    reach_um = REACH_DOF * settings.depth_of_focus_um + doubt_um
    ramp_um = speed_um_s**2 / (2.0 * stage.to_um(limits.acceleration_sps2))
    away_um = reach_um + ramp_um + settings.backlash_um + APPROACH_MARGIN_UM
    begin_um, end_um = (stage.within_limits_um(about_um + side * way * away_um) for side in (-1, 1))
    watch.after.catch_up()
    stage.listener = watch.follow
    if abs(stage.here_um() - begin_um) > stage.um_per_step:
        stage.move(begin_um, stage.to_um(limits.max_speed_sps))
    stage.hear(safety.CAMERA_SILENCE_MS)
    watch.after.begin_again(way, stage.sensor_clock.to_sensor(stage.now_ns()), about_um - way * reach_um)
    stage.listener = watch.after.pass_again
    rest = stage.move(end_um, speed_um_s)
    stage.hear(safety.CAMERA_SILENCE_MS)
    watch.after.passed_again()
    stage.listener = watch.after.hear_out
    return stage.to_um(rest.steps)
