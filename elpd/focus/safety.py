"""The rules that end a sweep, as one pure function.

Whoever runs the loop fills in ``Conditions`` (numbers, no devices) and obeys the ``Verdict``. Actions are ordered by
precedence, later ones win, as in PX4's failsafe: a cancelled cycle that also lost its camera is a camera fault. The
limits are constants with their reasons, not options: nobody can set them better than the physics does.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import sqrt
from typing import TYPE_CHECKING

from elpd.records import Outcome

if TYPE_CHECKING:
    from collections.abc import Iterator

CAMERA_SILENCE_MS = 50.0
"""A live camera speaks at least every few ms even when nothing happens; a lens at 4 mm/s goes 200 um in this time."""

DARK_TRAVEL_DOF = 8.0
"""Eight depths of focus of travel without events: no scene does that except a dark one (lens cap)."""

DARK_EVENTS = 20
DARK_SIGMAS = 6.0
"""A scene in the light stands this far above what noise alone makes, in events and in its standard deviations."""

HEARD_MS = 5.0
"""Nobody can call it dark while the camera says nothing at all: that is silence, and has a rule of its own."""

STUCK_TRAVEL_DOF = 4.0
"""The commanded motion must show in the reports before the lens should have travelled this far."""

STUCK_SHARE = 0.2
"""A lens that has done less than a fifth of what it was told is stuck, not slow."""

LOSS_LIMIT = 0.2
"""Sums stay fair while a sensor sheds whole slices; beyond a fifth lost, nobody knows what was shed."""


class Action(IntEnum):
    """What to do, in order of precedence."""

    CONTINUE = 0
    GIVE_UP = 1
    CANCEL = 2
    FAULT = 3


@dataclass(frozen=True, slots=True)
class Conditions:
    """Everything the rules look at, measured at one moment of a sweep."""

    cancelled: bool = False
    ms_to_deadline: float = float("inf")
    camera_silent_ms: float = 0.0
    travel_um: float = 0.0
    """Modelled travel since this sweep direction began."""
    trodden_um: float = 0.0
    """How much of it leads back over the way that was just come, on which events undo one another."""
    commanded_travel_um: float = 0.0
    """Travel that the commands alone ask for at the time of the newest report, turning and starting allowed for."""
    reported_travel_um: float | None = None
    """Travel by the controller's newest report, ``None`` before the first one."""
    max_travel_um: float = float("inf")
    way_to_limit_um: float = float("inf")
    depth_of_focus_um: float = 6.0
    events: int = 0
    """Events inside the ROI since this sweep direction began."""
    resting_events: float = 0.0
    """Events that noise alone would have made in the same time."""
    resting_counted: float = float("inf")
    """How many events that was learnt from."""
    lit: bool = False
    """Whether it is known that the scene is in the light: few events mean a lens far from focus, or stuck."""
    lost_fraction: float = 0.0
    """Share of events lost since the cycle began."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What to do and why; ``outcome`` is set for ``GIVE_UP`` and ``CANCEL``."""

    action: Action
    outcome: Outcome | None = None
    reason: str = ""


def decide(now: Conditions) -> Verdict:
    """Return the verdict of highest precedence (pure)."""
    return max(_verdicts(now), key=lambda verdict: verdict.action, default=Verdict(Action.CONTINUE))


def is_dark(now: Conditions) -> bool:
    """Say whether the events of this direction do not stand above noise (pure)."""
    noise = now.resting_events
    variance = noise + noise * noise / max(1.0, now.resting_counted)
    return now.events < noise + DARK_EVENTS + DARK_SIGMAS * sqrt(variance)


def _verdicts(now: Conditions) -> Iterator[Verdict]:
    if now.camera_silent_ms > CAMERA_SILENCE_MS:
        yield Verdict(
            Action.FAULT,
            reason=f"camera: silent for {now.camera_silent_ms:.0f} ms (limit {CAMERA_SILENCE_MS:.0f}); "
            "check its cable, then clear the fault",
        )
    if now.cancelled:
        yield Verdict(Action.CANCEL, Outcome.CANCELLED, "cancelled on request; the lens was stopped")
    if now.ms_to_deadline <= 0:
        yield Verdict(
            Action.CANCEL, Outcome.DEADLINE, "the deadline passed before focus was found; raise focus.deadline_ms"
        )
    if now.lost_fraction > LOSS_LIMIT:
        yield Verdict(
            Action.GIVE_UP,
            Outcome.EVENTS_LOST,
            f"{now.lost_fraction:.0%} of the events were lost (limit {LOSS_LIMIT:.0%}); "
            "choose a smaller ROI, a slower sweep or a higher contrast threshold",
        )
    asked_um = now.commanded_travel_um
    stuck = asked_um > STUCK_TRAVEL_DOF * now.depth_of_focus_um
    if stuck and now.reported_travel_um is not None and now.reported_travel_um < STUCK_SHARE * asked_um:
        yield Verdict(
            Action.GIVE_UP,
            Outcome.LENS_DID_NOT_MOVE,
            f"the lens should have moved {asked_um:.0f} um and reports {now.reported_travel_um:.0f}; "
            "check that the motor is energised and free",
        )
    dark_um = DARK_TRAVEL_DOF * now.depth_of_focus_um
    if now.travel_um - now.trodden_um > dark_um and not now.lit and is_dark(now) and now.camera_silent_ms < HEARD_MS:
        yield Verdict(
            Action.GIVE_UP,
            Outcome.TOO_FEW_EVENTS,
            f"only {now.events} events in the ROI over {now.travel_um:.0f} um of travel "
            f"({now.resting_events:.0f} are noise); "
            "is it dark, is the lens cap on, is the ROI empty?",
        )
    if now.travel_um >= now.max_travel_um or now.way_to_limit_um <= 0:
        yield Verdict(
            Action.GIVE_UP,
            Outcome.NO_CROSSING,
            f"no sign mutation within {now.travel_um:.0f} um of travel; "
            "is the subject within the lens's range? widen focus.max_travel_um or move the start",
        )
