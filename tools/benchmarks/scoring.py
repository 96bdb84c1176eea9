"""Rows of numbers to a table: errors where there is an answer, and how often there is none or a wrong one.

A mean over the cases that were answered flatters whoever refuses the hard ones, so misses and answers outside one depth
of focus are counted beside it, never mixed into it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.published import published_mae_um, published_times_ms, rerun_mae_um
from benchmarks.sets import SETS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from benchmarks.rows import Row


@dataclass(frozen=True, slots=True)
class Score:
    """One method at one frame rate over the cases of one set and motion; lengths in um, ``None`` without answers.

    ``missed`` had no answer, ``outside`` one more than a depth of focus from the truth, ``early`` a decision more than
    a depth of focus before it, ``wrong_way`` took the approach for receding. Where nothing is there to be focused on,
    every answer is outside. ``to_sharpest_um`` is the MAE against the sharpest picture. ``spread`` is the RMS of error
    over claimed sigma, honest sigmas make it one, ``beyond_two`` the share of errors beyond two sigma. ``limit_um`` is
    the median of the cases' statistical limits to scatter (``limit``). Of whole cycles ``crossed_again`` counts those
    that went over focus more than once, ``again_ms`` is the median time of theirs that it took.
    """

    set_name: str
    motion: str
    method: str
    rate: str
    cases: int
    missed: int
    outside: int
    early: int
    wrong_way: int
    mae_um: float | None
    bias_um: float | None
    worst_um: float | None
    to_sharpest_um: float | None
    decided_um: float | None
    focusing_ms: float | None
    crossed_again: int | None
    again_ms: float | None
    cpu_ms: float
    spread: float | None
    beyond_two: float | None
    limit_um: float | None
    published_um: float | None
    published_focusing_ms: float | None
    published_cpu_ms: float | None
    rerun_um: float | None

    def as_dict(self) -> dict[str, Any]:
        """Return the score as plain data."""
        return asdict(self)


def scores(rows: Iterable[Row]) -> list[Score]:
    """Return one score per set, motion, method and rate, in the order of first appearance."""
    groups: dict[tuple[str, str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.set_name, row.motion, row.method, row.rate), []).append(row)
    return [_score(key, group) for key, group in groups.items()]


def _score(key: tuple[str, str, str, str], rows: Sequence[Row]) -> Score:
    set_name, motion, method, rate = key
    limit_um = SETS[set_name].depth_of_focus_um
    nothing_there = SETS[set_name].nothing_there
    errors = np.array([row.error_um for row in rows if row.error_um is not None], dtype=np.float64)
    decided = np.array([row.decided_um for row in rows if row.decided_um is not None], dtype=np.float64)
    focusing = np.array([row.focusing_ms for row in rows if row.focusing_ms is not None], dtype=np.float64)
    claimed = np.array([row.error_um / row.sigma_um for row in rows if row.error_um is not None and row.sigma_um])
    limits = np.array([row.limit_um for row in rows if row.limit_um is not None], dtype=np.float64)
    lived = [row.again_ms for row in rows if row.again_ms is not None]
    again = [one for one in lived if one > 0.0]
    apart = np.array([row.error_um - row.sharpest_um for row in rows if row.error_um is not None])
    answered = errors.size > 0
    return Score(
        set_name=set_name,
        motion=motion,
        method=method,
        rate=rate,
        cases=len(rows),
        missed=len(rows) - errors.size,
        outside=errors.size if nothing_there else int((np.abs(errors) > limit_um).sum()),
        early=int((decided < -limit_um).sum()),
        wrong_way=sum(row.details.get("direction") == "receding" for row in rows),
        mae_um=round(float(np.abs(errors).mean()), 3) if answered else None,
        bias_um=round(float(errors.mean()), 3) if answered else None,
        worst_um=round(float(np.abs(errors).max()), 3) if answered else None,
        to_sharpest_um=round(float(np.abs(apart).mean()), 3) if answered else None,
        decided_um=round(float(np.median(decided)), 2) if decided.size else None,
        focusing_ms=round(float(np.median(focusing)), 1) if focusing.size else None,
        crossed_again=len(again) if lived else None,
        again_ms=round(float(np.median(again)), 1) if again else None,
        cpu_ms=round(float(np.median([row.cpu_ms for row in rows])), 2),
        spread=round(float(np.sqrt(np.mean(claimed**2))), 3) if claimed.size else None,
        beyond_two=round(float((np.abs(claimed) > 2.0).mean()), 4) if claimed.size else None,
        limit_um=round(float(np.median(limits)), 3) if limits.size else None,
        published_um=published_mae_um(set_name, method, rate, motion),
        published_focusing_ms=published_times_ms(set_name, method)[1],
        published_cpu_ms=published_times_ms(set_name, method)[0],
        rerun_um=rerun_mae_um(method, rate, motion) if set_name == "syn" else None,
    )
