"""The early end of a cycle: focus cannot be had, and here is why."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.errors import CameraError
from elpd.focus.safety import Action, Verdict

if TYPE_CHECKING:
    from elpd.records import Outcome


class Ended(Exception):  # noqa: N818  (an early end of the cycle, not an error)
    """Focus cannot be had; leave with an outcome."""

    def __init__(self, outcome: Outcome, reason: str) -> None:
        super().__init__(reason)
        self.outcome = outcome
        self.reason = reason


class Beside(Ended):
    """Focus lies behind whichever way the lens goes: it began in focus, or beside it."""


def ended_by(verdict: Verdict) -> Exception:
    """Return what a rule's verdict is to raise: a camera's fault, or an early end."""
    if verdict.action is Action.FAULT:
        return CameraError(verdict.reason)
    if verdict.outcome is None:
        raise AssertionError(f"a rule without an outcome: {verdict}")
    return Ended(verdict.outcome, verdict.reason)
