"""When the daemon focuses by itself: numbers in, a decision out. No clock, no lens, no log.

Hunting is the disease of continuous autofocus, so a cycle needs four things at once: evidence that sharpness was lost
(beyond one level to count as lost, below a half of it to count as found again), a scene that has become quiet, the end
of a hold-off since the last cycle, and a lens that nobody else has put where it is. The hold-off doubles with every
cycle that did not find focus or found it where it was; after ``MOST_FAILURES`` without focus the lens rests until
somebody asks. Before that it has been looked once whether focus is elsewhere (``elsewhere``).

A scene in which nothing changes sends no events, and what crept away unheard leaves no evidence; for that, and only if
it is set, focus is checked again when it was not for so long.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from elpd.service.messages import ModeName

MOST_DOUBLINGS = 6
"""The hold-off grows to 64 times what is configured."""

MOST_FAILURES = 7
"""Cycles in a row without focus, after which a scene is left alone."""

FOUND_AGAIN = 0.5
"""Sharpness is found again below this share of what counted as lost."""


@dataclass(frozen=True, slots=True)
class View:
    """What a decision rests on. Times are seconds of one clock.

    ``loss`` is how much sharpness was certainly lost, 1 being what counts as out of focus. ``defocused`` is the
    decision of before. ``since_s`` is the end of the last cycle, or when
    the mode was chosen. ``strikes`` counts cycles in a row that were of no use, ``failures`` those that did not even
    find focus; ``searched``, whether cycles were begun all over the lens's travel since it was found last.
    """

    mode: ModeName
    now_s: float
    blocked: str | None = None
    focused_once: bool = False
    loss: float | None = None
    defocused: bool = False
    quiet_s: float = 0.0
    since_s: float = 0.0
    strikes: int = 0
    failures: int = 0
    searched: bool = False


@dataclass(frozen=True, slots=True)
class Patience:
    """How long each thing takes."""

    hold_off_s: float
    settle_s: float
    period_s: float
    recheck_s: float = 0.0
    """0: never without evidence."""


@dataclass(frozen=True, slots=True)
class Decision:
    """Whether to focus now; else what is waited for, and for how long where that is known."""

    focus: bool
    defocused: bool
    waits_for: str
    left_s: float | None = None


def decide(view: View, patience: Patience) -> Decision:
    """Return what to do now (pure)."""
    defocused = is_defocused(view)

    def wait(why: str, left_s: float | None = None) -> Decision:
        return Decision(focus=False, defocused=defocused, waits_for=why, left_s=left_s)

    if view.mode in {"one-shot", "manual"}:
        return wait("somebody to ask" if view.mode == "one-shot" else "another mode")
    if view.blocked is not None:
        return wait(view.blocked)
    if view.mode == "scheduled":
        left_s = view.since_s + patience.period_s - view.now_s
        return wait("its time", left_s) if left_s > 0 else Decision(True, defocused, "nothing")
    if view.failures >= MOST_FAILURES:
        where = ", begun at places all over the lens's travel" if view.searched else ""
        return wait(f"somebody to ask, after {view.failures} cycles without focus{where}")
    left_s = view.since_s + hold_off_s(view, patience) - view.now_s
    if left_s > 0 and (view.focused_once or view.failures):
        return wait("the end of the hold-off", left_s)
    if not view.focused_once:
        return Decision(True, defocused, "nothing")
    recheck = patience.recheck_s > 0
    recheck_left_s = view.since_s + patience.recheck_s - view.now_s
    if not defocused and not (recheck and recheck_left_s <= 0):
        return wait("a loss of sharpness", recheck_left_s if recheck else None)
    if view.loss is not None and view.quiet_s < patience.settle_s:
        return wait("the scene to become quiet", patience.settle_s - view.quiet_s)
    return Decision(True, defocused, "nothing")


def is_defocused(view: View) -> bool:
    """Say whether focus counts as lost, with hysteresis (pure)."""
    if view.loss is None:
        return False
    if view.defocused:
        return view.loss > FOUND_AGAIN
    return view.loss > 1.0


def hold_off_s(view: View, patience: Patience) -> float:
    """Return how long the lens is left alone after a cycle (pure)."""
    return float(patience.hold_off_s * 2 ** min(view.strikes, MOST_DOUBLINGS))
