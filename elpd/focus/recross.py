"""More passes over focus, there and back, where one is not to be believed: the scene moves, or the light is dim.

Whatever answers late (photoreceptors, pixels that hold back less than a threshold, motion that dithers them) is late by
as much on the way back as on the way there, at the same speed: the mean of the two knows focus, and what is left is the
play between motor and carriage and what the motion did by chance. The chance is another one in each pass, so passes are
made until the answer is good enough or there have been enough of them. They are as fast as the sweep, because a scene
strays with time: a slow pass sees more of its motion.

In a still scene it is dim light that asks for another pass. Photoreceptors are late there by more than an answer may be
off, and what one pass tells of that hangs on which pixels are how dark. One way back does, at the sweep's speed. But in
dim light few pixels turn, and many of those by noise, so one pass cannot tell that from several depths; two can.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot, sqrt
from typing import TYPE_CHECKING

import numpy as np

from elpd.focus import judging, safety
from elpd.focus.approach import APPROACH_MARGIN_UM
from elpd.focus.passes import Play
from elpd.records import StopMode
from elpd.units import after_ms

if TYPE_CHECKING:
    from elpd.focus.settings import CycleSettings
    from elpd.focus.stage import Stage
    from elpd.focus.watch import Watch
    from elpd.records import FocusEstimate
    from elpd.units import HostNs

REACH_DOF = 6.0
"""How far to both sides of focus a pass leads at full speed at the most: a width of the curve, and the way by which
pixels answer late."""

RUN_UP_DOF = 3.5
"""How far from focus a pass is at full speed at the latest: that much of the curve beside its top is believed."""

RUN_UP_PAIRS = 2.0
"""The same in a still scene, in lengths by which pairs begin before focus: in dim light or low contrast a pixel sends
one event in tens of micrometres, and one more than a pair's own two has to undo what it held back when the lens turned.
After half as much, midpoints in dim light lie 1 to 3 um later than those of the sweep, and the image's top as well."""

MOST_RUN_UP_DOF = 25.0
"""How far from focus it begins at the most."""

MOST_DOUBT_DOF = 1.0
"""An answer that is off by more than this beside the reach has no second opinion."""

CERTAIN_SIGMAS = 3.0
"""So many standard errors are to lie within a depth of focus; until they do there are further rounds."""

MOST_ROUNDS = 4
"""Further rounds, there and back, at the most: seven to nine passes halve the error of two."""

LOOKS_FOR_MOTION = 1
"""Rounds that are spent on seeing whether a scene moves that was taken for still: hands tremble at 5 Hz and faster, and
two passes and a round last long enough for one to be seen on its way."""

ROUNDS_LEFT = 2.0
"""How many more rounds there must be time for, so that one is begun: the way to focus takes less than one."""


def is_needed(watch: Watch, first: FocusEstimate | None, settings: CycleSettings) -> bool:
    """Say whether one pass is not enough: the scene has been seen to move, or a still one's answer is not certain.

    Where motion was suspected at rest and the answer is doubtful, the scene is taken for one that moves after all.
    Where events were lost near focus, a lamp flickers or several depths were told, other passes would not help.
    """
    after = watch.after
    if after.gap_near_crossing or watch.lit:
        return False
    doubtful = not after.depths_um and (first is None or first.sigma_um > judging.limit_um(settings))
    if not watch.scene_moves and doubtful and watch.motion_suspected:
        after.take_for_moving()
    if watch.scene_moves or doubtful:
        return True
    if first is None or after.depths_um:
        return False
    return not _certain(first, settings) or (settings.cross_again == "better" and _pays(first, settings))


def _pays(first: FocusEstimate, settings: CycleSettings) -> bool:
    """Say whether the mean of two passes would be better known than a still scene's first answer.

    It knows all but half the play, of which the bound is taken even if it was measured: what is good enough without
    another pass stays so. What the lens has of its own is in both.
    """
    half_play_um = 0.5 * Play.up_to(settings.backlash_um).sigma_um
    return first.sigma_um**2 - first.lasting_um**2 > half_play_um**2


def _certain(estimate: FocusEstimate | None, settings: CycleSettings) -> bool:
    certain_um = min(settings.depth_of_focus_um / CERTAIN_SIGMAS, judging.limit_um(settings))
    return estimate is not None and estimate.sigma_um <= certain_um


def _lessened(estimate: FocusEstimate | None, settings: CycleSettings) -> FocusEstimate | None:
    """Return a still scene's answer by passes there and back with the part of its error that more would lessen.

    They do not lessen what the lens has of its own, nor half the play; and the longer they take, the likelier noise is
    taken for motion.
    """
    if estimate is None:
        return None
    stays_um = hypot(estimate.lasting_um, 0.5 * Play.known(settings).sigma_um)
    return replace(estimate, sigma_um=sqrt(max(0.0, estimate.sigma_um**2 - stays_um**2)))


def pass_again(
    stage: Stage,
    watch: Watch,
    settings: CycleSettings,
    first: FocusEstimate | None,
    sign: int,
    deadline_ns: HostNs,
    furthest_um: float,
) -> tuple[FocusEstimate | None, float]:
    """Go over focus again until it is known or there is no more time: back, and then there and back.

    Returns what all passes say and the furthest place, um, in the sweep's direction; *furthest_um* is how far the sweep
    went, from where the lens may be on its way back by now. In a still scene a doubtful answer may come of several
    depths; more passes would only make their mixture look certain. So they are believed only if they tell that the
    region is flat (``vision.relief``), or if one of them has seen the scene move, which a hand that turned round in the
    first did not show; else the answer stays as it was.

    The way is bounded: a few times the reach, the ramps and the play; its time is the caller's phase ``recross``. The
    lens is left on the side that the sweep came from.
    """
    answer = estimate = first
    past_um = 0.0 if watch.scene_moves else watch.after.past_um
    for looks, ways in enumerate([(-sign,), *MOST_ROUNDS * [(sign, -sign)]]):
        begun_ns = stage.now_ns()
        about_um = watch.after.peak_um if estimate is None else estimate.focus_um
        doubt_um = MOST_DOUBT_DOF * settings.depth_of_focus_um
        if estimate is not None:
            doubt_um = min(doubt_um, estimate.sigma_um)
        for way in ways:
            _pass(stage, watch, settings, _Way(way, about_um, doubt_um, past_um))
            furthest_um = sign * max(sign * furthest_um, sign * stage.here_um())
            estimate = watch.after.estimate()
        took_ns = stage.now_ns() - begun_ns
        if watch.scene_moves or watch.after.flat:
            doubt = estimate if watch.scene_moves else _lessened(estimate, settings)
            answer, enough = estimate, _certain(doubt, settings)
        elif watch.after.flat is None:
            enough = False  # and what was believed before this round still is
        else:
            answer, enough = _mixed(first, settings), looks == LOOKS_FOR_MOTION
        if enough or stage.now_ns() + ROUNDS_LEFT * took_ns > deadline_ns:
            break
    return answer, furthest_um


def _mixed(first: FocusEstimate | None, settings: CycleSettings) -> FocusEstimate | None:
    """Return the first answer with the error that it has where the region is not at one depth.

    That is half a depth of focus, beyond which it is not flat, at the least.
    """
    if first is None:
        return None
    return replace(first, sigma_um=hypot(first.sigma_um, judging.limit_um(settings)))


@dataclass(frozen=True, slots=True)
class _Way:
    """In which direction to pass about which place, how well that is known, and how far past the peak to go at least.

    What pixels have not answered yet when a pass ends tilts its answer, so in a still scene, where that shows, each
    goes as far past its peak as the sweep did.
    """

    sign: int
    about_um: float
    doubt_um: float
    past_um: float


def _run_up_um(watch: Watch, settings: CycleSettings) -> float:
    least_um, most_um = (dof * settings.depth_of_focus_um for dof in (RUN_UP_DOF, MOST_RUN_UP_DOF))
    if watch.scene_moves:
        return least_um
    return float(np.clip(RUN_UP_PAIRS * watch.after.pairs_begin_um, least_um, most_um))


def _pass(stage: Stage, watch: Watch, settings: CycleSettings, going: _Way) -> None:
    """Lead the lens over a place in one direction, until focus has been seen to be passed."""
    way, about_um, doubt_um = going.sign, going.about_um, going.doubt_um
    limits, capabilities = stage.parts.lens.limits, stage.parts.lens.capabilities
    speed_um_s = min(settings.speed_um_s, stage.to_um(limits.max_speed_sps))
    ramp_um = speed_um_s**2 / (2.0 * stage.to_um(limits.acceleration_sps2))
    beside_um = ramp_um + settings.backlash_um + APPROACH_MARGIN_UM
    reach_um = REACH_DOF * settings.depth_of_focus_um + doubt_um
    begin_um = stage.within_limits_um(about_um - way * (_run_up_um(watch, settings) + doubt_um))
    end_um = stage.within_limits_um(about_um + way * (reach_um + going.past_um + beside_um))
    if way * (stage.here_um() - begin_um) > stage.um_per_step:
        watch.after.catch_up()
        stage.listener = watch.follow
        stage.move(begin_um, stage.to_um(limits.max_speed_sps))
    taken_up_um = way * stage.here_um() + settings.backlash_um
    watch.after.begin_again(way, way * max(taken_up_um, way * about_um - reach_um))
    stage.listener = watch.after.pass_again
    if capabilities.native_velocity and capabilities.abrupt_stop:
        stage.send(end_um, speed_um_s)
        until = after_ms(stage.now_ns(), stage.travel_limit_ms(end_um, speed_um_s))
        while stage.now_ns() < until:
            stage.read()
            if watch.after.seen_again and watch.after.past_um >= going.past_um:
                break
            if way * (stage.here_um() - end_um) > -stage.um_per_step:
                break
        stage.parts.lens.stop(StopMode.ABRUPT)
    else:
        stage.move(end_um, speed_um_s)
        stage.hear(safety.CAMERA_SILENCE_MS)
    watch.after.passed_again()
    stage.listener = watch.after.hear_out
