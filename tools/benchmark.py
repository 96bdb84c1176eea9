"""Measure autofocus methods on simulated sweeps with known truth, and write a report.

    python tools/benchmark.py --out results                       # the paper's 84 cases, every method
    python tools/benchmark.py --out results --quick               # six cases, to see that it works
    python tools/benchmark.py --out results --resume              # go on where it was interrupted
    python tools/benchmark.py --out results --sets syn,syn-std --methods elpd,pbf --jobs 2
    python tools/benchmark.py --out results --sets none --recorded ../shared/sweeps

The folder holds rows.csv (one line per case, method and frame rate), scores.csv, results.json (both, with the settings)
and report.html, one file with everything in it. Cases are kept under --cache and made only once.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.cases import cases_of
from benchmarks.methods import all_methods
from benchmarks.recorded import recorded_cases
from benchmarks.report import write_report
from benchmarks.runner import EXECUTORS, Work, known_rows, run_all, wanted_pairs
from benchmarks.scoring import scores
from benchmarks.sets import FRAME_PERIODS_US, SETS
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.methods import Row
    from benchmarks.scoring import Score

QUICK = ("*-camera-fov1-*", "*-grass-fov3-*")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit code."""
    chosen = _parse(arguments)
    if not chosen.resume and any((chosen.out / "rows").glob("*.json")):
        print(
            f"benchmark: {chosen.out} holds results already; give --resume to go on, or another --out", file=sys.stderr
        )
        return 2
    rows_folder = chosen.out / "rows"
    rows_folder.mkdir(parents=True, exist_ok=True)
    cache = None if chosen.cache == "none" else Path(chosen.cache or chosen.out / "cases")
    sets = [name for name in chosen.sets if name != "none"]
    patterns = QUICK if chosen.quick else (chosen.cases,)
    cases = {case.name: case for name in sets for pattern in patterns for case in cases_of(name, chosen.seed, pattern)}
    if chosen.recorded is not None:
        cases |= {case.name: case for case in recorded_cases(chosen.recorded)}
    works = [
        Work(
            case,
            wanted_pairs(case.set_name, chosen.methods, chosen.rates),
            rows_folder,
            cache,
            tuple(chosen.redo),
        )
        for case in cases.values()
    ]
    if not any(work.wanted for work in works):
        print(
            "benchmark: no case or no method left to run; check --sets, --cases, --recorded, --methods and --rates",
            file=sys.stderr,
        )
        return 2
    started = time.perf_counter()
    rows = _run(works, chosen)
    settings = {
        "seed": chosen.seed,
        "sets": chosen.sets,
        "methods": chosen.methods,
        "cases": len(works),
        "seconds": round(time.perf_counter() - started, 1),
    }
    _write(chosen.out, rows, scores(rows), settings)
    write_report(chosen.out / "report.html", rows, scores(rows), settings)
    print(f"{len(rows)} rows of {len(works)} cases in {settings['seconds']} s: {chosen.out / 'report.html'}")
    return 0


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument(
        "--quick", action="store_true", help="a few cases of each set: six of syn, three of the rig-like ones"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--executor", choices=EXECUTORS, default="joblib")
    parser.add_argument("--seed", type=int, default=1, help="of motion and sensor noise (default 1)")
    made = [name for name, one in SETS.items() if one.motions] + ["none"]
    parser.add_argument("--sets", type=_names(made), default=["syn"], help=f"of {', '.join(made)} (default syn)")
    parser.add_argument("--recorded", type=Path, metavar="DIR", help="folder of recorded sweeps with truth, besides")
    every = all_methods()
    parser.add_argument(
        "--methods", type=_names(every), default=list(every), help=f"of {', '.join(every)} (default all)"
    )
    rates = list(FRAME_PERIODS_US)
    parser.add_argument("--rates", type=_names(FRAME_PERIODS_US), default=rates, help="frame rates (default 50,20,1)")
    parser.add_argument("--cases", default="*", metavar="PATTERN", help="only cases of such a name, e.g. '*-camera-*'")
    parser.add_argument("--cache", metavar="DIR|none", help="where cases are kept (default: OUT/cases)")
    parser.add_argument(
        "--redo", type=_names(every), default=[], metavar="METHODS", help="with --resume: forget what is known of these"
    )
    parser.add_argument("--resume", action="store_true", help="keep what OUT holds already and do the rest")
    return parser.parse_args(arguments)


def _names(known: Any) -> Any:
    def parse(text: str) -> list[str]:
        names = [name.strip() for name in text.split(",") if name.strip()]
        unknown = [name for name in names if name not in known]
        if unknown or not names:
            raise argparse.ArgumentTypeError(
                f"unknown {', '.join(unknown) or 'nothing'}; choose from {', '.join(known)}"
            )
        return names

    return parse


def _run(works: Sequence[Work], chosen: argparse.Namespace) -> list[Row]:
    finished = sum(len(known_rows(work)) >= len(work.wanted) for work in works)
    if finished:
        print(f"{finished} of {len(works)} cases were finished before")
    columns = (TextColumn("cases"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    rows: list[Row] = []
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("cases", total=len(works))
        for some in run_all(works, chosen.executor, chosen.jobs):
            rows.extend(some)
            progress.advance(task)
    place = {work.case.name: k for k, work in enumerate(works)}
    order = {name: k for k, name in enumerate(chosen.methods)}
    # The sort is stable, and a case's rows come in the order of a method's rates.
    return sorted(rows, key=lambda row: (place[row.case], order[row.method]))


def _write(out: Path, rows: Sequence[Row], table: Sequence[Score], settings: dict[str, Any]) -> None:
    plain_rows = [row.as_dict() for row in rows]
    plain_scores = [score.as_dict() for score in table]
    # Curves are for the report and too long for a table.
    _write_csv(out / "rows.csv", [{key: value for key, value in row.items() if key != "details"} for row in plain_rows])
    _write_csv(out / "scores.csv", plain_scores)
    whole = {"settings": settings, "scores": plain_scores, "rows": plain_rows}
    (out / "results.json").write_text(json.dumps(whole), encoding="utf-8")


def _write_csv(path: Path, plain: Sequence[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(plain[0]))
        writer.writeheader()
        writer.writerows(plain)


if __name__ == "__main__":
    sys.exit(main())
