"""Runs methods over cases, in this process or several, so that it can be stopped and taken up again.

The unit of work is a case: made once, shown to every method, its rows written to one file that appears whole or not at
all. A run that is resumed reads those files and does only what is missing. Rows come back in any order and are sorted,
so tables do not depend on who was faster.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from benchmarks.cases import GENERATION, load_or_make
from benchmarks.methods import NO_FRAMES, Row, all_methods, run_method
from benchmarks.recorded import read_recorded
from benchmarks.sets import MAP, SETS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from benchmarks.cases import Case

EXECUTORS = ("joblib", "serial")


@dataclass(frozen=True, slots=True)
class Work:
    """One case, the (method, rate) pairs wanted of it, where its rows go and where cases are kept.

    What an earlier run left of the methods in ``redo`` is forgotten.
    """

    case: Case
    wanted: tuple[tuple[str, str], ...]
    rows_folder: Path
    cache: Path | None
    redo: tuple[str, ...] = ()

    @property
    def path(self) -> Path:
        """The file of this case's rows."""
        return self.rows_folder / f"{self.case.name}-seed{self.case.seed}.json"


def wanted_pairs(set_name: str, methods: Sequence[str], rates: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Return the (method, rate) pairs to run on a set; what needs no frames runs whatever *rates* says."""
    known = all_methods()
    there = [rate for rate in SETS[set_name].rates if rate in rates or rate == MAP]
    return tuple((name, rate) for name in methods for rate in known[name].rates if rate == NO_FRAMES or rate in there)


def known_rows(work: Work) -> list[Row]:
    """Return the rows that an earlier run left for this case; none if they are of another generation of cases."""
    if not work.path.is_file():
        return []
    kept = json.loads(work.path.read_text(encoding="utf-8"))
    if kept["generation"] != GENERATION:
        return []
    return [Row(**row) for row in kept["rows"] if row["method"] not in work.redo]


def run_case(work: Work) -> list[Row]:
    """Return the rows wanted of one case: those that exist, and the rest after running them."""
    known = {(row.method, row.rate): row for row in known_rows(work)}
    missing = [pair for pair in work.wanted if pair not in known]
    if missing:
        methods = all_methods()
        recorded = work.case.folder is not None
        recording = read_recorded(work.case) if recorded else load_or_make(work.case, work.cache)
        for name, rate in missing:
            known[name, rate] = run_method(methods[name], rate, recording)
        kept = {"generation": GENERATION, "rows": [row.as_dict() for row in known.values()]}
        aside = work.path.with_suffix(f".{os.getpid()}.tmp")
        aside.write_text(json.dumps(kept), encoding="utf-8")
        aside.replace(work.path)
    return [known[pair] for pair in work.wanted]


def run_all(works: Sequence[Work], executor: str, jobs: int) -> Iterator[list[Row]]:
    """Yield each case's rows as they come, in no particular order."""
    if executor == "serial" or jobs == 1:
        yield from map(run_case, works)
        return
    from joblib import Parallel, delayed  # type: ignore[import-untyped]  # noqa: PLC0415  (optional)

    yield from Parallel(n_jobs=jobs, return_as="generator_unordered")(delayed(run_case)(work) for work in works)
