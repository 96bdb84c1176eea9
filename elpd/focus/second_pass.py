"""A second pass over focus, at another speed in the same direction.

Photoreceptors answer late by a time; at another speed that is another way. So two passes tell it, and because both
lead in the direction of the sweep, the play of the mechanics is the same in both and does not enter. The second is
slow, which leaves little of the lag itself, and gives a camera with frames the time to take enough of them: frames know
neither lag nor threshold.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.focus import safety
from elpd.focus.approach import APPROACH_MARGIN_UM

if TYPE_CHECKING:
    from elpd.focus.settings import CycleSettings
    from elpd.focus.stage import Stage
    from elpd.focus.watch import Watch
    from elpd.records import LensReport

SPEED_SHARE = 0.25
"""Speed of the second pass over that of the first: the answer then holds a third of the first's error, no more."""

REACH_DOF = 4.0
"""How far to both sides of the first answer the second pass leads, beside that answer's own error: there the parabola
of log S has fallen by a third."""

MOST_DOUBT_DOF = 1.0
"""An answer that is off by more than this beside the reach has no second opinion."""

FRAMES = 5
"""How many frames the second pass makes time for: three for a parabola, two to judge it by."""


def is_needed(watch: Watch) -> bool:
    """Say whether one pass is not enough: the scene moved while the lens stood still.

    There only one kind of witness is left, and its lag is not measured. In a still scene a doubtful answer may come of
    several depths as well as of the lag; a second pass would make their mixture look certain, so such an answer is
    refused as it is. Where events were lost near focus, or a lamp flickers, whose periods already set the speed, a
    slower pass would not help.
    """
    return watch.scene_moves and not watch.gap_near_crossing and not watch.lit


def pass_again(
    stage: Stage, watch: Watch, settings: CycleSettings, about_um: float, sigma_um: float, sign: int
) -> LensReport:
    """Go back past *about_um* and over it again, slowly, from the side the sweep came from; return where it ended.

    The way is bounded: twice the reach and the play; its time is the caller's phase ``recross``.
    """
    reach_um = REACH_DOF * settings.depth_of_focus_um + min(sigma_um, MOST_DOUBT_DOF * settings.depth_of_focus_um)
    speed_um_s = SPEED_SHARE * settings.speed_um_s
    if watch.frame_period_us is not None:
        speed_um_s = min(speed_um_s, 1e6 * 2.0 * reach_um / (FRAMES * watch.frame_period_us))
    from_um = about_um - sign * reach_um
    begin_um = from_um - sign * (settings.backlash_um + APPROACH_MARGIN_UM)
    watch.catch_up()
    stage.listener = watch.follow
    stage.move(stage.within_limits_um(begin_um), settings.speed_um_s)
    stage.hear(safety.CAMERA_SILENCE_MS)
    watch.begin_again(speed_um_s, stage.sensor_clock.to_sensor(stage.now_ns()), from_um)
    stage.listener = watch.pass_again
    rest = stage.move(stage.within_limits_um(about_um + sign * reach_um), speed_um_s)
    stage.hear(safety.CAMERA_SILENCE_MS)
    watch.passed_again()
    stage.listener = watch.hear_out
    return rest
