"""What a long run is judged by: cycles and how far from the truth they ended, answers, memory."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

GOOD_DOF = 1.5
"""FOCUSED means: no further from true focus than this many depths of focus."""


class Ledger:
    """Counts and lists, and the figures that come of them. Times in s of the run's clock, lengths in um."""

    def __init__(self, depth_of_focus_um: float) -> None:
        self.counts: Counter[str] = Counter()
        self.outcomes: Counter[str] = Counter()
        self.errors_um: list[float] = []
        """Of FOCUSED cycles during which true focus stood still."""
        self.overtaken_um: list[float] = []
        """Of FOCUSED cycles during which it was moved: where a picture was taken that has gone since."""
        self.after_s: list[float] = []
        """How long after such a cycle the next one ended in focus."""
        self.memory: list[dict[str, float]] = []
        self._good_um = GOOD_DOF * depth_of_focus_um
        self._shifts: list[tuple[float, float, float]] = []
        self._begun_s = 0.0
        self._overtaken_s: float | None = None

    def shifted(self, begin_s: float, end_s: float, by_um: float) -> None:
        """Hear that true focus goes by so much between two instants."""
        self._shifts = [*self._shifts[-64:], (begin_s, end_s, by_um)]

    def began(self, now_s: float) -> None:
        """Hear that a cycle begins."""
        self._begun_s = now_s

    def ended(self, now_s: float, outcome: str, error_um: float | None) -> None:
        """Note how a cycle ended."""
        self.outcomes[outcome] += 1
        if outcome != "FOCUSED" or error_um is None:
            return
        moved = any(begin < now_s and end > self._begun_s for begin, end, _ in self._shifts)
        (self.overtaken_um if moved else self.errors_um).append(error_um)
        if moved and abs(error_um) > self._good_um:
            self._overtaken_s = now_s
        elif self._overtaken_s is not None and abs(error_um) <= self._good_um:
            self.after_s.append(now_s - self._overtaken_s)
            self._overtaken_s = None

    def weigh(self, hours: float, process: int | str = "self") -> dict[str, float]:
        """Note the memory of a process, MB, and return the row."""
        row = {"h": round(hours, 2), "cycles": float(sum(self.outcomes.values())), **memory_mb(process)}
        self.memory.append(row)
        return row

    def figures(self) -> dict[str, Any]:
        """Return what came of it."""
        overtaken = np.abs(self.overtaken_um)
        return {
            "cycles": sum(self.outcomes.values()),
            "outcomes": dict(self.outcomes.most_common()),
            "error_um": spread(self.errors_um),
            "beyond": int((np.abs(self.errors_um) > self._good_um).sum()),
            "focus_moved_meanwhile": {
                "focused": len(overtaken),
                "beyond": int((overtaken > self._good_um).sum()),
                "until_found_again_s": spread(self.after_s),
            },
            "memory_mb": self.memory,
            "growth_mb_per_hour": growth_per_hour(self.memory),
            "counts": dict(sorted(self.counts.items())),
        }


def spread(values: Sequence[float]) -> dict[str, float] | None:
    """Return median, 99th percentile and largest of the magnitudes; ``None`` of nothing."""
    if not len(values):
        return None
    magnitudes = np.abs(np.asarray(values))
    return {
        "p50": round(float(np.median(magnitudes)), 3),
        "p99": round(float(np.quantile(magnitudes, 0.99)), 3),
        "max": round(float(magnitudes.max()), 3),
    }


def memory_mb(process: int | str = "self") -> dict[str, float]:
    """Return resident, proportional and private memory of a process (Linux), MB."""
    text = Path(f"/proc/{process}/smaps_rollup").read_text()
    kb = {name: int(rest.split()[0]) for name, _, rest in (line.partition(":") for line in text.splitlines()[1:])}
    private = kb["Private_Clean"] + kb["Private_Dirty"]
    return {"rss": round(kb["Rss"] / 1e3, 1), "pss": round(kb["Pss"] / 1e3, 1), "uss": round(private / 1e3, 1)}


def growth_per_hour(rows: Sequence[dict[str, float]]) -> float | None:
    """Return the slope of the private memory, MB an hour, over all but the first quarter; ``None`` with few rows."""
    late = rows[len(rows) // 4 :]
    if len(late) < 3 or late[0]["h"] == late[-1]["h"]:
        return None
    return round(float(np.polyfit([row["h"] for row in late], [row["uss"] for row in late], 1)[0]), 3)
