"""What one method made of one case: a line of the tables."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchmarks.cases import SweepRecording


@dataclass(frozen=True, slots=True)
class Row:
    """One method on one case. ``None`` where there is no answer.

    ``error_um`` is estimate less truth, ``sharpest_um`` where the picture itself is sharpest, on the same ruler,
    ``limit_um`` how well the signs of its events could tell focus at best (``limit``), ``decided_um`` how far past
    focus the lens was when the answer could be given, ``focusing_ms`` the time from the start of the sweep until the
    lens could be back at the estimate, without braking. Of a whole cycle they are where the glass rests, how far past
    focus the sweep was stopped, and the time from the start of the sweep until focus is verified; ``again_ms`` is what
    passes after the sweep took of it, nothing where one was enough.
    """

    case: str
    seed: int
    set_name: str
    scene: str
    fov: int
    motion: str
    method: str
    rate: str
    events: int
    error_um: float | None
    sigma_um: float | None
    decided_um: float | None
    focusing_ms: float | None
    sharpest_um: float
    limit_um: float | None
    cpu_ms: float
    reason: str
    again_ms: float | None = None
    details: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the row as plain data."""
        return asdict(self)


def row_of(
    recording: SweepRecording,
    method: str,
    rate: str,
    *,
    error_um: float | None,
    sigma_um: float | None,
    decided_um: float | None,
    focusing_ms: float | None,
    cpu_ms: float,
    events: int,
    again_ms: float | None,
    reason: str,
    details: dict[str, Any],
) -> Row:
    """Return a row from numbers of which ``None`` or ``nan`` says that there is none."""
    case = recording.case
    return Row(
        case=case.name,
        seed=case.seed,
        set_name=case.set_name,
        scene=case.scene,
        fov=case.fov,
        motion=case.motion,
        method=method,
        rate=rate,
        events=events,
        error_um=_or_none(error_um),
        sigma_um=_or_none(sigma_um),
        decided_um=_or_none(decided_um),
        sharpest_um=round(recording.sharpest_um, 4),
        limit_um=_or_none(recording.sign_limit_um),
        focusing_ms=_or_none(focusing_ms),
        again_ms=_or_none(again_ms),
        cpu_ms=round(cpu_ms, 3),
        reason=reason,
        details=details,
    )


def _or_none(value: float | None) -> float | None:
    return round(value, 4) if value is not None and math.isfinite(value) else None
