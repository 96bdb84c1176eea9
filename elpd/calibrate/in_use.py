"""What profiles of the lens change in a configuration: its ruler and the play that the final approach allows for.

The answer is a configuration, so that whoever records a run records what was in force, and a replay needs no profile.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.calibrate.lens import lens_profile
from elpd.calibrate.play import backlash_profile

if TYPE_CHECKING:
    from elpd.config import Config


def as_measured(config: Config) -> Config:
    """Return *config* with what profiles know better; the same object where there are none. Idempotent.

    A table in the configuration wins over the profile's. Raises ``FormatError`` for a profile that is damaged.
    """
    if not config.state.profiles:
        return config
    if not config.lens.steps_to_um:
        profile = lens_profile(config)
        if profile is not None and profile.steps_to_um:
            lens = config.lens.model_copy(update={"steps_to_um": profile.steps_to_um})
            config = config.model_copy(update={"lens": lens})
    play = backlash_profile(config)
    if play is not None:
        lens = config.lens.model_copy(update={"backlash_um": play.approach_um, "measured_play_um": play.measured_um})
        config = config.model_copy(update={"lens": lens})
    return config
