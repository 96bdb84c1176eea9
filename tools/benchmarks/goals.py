"""What the controller is to show, what was measured, and whether the one meets the other.

Every verdict is computed from rows. ``met`` and ``not met`` need every sweep that the goal is about. On some of them a
mean holds or does not hold *so far*, while one answer that must never be given is enough to break a goal. What nobody
measured says so. Each goal is held against two things that are not mixed: the detector's estimates on recorded sweeps,
one pass and no lens to stop, and whole cycles on the same cases, which cross focus again where the controller decides
to and count where the glass rests. Cycles of ``tools/acceptance.py``, on the simulated rig, stand beside them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.cases import cases_of
from benchmarks.methods import CYCLE, NO_FRAMES, OURS, rate_name
from benchmarks.published import SYN_MAE_UM, published_mae_um, rerun_mae_um
from benchmarks.sets import MAP, SETS
from benchmarks.verdict import (
    ABSTAIN_SHARE,
    ABSTAIN_SHARE_SHAKE,
    EARLY_SHARE,
    TRIALS,
    Accuracy,
    Verdict,
    direction_state,
    state,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from benchmarks.live import LiveRun
    from benchmarks.rows import Row

OFFLINE, LIVED = "one pass, recorded", "whole cycles"
_SOURCES = {OURS: OFFLINE, CYCLE: LIVED}
BESIDE = ("egs", "pbf", "esva", "elp-syn", "elp-syn-1fps", "elp-davis", "elp-evk4")
"""The peers whose means on the same sweeps stand beside ours."""

_HINDSIGHT_DAVIS, _HINDSIGHT_EVK4 = "paper: ELP 0.29 in hindsight", "paper: ELP 0.57 in hindsight"
ACCURACY = (
    Accuracy("syn", "static", "50", 1.0),
    Accuracy("syn", "moderate", "50", 1.2),
    Accuracy("syn", "violent", "50", 2.0),
    Accuracy("syn", "static", "20", 1.0),
    Accuracy("syn", "moderate", "20", 1.6),
    Accuracy("syn", "violent", "20", 2.5),
    Accuracy("syn", "static", "1", 1.0),
    Accuracy("syn", "moderate", "1", 2.5),
    Accuracy("syn", "violent", "1", 3.5),
    Accuracy("davis-bright", "static", "50", 0.6, _HINDSIGHT_DAVIS),
    Accuracy("davis-bright", "dynamic", "50", 1.5, _HINDSIGHT_DAVIS),
    Accuracy("davis-dark", "static", "20", 1.0, _HINDSIGHT_DAVIS),
    Accuracy("davis-dark", "dynamic", "20", 2.0, _HINDSIGHT_DAVIS),
    Accuracy("evk4-bright", "static", MAP, 0.8, _HINDSIGHT_EVK4),
    Accuracy("evk4-bright", "dynamic", MAP, 2.3, _HINDSIGHT_EVK4),
    Accuracy("evk4-dark", "static", MAP, 1.2, _HINDSIGHT_EVK4),
    Accuracy("evk4-dark", "dynamic", MAP, 3.0, _HINDSIGHT_EVK4),
    Accuracy("davis-bright", "shake", "50", 2.5, "nobody reports it"),
    Accuracy("evk4-bright", "shake", MAP, 5.0, "nobody reports it"),
)


def verdicts(rows: Sequence[Row], live: Sequence[LiveRun] = ()) -> list[Verdict]:
    """Return every goal with what was measured of it."""
    table: list[Verdict] = []
    # Who did not ask for cycles is not told of each goal that there were none.
    ours = [OURS, CYCLE] if any(row.method == CYCLE for row in rows) else [OURS]
    by_method = {method: {goal: _rows_of(goal, method, rows) for goal in ACCURACY} for method in ours}
    for goal in ACCURACY:
        table.extend(_accuracy(goal, method, by_method[method][goal], rows) for method in ours)
        table.extend(run.accuracy(goal) for run in live if run.concerns(goal))
    for method, by_goal in by_method.items():
        still = {goal: found for goal, found in by_goal.items() if goal.motion != "shake"}
        table.append(_abstentions("abstentions over all sets above but shake", method, still, ABSTAIN_SHARE))
    for method, by_goal in by_method.items():
        shaken = {goal: found for goal, found in by_goal.items() if goal.motion == "shake"}
        table.append(_abstentions("abstentions in shake", method, shaken, ABSTAIN_SHARE_SHAKE))
    table.extend(_nothing(rows, method) for method in ours)
    table.extend(_direction(rows, method, "static", 0, "paper: 40 % wrong without Laplacian") for method in ours)
    table.extend(_direction(rows, method, "violent", 1) for method in ours)
    for run in live:
        table.extend(run.others())
    if not live:
        table.append(
            Verdict("200 um to rest within 100 ms at 4 mm/s (160 with two crossings)", "tools/acceptance.py", 0, 1)
        )
    return table


def _rows_of(goal: Accuracy, method: str, rows: Iterable[Row]) -> list[Row]:
    place = (goal.set_name, goal.motion, goal.rate, method)
    return [row for row in rows if (row.set_name, row.motion, row.rate, row.method) == place]


def _seeds(rows: Iterable[Row]) -> int:
    return max(len({row.seed for row in rows}), 1)


def _accuracy(goal: Accuracy, method: str, found: Sequence[Row], rows: Sequence[Row]) -> Verdict:
    limit_um = SETS[goal.set_name].depth_of_focus_um
    errors = np.array([abs(row.error_um) for row in found if row.error_um is not None])
    missed, outside = len(found) - errors.size, int((errors > limit_um).sum())
    early = sum(row.decided_um is not None and row.decided_um < -limit_um for row in found)
    every = goal.set_name == "syn"
    words = f"{goal.set_name} {goal.motion}, {rate_name(goal.rate)}: MAE at most {goal.mae_um:g} um, "
    words += f"every case within {limit_um:g} um" if every else f"none FOCUSED outside {limit_um:g} um"
    if goal.motion == "shake":
        words += f", early below {EARLY_SHARE:.0%}"
    mae_um = float(errors.mean()) if errors.size else None
    over = mae_um is None or mae_um > goal.mae_um
    over = over or (goal.motion == "shake" and early >= EARLY_SHARE * len(found))
    broken = outside > 0 or (every and missed > 0)
    wanted = len(cases_of(goal.set_name, 0, f"*-{goal.motion}")) * _seeds(rows)
    return Verdict(
        words,
        _SOURCES[method],
        len(found),
        wanted,
        mae_um=mae_um,
        worst_um=float(errors.max()) if errors.size else None,
        missed=missed,
        abstained_share=missed / len(found) if found else None,
        outside=outside,
        early=early,
        other=_took(found),
        beside=_beside(goal, rows) if method == OURS else "",
        verdict=state(over=over, broken=broken, trials=len(found), wanted=wanted),
    )


def _took(found: Sequence[Row]) -> str:
    """Say what it cost in time, and how often focus was crossed again."""
    focusing_ms = [row.focusing_ms for row in found if row.focusing_ms is not None]
    told = [f"to focus {np.median(focusing_ms):.0f} ms"] if focusing_ms else []
    lived = [row.again_ms for row in found if row.again_ms is not None]
    again_ms = [one for one in lived if one > 0.0]
    if lived:
        told.append(f"{len(again_ms)} of {len(lived)} crossed again")
    if again_ms:
        told.append(f"for {np.median(again_ms):.0f} ms of it")
    return ", ".join(told)


def _beside(goal: Accuracy, rows: Sequence[Row]) -> str:
    """Return what the peers measured on the same sweeps, and what the literature claims on its own."""
    told = [goal.claim] if goal.claim else []
    if goal.set_name == "syn":
        for name, rate in SYN_MAE_UM:
            published = published_mae_um("syn", name, rate, goal.motion)
            if rate in (NO_FRAMES, goal.rate) and published is not None:
                told.append(f"paper: {name} {published:.2f}")
        rerun = rerun_mae_um("esva", NO_FRAMES, goal.motion)
        told.append(f"its authors: esva {rerun:.1f}")
    here = []
    for name in BESIDE:
        own = [
            row
            for row in rows
            if (row.set_name, row.motion, row.method) == (goal.set_name, goal.motion, name)
            and row.rate in (NO_FRAMES, goal.rate)
        ]
        errors = [abs(row.error_um) for row in own if row.error_um is not None]
        if own:
            without = f" ({len(own) - len(errors)} without answer)" if len(errors) < len(own) else ""
            here.append(f"{name} {np.mean(errors):.1f}{without}" if errors else f"{name} no answer")
    return "; ".join(told + (["here: " + ", ".join(here)] if here else []))


def _abstentions(words: str, method: str, by_goal: dict[Accuracy, list[Row]], limit: float) -> Verdict:
    found = [row for rows in by_goal.values() for row in rows]
    missed = sum(row.error_um is None for row in found)
    wanted = sum(len(cases_of(goal.set_name, 0, f"*-{goal.motion}")) for goal in by_goal) * _seeds(found)
    share = missed / len(found) if found else None
    return Verdict(
        f"{words}: below {limit:.0%}",
        _SOURCES[method],
        len(found),
        wanted,
        missed=missed,
        abstained_share=share,
        verdict=state(over=share is not None and share >= limit, trials=len(found), wanted=wanted),
    )


def _sweeps(rows: Iterable[Row]) -> int:
    """Count sweeps; one sweep seen with other frames is no other sweep."""
    return len({(row.case, row.seed) for row in rows})


def _nothing(rows: Sequence[Row], method: str) -> Verdict:
    names = [name for name, one in SETS.items() if one.nothing_there or one.flicker > 0.0]
    found = [row for row in rows if row.method == method and row.set_name in names]
    false = [
        row
        for row in found
        if row.error_um is not None
        and (SETS[row.set_name].nothing_there or abs(row.error_um) > SETS[row.set_name].depth_of_focus_um)
    ]
    sweeps = _sweeps(found)
    return Verdict(
        f"flat, cap, noise, flicker 30 %: 0 false FOCUSED in {TRIALS}",
        _SOURCES[method],
        sweeps,
        TRIALS,
        outside=len(false),
        other=f"{len(false)} false in {len(found)} runs on {sweeps} sweeps",
        verdict=state(over=False, broken=bool(false), trials=sweeps, wanted=TRIALS),
    )


def _direction(rows: Sequence[Row], method: str, motion: str, allowed: int, beside: str = "") -> Verdict:
    """Every sweep here begins before focus; from behind it, see the live runs."""
    shown = [
        row
        for row in rows
        if row.method == method
        and row.motion == motion
        and row.rate != NO_FRAMES
        and not SETS[row.set_name].nothing_there
        and not SETS[row.set_name].flicker
    ]
    wrong = _sweeps(row for row in shown if row.details.get("direction") == "receding")
    unknown = _sweeps(row for row in shown if row.details.get("direction") == "unknown")
    sweeps = _sweeps(shown)
    return Verdict(
        f"first direction wrong, {motion}: at most {allowed} of {TRIALS}",
        _SOURCES[method],
        sweeps,
        TRIALS,
        other=f"{wrong} wrong, {unknown} never decided, of {sweeps} sweeps that approach",
        beside=beside,
        verdict=direction_state(wrong, allowed, sweeps),
    )
