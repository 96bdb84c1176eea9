"""Runs methods over cases, so that it can be stopped and taken up again.

The unit of work is a case: made once, shown to every method, its rows written to one file that appears whole or not at
all. A run that is resumed reads those files and does only what is missing. Rows come back in any order and are sorted,
so tables do not depend on who was faster.
"""

from __future__ import annotations

import json
import os
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from benchmarks.cases import GENERATION, load_or_make
from benchmarks.executors import spread
from benchmarks.methods import CYCLE, CYCLE_SETS, NO_FRAMES, all_methods, run_method
from benchmarks.recorded import read_recorded
from benchmarks.rows import Row
from benchmarks.sets import E2VID, MAP, REBUILT, SETS

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence
    from pathlib import Path

    from benchmarks.cases import Case


@dataclass(frozen=True, slots=True)
class Task:
    """What a worker is given: a case, the (method, rate) pairs to run, where cases are kept, and E2VID's weights."""

    case: Case
    wanted: tuple[tuple[str, str], ...]
    cache: Path | None
    weights: Path | None = None


@dataclass(frozen=True, slots=True)
class Work:
    """A task and where its rows go. What an earlier run left of the methods in ``redo`` is forgotten."""

    task: Task
    rows_folder: Path
    redo: tuple[str, ...] = ()

    @property
    def path(self) -> Path:
        """The file of this case's rows."""
        return self.rows_folder / f"{self.task.case.name}-seed{self.task.case.seed}.json"


def wanted_pairs(
    set_name: str, methods: Sequence[str], rates: Sequence[str], *, with_e2vid: bool = False
) -> tuple[tuple[str, str], ...]:
    """Return the (method, rate) pairs to run on a set.

    What needs no frames runs whatever *rates* says, and so do pictures made from events: E2VID's *with_e2vid*.
    """
    known = all_methods()
    always = {MAP, REBUILT} | ({E2VID} if with_e2vid else set())
    there = [rate for rate in SETS[set_name].rates if rate in rates or rate in always]
    concerned = [name for name in methods if name != CYCLE or set_name in CYCLE_SETS]
    return tuple((name, rate) for name in concerned for rate in known[name].rates if rate == NO_FRAMES or rate in there)


def known_rows(work: Work) -> dict[tuple[str, str], Row]:
    """Return the rows that an earlier run left for this case, by method and rate."""
    if not work.path.is_file():
        return {}
    kept = json.loads(work.path.read_text(encoding="utf-8"))
    if kept["generation"] != GENERATION:
        return {}
    rows = (Row(**row) for row in kept["rows"] if row["method"] not in work.redo)
    return {(row.method, row.rate): row for row in rows}


def finished(work: Work) -> bool:
    """Say whether nothing is left to do for this case."""
    return set(work.task.wanted) <= set(known_rows(work))


def run_task(task: Task) -> list[Row]:
    """Make the case, or read it, and run what is wanted of it."""
    methods = all_methods()
    made = read_recorded(task.case) if task.case.folder is not None else load_or_make(task.case, task.cache)
    return [run_method(methods[name], rate, made, task.weights) for name, rate in task.wanted]


def run_all(
    works: Sequence[Work], executor: str, jobs: int, scheduler: str | None = None
) -> Generator[tuple[Work, list[Row]]]:
    """Yield each case's rows as they come, in no particular order; each is kept before it is yielded."""
    open_works, tasks = [], []
    for work in works:
        known = known_rows(work)
        missing = tuple(pair for pair in work.task.wanted if pair not in known)
        if missing:
            open_works.append((work, known))
            tasks.append(Task(work.task.case, missing, work.task.cache, work.task.weights))
        else:
            yield work, [known[pair] for pair in work.task.wanted]
    if not tasks:
        return
    with closing(spread(run_task, tasks, executor, jobs, scheduler)) as answers:
        for number, rows in answers:
            work, known = open_works[number]
            known |= {(row.method, row.rate): row for row in rows}
            _keep(work, list(known.values()))
            yield work, [known[pair] for pair in work.task.wanted]


def _keep(work: Work, rows: Sequence[Row]) -> None:
    kept = {"generation": GENERATION, "rows": [row.as_dict() for row in rows]}
    aside = work.path.with_suffix(f".{os.getpid()}.tmp")
    aside.write_text(json.dumps(kept), encoding="utf-8")
    aside.replace(work.path)
