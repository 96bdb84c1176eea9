"""Whole focus cycles with a lens that has to come to rest, as ``tools/acceptance.py --json FILE`` wrote them down.

The benchmark's own rows are estimates on recorded sweeps; these are where the glass of the simulated rig rested, from
both sides of focus, approach and verification included. Its motions are not named like the sets': ``moderate`` and
``violent`` are held against the goal for a dynamic scene, light below the default against the goal for the dark.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.sets import SETS
from benchmarks.verdict import (
    ABSTAIN_SHARE,
    ABSTAIN_SHARE_SHAKE,
    EARLY_SHARE,
    ONE_WAY_MS,
    TRIALS,
    Accuracy,
    Verdict,
    direction_state,
    state,
)
from elpd.errors import FormatError

if TYPE_CHECKING:
    from pathlib import Path

_CAMERAS = {"davis346": "davis", "evk4": "evk4"}
_MOTIONS = {"static": "static", "moderate": "dynamic", "violent": "dynamic", "shake": "shake"}
_NOT_MOTION = ("expose", "choose", "idle", "done")
_SPEED_UM_S = 4_000.0
_DISTANCE_UM = 200.0


@dataclass(frozen=True, slots=True)
class LiveRun:
    """One file: its settings and a row for every cycle."""

    name: str
    settings: dict[str, Any]
    rows: list[dict[str, Any]]

    @property
    def set_name(self) -> str:
        """The set whose goals these cycles are held against."""
        return f"{_CAMERAS[self.settings['camera']]}-{'dark' if self.settings['brightness'] < 1.0 else 'bright'}"

    @property
    def wanted(self) -> int:
        """How many cycles make such a run complete: as many as the sweeps that the goal is about."""
        return len(SETS["syn"].scenes)

    def concerns(self, goal: Accuracy) -> bool:
        """Say whether these cycles are a test of *goal*."""
        return (goal.set_name, goal.motion) == (self.set_name, _MOTIONS[self.settings["motion"]])

    def accuracy(self, goal: Accuracy) -> Verdict:
        """Hold the errors of the glass at rest against *goal*."""
        limit_um = float(self.settings["depth_of_focus_um"])
        errors = self._errors_um()
        missed, outside = len(self.rows) - errors.size, int((errors > limit_um).sum())
        early = sum(bool(row.get("stopped_early")) for row in self.rows)
        shaken = goal.motion == "shake"
        mae_um = float(errors.mean()) if errors.size else None
        over = mae_um is None or mae_um > goal.mae_um
        over = over or (shaken and early >= EARLY_SHARE * len(self.rows))
        return Verdict(
            f"{goal.set_name} {goal.motion}, at rest: MAE at most {goal.mae_um:g} um, none FOCUSED outside "
            f"{limit_um:g} um",
            self.source,
            len(self.rows),
            self.wanted,
            mae_um=mae_um,
            worst_um=float(errors.max()) if errors.size else None,
            missed=missed,
            abstained_share=missed / len(self.rows),
            outside=outside,
            early=early,
            other=f"from {sorted({row['start_um'] for row in self.rows})} um",
            beside=goal.claim,
            verdict=state(over=over, broken=outside > 0, trials=len(self.rows), wanted=self.wanted),
        )

    def others(self) -> list[Verdict]:
        """Hold abstentions, the first direction and the time against their goals."""
        table = [self._abstained()]
        if self.settings["motion"] in ("static", "violent"):
            table.append(self._direction(0 if self.settings["motion"] == "static" else 1))
        if self.settings["speed_um_s"] == _SPEED_UM_S:
            table.append(self._time())
        return table

    @property
    def source(self) -> str:
        """What these cycles are, for the table."""
        told = self.settings
        light = "" if told["brightness"] == 1.0 else f", light {told['brightness']:g}"
        return f"{self.name}: {told['camera']}, {told['board']}, {told['motion']}, {told['speed_um_s']:g} um/s{light}"

    def _errors_um(self) -> np.ndarray:
        return np.array([abs(row["final_error_um"]) for row in self.rows if row["outcome"] == "FOCUSED"])

    def _abstained(self) -> Verdict:
        limit = ABSTAIN_SHARE_SHAKE if self.settings["motion"] == "shake" else ABSTAIN_SHARE
        missed = sum(row["outcome"] != "FOCUSED" for row in self.rows)
        share = missed / len(self.rows)
        return Verdict(
            f"abstentions at rest, {self.settings['motion']}: below {limit:.0%}",
            self.source,
            len(self.rows),
            self.wanted,
            missed=missed,
            abstained_share=share,
            verdict=state(over=share >= limit, trials=len(self.rows), wanted=self.wanted),
        )

    def _direction(self, allowed: int) -> Verdict:
        judged = [row for row in self.rows if row.get("first_direction_wrong") is not None]
        wrong = sum(row["first_direction_wrong"] for row in judged)
        return Verdict(
            f"first direction wrong, {self.settings['motion']}, from both sides: at most {allowed} of {TRIALS}",
            self.source,
            len(judged),
            TRIALS,
            other=f"{wrong} wrong of {len(judged)} cycles",
            verdict=direction_state(wrong, allowed, len(judged)),
        )

    def _time(self) -> Verdict:
        """Take cycles from 200 um that began in the right direction; their motion, without exposing and choosing."""
        straight = [
            row
            for row in self.rows
            if row["outcome"] == "FOCUSED" and not row["reversals"] and abs(row["start_um"]) == _DISTANCE_UM
        ]
        times_ms = [sum(phase["ms"] for phase in row["phases"] if phase["name"] not in _NOT_MOTION) for row in straight]
        turned_ms = [row["duration_ms"] for row in self.rows if row["outcome"] == "FOCUSED" and row["reversals"]]
        median_ms = float(np.median(times_ms)) if times_ms else None
        told = [] if median_ms is None else [f"median {median_ms:.0f} ms, slowest {max(times_ms):.0f} ms"]
        if turned_ms:
            told.append(f"{np.median(turned_ms):.0f} ms for whole cycles that had to turn round")
        return Verdict(
            f"200 um to rest, focus verified: within {ONE_WAY_MS:.0f} ms at 4 mm/s (median)",
            self.source,
            len(straight),
            self.wanted,
            other="; ".join(told),
            beside="paper: ELP 103 to 113 ms without its stopping error, EGS and PBF 302 to 404 ms",
            verdict=state(
                over=median_ms is not None and median_ms > ONE_WAY_MS, trials=len(straight), wanted=self.wanted
            ),
        )


def read_live(path: Path) -> LiveRun:
    """Read a file of ``tools/acceptance.py --json FILE``. Raises ``FormatError`` for anything else."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        settings, rows = dict(kept["settings"]), list(kept["rows"])
        known = settings["camera"] in _CAMERAS and settings["motion"] in _MOTIONS and bool(rows)
        needed = all(key in settings for key in ("board", "brightness", "speed_um_s", "depth_of_focus_um"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path}: not a file of tools/acceptance.py --json FILE ({error!r})") from None
    if not (known and needed):
        raise FormatError(f"{path}: its settings are none of tools/acceptance.py's, or it holds no cycle: {settings}")
    return LiveRun(path.stem, settings, rows)
