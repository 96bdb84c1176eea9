"""Focus the simulated rig many times and say how it went, so that every figure of the README can be made again.

    python tools/acceptance.py [--seeds 30] [--board tic] [--camera evk4] [--motion static] [--set KEY=VALUE]
                               [--json [FILE]]

Each seed is a scene, a place of focus on the lens's travel and a set of sensor imperfections; each is focused from
both sides. Three errors are told apart: of the estimate (where the cycle says focus was), of the stop (where the motor
came to rest after the crossing was certain) and of the end (where the glass rests when the cycle is over, the one that
counts). ``--json`` prints one object per cycle; ``--json FILE`` prints the table and leaves settings and cycles in a
file, which ``tools/benchmark.py --acceptance FILE`` holds against the goals. ``false`` counts cycles that ended
FOCUSED outside one depth of focus: there should be none, ever.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from elpd_drivers.sim.rig import SimSettings

from elpd import rig
from elpd.config import Config, load
from elpd.errors import ElpdError
from elpd.focus.cycle import FocusCycle
from elpd.focus.fields import result_fields
from elpd.focus.settings import CycleSettings, FocusRequest

ERRORS = ("estimate_error_um", "stop_error_um", "final_error_um")


def main() -> int:
    """Run, print a table; exit 1 if a cycle claimed focus where there was none."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--board", default="tic", choices=["tic", "grbl", "tmcl", "zaber", "avr"])
    parser.add_argument("--camera", default="evk4", choices=["evk4", "davis346"])
    parser.add_argument("--motion", default="static", choices=["static", "moderate", "violent", "shake"])
    parser.add_argument("--start-um", type=float, nargs="+", default=[-200.0, 200.0], help="starts beside true focus")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any configuration key")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--json", nargs="?", const="-", metavar="FILE", help="one JSON object per cycle and no table, or all in FILE"
    )
    chosen = parser.parse_args()
    table = [f"sim.{key}={getattr(chosen, key)}" for key in ("board", "camera", "motion")]
    config = load(overrides=[*table, *chosen.set, "journal.enabled=false"])
    cases = [(seed, start) for seed in range(chosen.first, chosen.first + chosen.seeds) for start in chosen.start_um]
    rows = []
    with ProcessPoolExecutor(chosen.jobs) as pool:
        for row in pool.map(partial(focus, config), cases):
            rows.append(row)
            print(json.dumps(row) if chosen.json == "-" else line(row), flush=True)
    if chosen.json != "-":
        print(summary(rows, config.sim.depth_of_focus_um))
    if chosen.json not in (None, "-"):
        kept = {"settings": all_settings(config), "rows": rows}
        Path(chosen.json).write_text(json.dumps(kept), encoding="utf-8")
    return int(any(is_false(row, config.sim.depth_of_focus_um) for row in rows))


class Sweeps:
    """Notes of a cycle, of which only the sweeps are kept."""

    def __init__(self) -> None:
        self.ended: list[dict[str, Any]] = []

    def note(self, event: str, /, **fields: Any) -> None:
        """Keep how a direction of travel ended."""
        if event == "sweep":
            self.ended.append(fields)


def focus(config: Config, case: tuple[int, float]) -> dict[str, Any]:
    """Run one cycle; return its result, what the simulator knows, and the CPU time it took."""
    seed, start_um = case
    sim = config.sim.model_copy(update={"seed": seed, "start_um": start_um})
    config = config.model_copy(update={"sim": sim})
    begun = time.process_time()
    parts = rig.build(config)
    sweeps = Sweeps()
    row: dict[str, Any] = {"seed": seed, "start_um": start_um, "scene": getattr(parts.truth, "scene", None)}
    try:
        result = FocusCycle(parts, CycleSettings.from_config(config), FocusRequest(), sweeps).run()
        row |= result_fields(result)
        truth = {} if parts.truth is None else parts.truth.errors(result)
        row["true_focus_um"] = truth.pop("focus_um", None)
        row |= truth
    except ElpdError as error:
        row |= {"outcome": error.kind, "reason": str(error)}
    finally:
        rig.release(parts)
    turned = [one for one in sweeps.ended if one["end"] == "behind"]
    row["reversal_travel_um"] = [abs(one["ended_um"] - one["begun_um"]) for one in turned]
    row["first_direction_wrong"] = first_direction_wrong(sweeps.ended, row.get("true_focus_um"))
    row["stopped_early"] = stopped_early(sweeps.ended, row.get("true_focus_um"), config.sim.depth_of_focus_um)
    row["cpu_s"] = time.process_time() - begun
    return row


def all_settings(config: Config) -> dict[str, Any]:
    """Return the simulated rig's settings, those that were left at their defaults too."""
    drawn = {"seed", "start_um"}
    defaults = {one.name: one.default for one in fields(SimSettings) if one.name not in drawn}
    return defaults | config.sim.model_dump(mode="json", exclude=drawn)


def first_direction_wrong(ended: list[dict[str, Any]], true_focus_um: float | None) -> bool | None:
    """Say whether the first verdict was wrong: turned from focus, or did not on the way from it.

    A way to focus that a rule ended is no verdict.
    """
    if not ended or true_focus_um is None:
        return None
    first = ended[0]
    ahead = (true_focus_um - first["begun_um"]) * (first["ended_um"] - first["begun_um"]) > 0.0
    return bool((first["end"] == "behind") == ahead)


def stopped_early(ended: list[dict[str, Any]], true_focus_um: float | None, depth_of_focus_um: float) -> bool:
    """Say whether a sweep took focus for passed more than a depth of focus before it was."""
    if true_focus_um is None:
        return False
    return any(
        one["end"] == "passed" and one["sign"] * (true_focus_um - one["ended_um"]) > depth_of_focus_um for one in ended
    )


def is_false(row: dict[str, Any], depth_of_focus_um: float) -> bool:
    """Say whether a cycle claimed focus where there was none."""
    return row["outcome"] == "FOCUSED" and abs(row["final_error_um"]) > depth_of_focus_um


def line(row: dict[str, Any]) -> str:
    """Return one cycle as a line."""
    head = f"seed {row['seed']:4d} from {row['start_um']:+6.0f} um  {row['scene'] or '':10s} {row['outcome']:16s}"
    if row.get("final_error_um") is None or row["outcome"] != "FOCUSED":
        return f"{head} {row['reason']}"
    errors = "  ".join(f"{name.split('_')[0]} {row[name]:+7.2f}" for name in ERRORS)
    turns = ", ".join(f"{travel:.1f}" for travel in row["reversal_travel_um"])
    return f"{head} {errors} um  sigma {row['sigma_um']:.2f}" + (f"  turned after {turns} um" if turns else "")


def summary(rows: list[dict[str, Any]], depth_of_focus_um: float) -> str:
    """Return the table over all cycles."""
    focused = [row for row in rows if row["outcome"] == "FOCUSED"]
    outcomes = ", ".join(f"{count} {name}" for name, count in Counter(row["outcome"] for row in rows).most_common())
    wrong = sum(is_false(row, depth_of_focus_um) for row in rows)
    judged = [row["first_direction_wrong"] for row in rows if row.get("first_direction_wrong") is not None]
    lines = ["", f"{len(rows)} cycles: {outcomes}; {wrong} false (FOCUSED beyond {depth_of_focus_um:g} um)"]
    lines.append(f"first direction wrong: {sum(judged)} of {len(judged)}, of refused cycles too")
    if not focused:
        return "\n".join(lines)
    lines.append(f"{'':22s}{'median':>9s}{'mean':>9s}{'p95':>9s}{'worst':>9s}")
    columns = {
        f"|{name.removesuffix('_um').replace('_', ' ')}| um": [abs(row[name]) for row in focused] for name in ERRORS
    }
    columns["duration ms"] = [row["duration_ms"] for row in focused]
    columns["stop latency us"] = [row["stop_latency_us"] for row in focused if row["stop_latency_us"] is not None]
    columns["reversal travel um"] = [travel for row in rows for travel in row["reversal_travel_um"][:1]]
    columns["CPU s"] = [row["cpu_s"] for row in rows]
    for name, values in columns.items():
        if values:
            told = (np.median(values), np.mean(values), np.percentile(values, 95), np.max(values))
            lines.append(f"{name:22s}" + "".join(f"{value:9.2f}" for value in told))
    # how far the stated standard errors can be trusted: the errors in units of them
    ratios = [row["estimate_error_um"] / row["sigma_um"] for row in focused]
    lines.append(f"{'estimate error / sigma':22s}{np.sqrt(np.mean(np.square(ratios))):9.2f} rms")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
