"""One goal and the verdict on it: in words, for recorded sweeps and for whole cycles alike."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

MET, NOT_MET, UNMEASURED = "met", "not met", "not measured"
SO_FAR = " so far"

TRIALS = 200
EARLY_SHARE = 0.02
ABSTAIN_SHARE, ABSTAIN_SHARE_SHAKE = 0.05, 0.10
ONE_WAY_MS = 100.0


@dataclass(frozen=True, slots=True)
class Accuracy:
    """A goal for the mean error on one set, motion and frame rate; beside it the paper's claim, if it is another."""

    set_name: str
    motion: str
    rate: str
    mae_um: float
    claim: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """A line of the table: the goal, who measured it on how many of how many trials, what, and what others have."""

    goal: str
    source: str
    trials: int
    wanted: int
    mae_um: float | None = None
    worst_um: float | None = None
    missed: int | None = None
    abstained_share: float | None = None
    outside: int | None = None
    early: int | None = None
    other: str = ""
    beside: str = ""
    verdict: str = UNMEASURED

    def as_dict(self) -> dict[str, Any]:
        """Return the line as plain data."""
        return asdict(self)


def state(*, over: bool, trials: int, wanted: int, broken: bool = False) -> str:
    """Return the verdict in words.

    *over* says that a mean or a share is over its limit, which more trials may change; *broken* what none can mend.
    """
    if trials == 0:
        return UNMEASURED
    if broken:
        return NOT_MET
    return (NOT_MET if over else MET) + ("" if trials >= wanted else SO_FAR)


def direction_state(wrong: int, allowed: int, trials: int) -> str:
    """Return the verdict on directions: so many wrong of so many, in proportion where there are more than 200."""
    over = wrong > allowed * max(1.0, trials / TRIALS)
    return state(over=over, broken=over and allowed == 0, trials=trials, wanted=TRIALS)


def tell(table: Sequence[Verdict]) -> list[str]:
    """Return the table as lines of text."""
    lines = []
    for one in table:
        parts = [f"{one.verdict:14s} {one.goal}"]
        told = f", {one.trials} of {one.wanted}: {measured(one)}" if one.trials else ""
        parts.append(f"{one.source}{told}")
        lines.append("  ".join(parts))
    return lines


def measured(one: Verdict) -> str:
    """Return what was measured, in words."""
    numbers = {"MAE {:.2f} um": one.mae_um, "worst {:.2f} um": one.worst_um, "{} without answer": one.missed or None}
    numbers |= {
        "{:.1%} abstained": one.abstained_share,
        "{} OUTSIDE": one.outside or None,
        "{} early": one.early or None,
    }
    told = [words.format(value) for words, value in numbers.items() if value is not None]
    return ", ".join([*told, one.other] if one.other else told) or "nothing to report"
