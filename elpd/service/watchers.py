"""Who is told while something is done: the listeners, of phases, windows and places."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from elpd.service.messages import PhaseEvent, SampleEvent

if TYPE_CHECKING:
    from elpd.records import ElpSample
    from elpd.service.attention import Attention
    from elpd.service.situation import Situation


class Audience:
    """``elpd.focus.cycle.Observer`` for the engine's listeners."""

    def __init__(self, situation: Situation, attention: Attention) -> None:
        self._situation = situation
        self._attention = attention

    def phase(self, name: str, /, **fields: Any) -> None:
        """Hear that a phase begins."""
        self._attention.enter(name)
        progress = fields.get("progress")
        self._situation.set_phase(None if name == "done" else name)
        self._situation.tell(PhaseEvent(phase=name, progress=progress))

    def sample(self, sample: ElpSample, score: float, /) -> None:
        """Hear of one window."""
        position_um = sample.position_um if math.isfinite(sample.position_um) else None
        self._situation.tell(
            SampleEvent(
                t_us=int(sample.end_us),
                position_um=position_um,
                elp=int(sample.elp),
                score=score if math.isfinite(score) else None,
                events=sample.n_on + sample.n_off,
            )
        )
        self._situation.update_lens(position_um=position_um, moving=True)
