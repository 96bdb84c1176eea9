"""Motions without a cycle, on the focus thread: told while they go, ended when somebody wants it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.errors import LensError, UnreferencedError
from elpd.focus.settings import CycleSettings
from elpd.motion.errand import Errands

if TYPE_CHECKING:
    from elpd.config import Config
    from elpd.motion.errand import Arrival
    from elpd.ports import RigParts
    from elpd.service.attention import Attention
    from elpd.service.job import Job
    from elpd.service.situation import Situation

HOME_LIMIT_S = 30.0
"""No lens this is for takes longer to find its reference; what `elpd home` allows."""

APPROACH_MARGIN_UM = 1.0
"""How much further than the play an approach begins, as a cycle's does."""


class Moves:
    """Sends the lens of *parts* somewhere for a *job*, by the speed of *config*; each method ends at rest.

    Raises ``UsageError`` for a place outside the limits, ``LensError`` from the lens.
    """

    def __init__(self, situation: Situation, attention: Attention) -> None:
        self._situation = situation
        self._attention = attention

    def home(self, job: Job, parts: RigParts) -> Arrival:
        """Find the reference. Raises ``UnreferencedError`` where somebody stopped that."""
        with self._attention.without_signs(HOME_LIMIT_S + 1.0):
            try:
                return self._errands(job, parts).home(1000.0 * HOME_LIMIT_S)
            except LensError as error:
                if job.cancelled:
                    raise UnreferencedError(f"homing was stopped on request; home the lens again ({error})") from None
                raise

    def to(self, job: Job, target_um: float, parts: RigParts, config: Config) -> Arrival:
        """Go to a place."""
        return self._errands(job, parts).move_to(target_um, CycleSettings.from_config(config).speed_um_s)

    def by(self, job: Job, by_um: float, parts: RigParts, config: Config) -> Arrival:
        """Go so much further."""
        return self._errands(job, parts).jog(by_um, CycleSettings.from_config(config).speed_um_s)

    def approach(
        self,
        job: Job,
        target_um: float,
        sign: int,
        parts: RigParts,
        config: Config,
    ) -> Arrival:
        """Go to a place and arrive there from the side that *sign* says (0: whichever), the play taken up."""
        low_um, high_um = self._errands(job, parts).limits_um
        play_um = CycleSettings.from_config(config).backlash_um + APPROACH_MARGIN_UM
        if sign * (target_um - self.here_um(parts)) < 0:
            arrival = self.to(job, min(max(target_um - sign * play_um, low_um), high_um), parts, config)
            if arrival.cancelled:
                return arrival
        return self.to(job, target_um, parts, config)

    def here_um(self, parts: RigParts) -> float:
        """Return where the lens is now."""
        return parts.scale.to_um(parts.lens.position_at(parts.clock.now_ns()).steps)

    def _errands(self, job: Job, parts: RigParts) -> Errands:
        interrupted = self._attention.question(job, parts.lens, moving=True)

        def asked() -> bool:
            self._situation.update_lens(position_um=self.here_um(parts), moving=True)
            return bool(interrupted())

        return Errands(parts.clock, parts.lens, parts.scale, asked)
