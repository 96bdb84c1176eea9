"""Measure autofocus methods on simulated sweeps with known truth, and write a report.

    python tools/benchmark.py --out results                       # every set, every method
    python tools/benchmark.py --out results --quick               # three sweeps of each set, to see that it works
    python tools/benchmark.py --out results --resume              # go on where it was interrupted
    python tools/benchmark.py --out results --sets syn,syn-std --methods elpd,pbf --jobs 2
    python tools/benchmark.py --out results --seed 100 --seeds 4  # enough sweeps for every goal
    python tools/benchmark.py --out results --executor dask --scheduler tcp://host:8786
    python tools/benchmark.py --out results --resume --acceptance tic.json,grbl.json
    python tools/benchmark.py --out results --sets none --recorded ../shared/sweeps

The folder holds rows.csv (one line per case, method and frame rate; the same to the byte for one seed, whoever made
it), times.csv (what each took, which differs), scores.csv, goals.csv, results.json (all of it, with the settings) and
report.html, one file with everything in it. Cases are kept under --cache and made only once. An interrupted run keeps
every case that was whole.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.calibration import calibrations
from benchmarks.cases import cases_of
from benchmarks.executors import EXECUTORS
from benchmarks.folder import claim
from benchmarks.goals import verdicts
from benchmarks.live import read_live
from benchmarks.methods import all_methods
from benchmarks.recorded import recorded_cases
from benchmarks.report import write_report
from benchmarks.runner import Task, Work, finished, run_all, wanted_pairs
from benchmarks.scoring import scores
from benchmarks.sets import FRAME_PERIODS_US, SETS
from benchmarks.verdict import tell
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from elpd.baselines.e2vid import E2vid
from elpd.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.rows import Row

QUICK = ("*-camera-fov1-*", "*-card-fov1-*")
INTERRUPTED = 130
_TIMES = ("cpu_ms", "focusing_ms")
_MADE = [name for name, one in SETS.items() if one.motions]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit code."""
    chosen = _parse(arguments)
    try:
        return _measure(chosen)
    except UsageError as error:
        print(f"benchmark: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        kept = sum(1 for _ in (chosen.out / "rows").glob("*.json"))
        print(f"benchmark: interrupted; {kept} cases are kept, go on with --resume", file=sys.stderr)
        return INTERRUPTED


def _measure(chosen: argparse.Namespace) -> int:
    if chosen.scheduler is not None and chosen.executor != "dask":
        raise UsageError(f"--scheduler is for --executor dask, not {chosen.executor}")
    live = [read_live(path) for path in chosen.acceptance]
    if chosen.e2vid_weights is not None:
        E2vid(chosen.e2vid_weights)  # so that a wrong file is refused before the first case
    cases = _cases(chosen)
    with_e2vid = chosen.e2vid_weights is not None
    tasks = [
        Task(case, pairs, _cache(chosen), chosen.e2vid_weights)
        for case in cases
        if (pairs := wanted_pairs(case.set_name, chosen.methods, chosen.rates, with_e2vid=with_e2vid))
    ]
    if not tasks:
        raise UsageError(
            "no case or no method left to run; check --sets, --cases, --recorded, --methods and --rates",
        )
    seeds = list(range(chosen.seed, chosen.seed + chosen.seeds))
    rows_folder = claim(chosen.out, seeds, chosen.e2vid_weights, resume=chosen.resume, redo=chosen.redo)
    works = [Work(task, rows_folder, tuple(chosen.redo)) for task in tasks]
    started = time.perf_counter()
    rows = _run(works, chosen)
    settings = {
        "seeds": seeds,
        "sets": chosen.sets,
        "methods": chosen.methods,
        "cases": len(works),
        "seconds": round(time.perf_counter() - started, 1),
    }
    table, goals, truth = scores(rows), verdicts(rows, live), calibrations(rows)
    _write(chosen.out, rows, {"scores": table, "goals": goals, "calibration": truth}, settings)
    write_report(chosen.out / "report.html", rows, table, goals, truth, settings)
    print("\n".join(tell(goals)))
    print(f"{len(rows)} rows of {len(works)} cases in {settings['seconds']} s: {chosen.out / 'report.html'}")
    return 0


def _cases(chosen: argparse.Namespace) -> list[Any]:
    patterns = QUICK if chosen.quick else ("*",)
    sets = _MADE if "all" in chosen.sets else [name for name in chosen.sets if name != "none"]
    recorded = [] if chosen.recorded is None else recorded_cases(chosen.recorded)
    made = [
        case
        for name in sets
        for seed in range(chosen.seed, chosen.seed + chosen.seeds)
        for case in cases_of(name, seed, chosen.cases)
        if any(case.matches(pattern) for pattern in patterns)
    ]
    return made + recorded


def _cache(chosen: argparse.Namespace) -> Path | None:
    if chosen.cache == "none":
        return None
    return Path(chosen.cache or chosen.out / "cases").resolve()


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="three cases of each set: one scene, every motion")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--executor", choices=EXECUTORS, default="joblib")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="of a dask cluster (default: workers on this machine)")
    parser.add_argument("--seed", type=int, default=1, help="of motion and sensor noise (default 1)")
    parser.add_argument("--seeds", type=_positive, default=1, help="how many, from --seed on (default 1)")
    made = ["all", *_MADE, "none"]
    parser.add_argument("--sets", type=_names(made), default=["all"], help=f"of {', '.join(made)} (default all)")
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
        "--e2vid-weights", type=Path, metavar="FILE", help="also start from E2VID's picture, with these weights (torch)"
    )
    parser.add_argument(
        "--acceptance",
        type=lambda text: [Path(name) for name in text.split(",")],
        default=[],
        metavar="FILES",
        help="of tools/acceptance.py --json FILE: whole cycles, held against the same goals",
    )
    parser.add_argument(
        "--redo", type=_names(every), default=[], metavar="METHODS", help="with --resume: forget what is known of these"
    )
    parser.add_argument("--resume", action="store_true", help="keep what OUT holds already and do the rest")
    return parser.parse_args(arguments)


def _positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more; got {text}")
    return int(text)


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
    done = sum(finished(work) for work in works)
    if done:
        print(f"{done} of {len(works)} cases were finished before")
    columns = (TextColumn("cases"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    found: dict[Path, list[Row]] = {}
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("cases", total=len(works))
        # Closed at once when interrupted, so that workers are ended here and not whenever memory is cleaned up.
        with closing(run_all(works, chosen.executor, chosen.jobs, chosen.scheduler)) as answers:
            for work, rows in answers:
                found[work.path] = rows
                progress.advance(task)
    # In the order of cases, whoever was faster; a case's rows come in the order of methods and their rates.
    return [row for work in works for row in found[work.path]]


def _write(out: Path, rows: Sequence[Row], tables: dict[str, Sequence[Any]], settings: dict[str, Any]) -> None:
    plain_rows = [row.as_dict() for row in rows]
    plain = {name: [one.as_dict() for one in table] for name, table in tables.items()}
    # Curves are for the report and too long for a table; times are nobody's but this machine's.
    apart = ("details", *_TIMES)
    _write_csv(out / "rows.csv", [{key: row[key] for key in row if key not in apart} for row in plain_rows])
    named = ("case", "seed", "method", "rate", *_TIMES)
    _write_csv(out / "times.csv", [{key: row[key] for key in named} for row in plain_rows])
    for name in ("scores", "goals"):
        _write_csv(out / f"{name}.csv", plain[name])
    (out / "results.json").write_text(json.dumps({"settings": settings, **plain, "rows": plain_rows}), encoding="utf-8")


def _write_csv(path: Path, plain: Sequence[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(plain[0]))
        writer.writeheader()
        writer.writerows(plain)


if __name__ == "__main__":
    sys.exit(main())
