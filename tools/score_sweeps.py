"""Score `elpd detect` over a folder of sweeps against their truth, so that anyone can rerun it.

    python tools/score_sweeps.py ../shared/sweeps [--only static] [-- OPTIONS OF elpd detect]

Each sub-folder holds a sweep and ``truth.json``: ``gt_us`` (or null), ``um_per_us``, and, where they apply,
``must_fail`` (no focus in it), ``may_miss`` (so hard that no answer is no fault), ``dof_um`` and ``aperture_open_s``.
The detector is started as a program of its own and sees the options after ``--`` and the sweep, never the truth. Two
options are completed for each sweep: the word FIRST becomes the path of its first frame, PATH that of its
``lens_path.csv``.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

DEPTH_OF_FOCUS_UM = 16.0
HONEST_SIGMAS = 3.0
"""An error of more standard deviations than this makes the stated one untrue."""

FAULTS = ("miss", "OUTSIDE", "FALSE", "early")


def main() -> int:
    """Run, print a table and its summary."""
    arguments = sys.argv[1:]
    options: list[str] = []
    if "--" in arguments:
        cut = arguments.index("--")
        arguments, options = arguments[:cut], arguments[cut + 1 :]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--json", action="store_true", help="one JSON object per case instead of a table")
    chosen = parser.parse_args(arguments)
    cases = sorted(one.parent for one in chosen.folder.glob("*/truth.json") if chosen.only in one.parent.name)
    if not cases:
        parser.error(f"{chosen.folder}: no sweeps with a truth.json")
    rows = [score(case, options) for case in cases]
    if chosen.json:
        for row in rows:
            print(json.dumps(row))
    else:
        print_table(rows)
        print_summary(rows)
    return 0


def score(case: Path, options: list[str]) -> dict[str, Any]:
    """Run the detector over one sweep and compare."""
    truth = json.loads((case / "truth.json").read_text())
    started = time.perf_counter()
    run = subprocess.run(  # noqa: S603  (our own program)
        [sys.executable, "-c", "from elpd.cli import main; main()", "detect", *arguments_for(case, truth, options)],
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - started
    answer = json.loads(run.stdout) if run.stdout.strip() else {"outcome": f"crashed: {run.stderr[-300:]}"}
    return {**compare(case.name, truth, answer), "seconds": seconds}


def arguments_for(case: Path, truth: dict[str, Any], options: list[str]) -> list[str]:
    """Return what `elpd detect` is told about a sweep: its path, the options, when an aperture opened."""
    words = {"FIRST": lambda: first_frame(case), "PATH": lambda: str(case / "lens_path.csv")}
    more = [words[one]() if one in words else one for one in options]
    if truth.get("aperture_open_s") and "--aperture-us" not in more:
        opened_us = round(truth["aperture_open_s"][0] * 1e6)
        more += ["--aperture-us", f"0,{opened_us}", "--transmittance", truth.get("transmittance", "linear")]
        more += [] if "--frames" in more else ["--frames", "none"]
    return [str(case), "--json", *more]


def compare(name: str, truth: dict[str, Any], answer: dict[str, Any]) -> dict[str, Any]:
    """Compare an answer of the detector with the truth."""
    um_per_us = truth.get("um_per_us") or truth.get("um_per_us_at_gt") or 0.0008
    truth_us = None if truth.get("must_fail") else truth.get("gt_us") or None
    found = answer.get("focus_us") if answer.get("outcome") == "FOCUSED" else None
    error_um = None if found is None or truth_us is None else (found - truth_us) * um_per_us
    decided_um = late(answer.get("decided_us"), truth_us, um_per_us)
    return {
        "case": name,
        "motion": str(truth.get("motion") or "static").removesuffix("_f"),
        "outcome": answer.get("outcome"),
        "direction": answer.get("direction"),
        "error_um": error_um,
        "sigma_um": None if answer.get("sigma_us") is None else answer["sigma_us"] * um_per_us,
        "decided_um": decided_um,
        "crossing_um": late(answer.get("elp_crossing_us"), truth_us, um_per_us),
        "method": answer.get("method"),
        "verdict": verdict(truth, truth_us, answer.get("outcome"), error_um, decided_um),
        "contributions": answer.get("contributions"),
        "error": answer.get("error"),
    }


def first_frame(case: Path) -> str:
    """Return the first frame of a sweep: what the word FIRST among the options stands for."""
    return str(min(case.glob("davis_frames_50/*"), key=lambda path: int(path.stem)))


def late(t_us: int | None, truth_us: int | None, um_per_us: float) -> float | None:
    """Return how far past focus something happened."""
    return None if t_us is None or truth_us is None else (t_us - truth_us) * um_per_us


def verdict(
    truth: dict[str, Any],
    truth_us: int | None,
    outcome: str | None,
    error_um: float | None,
    decided_um: float | None,
) -> str:
    """Name the case: right, missed, outside a depth of focus, early, or a focus where there is none."""
    if outcome != "FOCUSED":
        return "ok" if truth_us is None else "(miss)" if truth.get("may_miss") else "miss"
    if error_um is None:
        return "FALSE"
    depth_um = truth.get("dof_um") or DEPTH_OF_FOCUS_UM
    if abs(error_um) > depth_um:
        return "OUTSIDE"
    return "early" if decided_um is not None and decided_um < -depth_um else "ok"


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print one line per case."""
    print(
        f"{'case':34} {'outcome':15} {'direction':12} {'error':>7} {'sigma':>6} "
        f"{'decided':>8} {'elp':>7} {'s':>5} verdict"
    )
    for row in rows:
        numbers = [row["error_um"], row["sigma_um"], row["decided_um"], row["crossing_um"]]
        texts = ["-" if one is None else f"{one:+.1f}" for one in numbers]
        print(
            f"{row['case'][:34]:34} {row['outcome'] or row['error']!s:15} {row['direction'] or '-':12} "
            f"{texts[0]:>7} {texts[1]:>6} {texts[2]:>8} {texts[3]:>7} {row['seconds']:5.1f} {row['verdict']}"
        )


def print_summary(rows: list[dict[str, Any]]) -> None:
    """Print mean, bias, worst, and how often the stated error was untrue, for each kind of motion and for all."""
    kinds = sorted({row["motion"] for row in rows})
    for name, chosen in [*((kind, [row for row in rows if row["motion"] == kind]) for kind in kinds), ("all", rows)]:
        known = [row for row in chosen if row["error_um"] is not None]
        counts = {word: sum(row["verdict"] == word for row in chosen) for word in FAULTS}
        if not known:
            print(f"{name}: no answers, {counts}")
            continue
        errors = [row["error_um"] for row in known]
        untrue = sum(abs(row["error_um"]) > HONEST_SIGMAS * row["sigma_um"] for row in known if row["sigma_um"])
        print(
            f"{name}: n {len(errors)}, mean |error| {sum(map(abs, errors)) / len(errors):.2f} um, "
            f"bias {sum(errors) / len(errors):+.2f}, worst {max(map(abs, errors)):.2f} um, "
            f"beyond {HONEST_SIGMAS:.0f} sigma {untrue}, {counts}"
        )


if __name__ == "__main__":
    sys.exit(main())
