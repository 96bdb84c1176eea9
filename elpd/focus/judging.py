"""Whether an estimate may be believed: the evidence carries it, or the cycle ends."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.focus.ended import Ended
from elpd.records import Outcome

if TYPE_CHECKING:
    from elpd.focus.settings import CycleSettings
    from elpd.records import FocusEstimate


def limit_um(settings: CycleSettings) -> float:
    """Return the largest error that an answer may have."""
    return settings.max_sigma_dof * settings.depth_of_focus_um


def demand(
    estimate: FocusEstimate,
    settings: CycleSettings,
    sign: int,
    way_um: tuple[float, float],
    lost_near_focus: int | None,
) -> None:
    """Raise ``Ended`` unless the answer is good enough.

    Parameters
    ----------
    estimate, settings, sign
        The answer, its limits, and the direction of the sweep.
    way_um
        From where to where the lens went.
    lost_near_focus
        How many events are known to be lost where some were lost while focus was passed; ``None`` where none were.

    """
    if lost_near_focus is not None:
        raise Ended(
            Outcome.EVENTS_LOST,
            f"events were lost while focus was passed ({lost_near_focus} known); "
            "choose a smaller ROI or a slower sweep",
        )
    most_um = limit_um(settings)
    if estimate.sigma_um > most_um:
        raise Ended(
            Outcome.LOW_CONFIDENCE,
            f"focus is known to {estimate.sigma_um:.1f} um only (limit {most_um:.1f}); "
            "choose a ROI with more contrast, more light, or less motion",
        )
    begun_um, ended_um = way_um
    if sign * (estimate.focus_um - ended_um) > settings.depth_of_focus_um:
        raise Ended(
            Outcome.LOW_CONFIDENCE,
            f"focus was put at {estimate.focus_um:.1f} um, which the sweep ({begun_um:.1f} to "
            f"{ended_um:.1f}) has not reached",
        )
