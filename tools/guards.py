"""Meet each misfortune many times on the simulated rig and count what comes of it; above all: false FOCUSED.

    python tools/guards.py [--only "NAME;NAME"] [--seeds 20] [--first 0] [--set KEY=VALUE ...] [--json FILE] [--list]

A seed is a scene, a place of focus, a set of sensor imperfections, and a side to start from (even: below, odd: above).
``right`` is FOCUSED with the glass at rest within one depth of focus of true focus (of the plane that the sweep met
first, where there are several), ``false`` any other FOCUSED. The rest is counted by outcome. Exits with 1 if anything
was false.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elpd import rig
from elpd.config import load
from elpd.errors import ElpdError
from elpd.focus.cycle import FocusCycle
from elpd.focus.fields import result_fields
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.records import Roi

if TYPE_CHECKING:
    from collections.abc import Sequence

WIDTH, HEIGHT = 200, 160
DAVIS = ("sim.camera=davis346", f"sim.width={WIDTH}", f"sim.height={HEIGHT}", "focus.roi_fraction=0.6")
EVK4 = ("sim.camera=evk4", f"sim.width={WIDTH}", f"sim.height={HEIGHT}", "focus.roi_fraction=0.6")
MIDDLE = Roi(40, 30, 120, 100)


@dataclass(frozen=True)
class Guard:
    """A misfortune: configuration keys, and the region where it matters which."""

    keys: tuple[str, ...]
    base: tuple[str, ...] = DAVIS
    roi: Roi | None = None
    second_plane_um: float = 0.0


@dataclass
class Count:
    """What came of a misfortune."""

    right: int = 0
    false: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    warned: Counter[str] = field(default_factory=Counter)
    worst_um: float = 0.0
    cpu_s: float = 0.0


def _planes(um: float, *keys: str) -> Guard:
    return Guard((f"sim.second_plane_um={um}", *keys), roi=MIDDLE, second_plane_um=um)


GUARDS = {
    "none": Guard(()),
    "flat": Guard(("sim.scene=flat",)),
    "cap": Guard(("sim.cap=true",)),
    "noise only": Guard(("sim.brightness=0.0005", "sim.noise_hz=0.005")),
    "flicker 5 %": Guard(("sim.flicker_hz=100", "sim.flicker_depth=0.05")),
    "flicker 10 %": Guard(("sim.flicker_hz=100", "sim.flicker_depth=0.1")),
    "flicker 30 %": Guard(("sim.flicker_hz=100", "sim.flicker_depth=0.3")),
    "flicker 30 %, 120 Hz": Guard(("sim.flicker_hz=120", "sim.flicker_depth=0.3")),
    "flicker 30 %, event-only": Guard(("sim.flicker_hz=100", "sim.flicker_depth=0.3"), EVK4),
    "flicker 30 %, shaken": Guard(("sim.flicker_hz=100", "sim.flicker_depth=0.3", "sim.motion=moderate")),
    "flicker 30 %, flat": Guard(("sim.flicker_hz=100", "sim.flicker_depth=0.3", "sim.scene=flat")),
    "pulsed 10 %, 200 Hz": Guard(("sim.flicker_hz=200", "sim.flicker_depth=0.1", "sim.flicker_shape=pwm")),
    "pulsed 50 %, 200 Hz": Guard(("sim.flicker_hz=200", "sim.flicker_depth=0.5", "sim.flicker_shape=pwm")),
    "hot pixels": Guard(("sim.hot_pixels=200",)),
    "hot pixels, event-only": Guard(("sim.hot_pixels=200",), EVK4),
    "noise 30 Hz": Guard(("sim.noise_hz=30",)),
    "noise 100 Hz": Guard(("sim.noise_hz=100",)),
    "dark": Guard(("sim.brightness=0.05",)),
    "dim": Guard(("sim.brightness=0.2",)),
    "planes 60 um apart": _planes(60.0),
    "planes 15 um apart": _planes(15.0),
    "planes 60 um apart, shaken": _planes(60.0, "sim.motion=moderate"),
    "planes 15 um apart, shaken": _planes(15.0, "sim.motion=moderate"),
    "shaken": Guard(("sim.motion=violent",)),
    "shaken by hand": Guard(("sim.motion=shake",)),
    "overexposed": Guard(("sim.overexposed=0.4",)),
    "rate limit, told": Guard(("sim.rate_limit_mev_s=0.3",)),
    "rate limit, silent": Guard(("sim.rate_limit_mev_s=0.3", "sim.rate_limit_told=false")),
    "pan along bars": Guard(("sim.scene=bars", "sim.pan_px_s=200", "sim.pan_deg=90")),
    "pan across bars": Guard(("sim.scene=bars", "sim.pan_px_s=100")),
    "pan": Guard(("sim.pan_px_s=100", "sim.pan_deg=30")),
    "shaken bars": Guard(("sim.scene=bars", "sim.motion=violent")),
    "breathing": Guard(("sim.breathing_per_mm=0.1",)),
    "an object goes by": Guard(("sim.object_px_s=300",)),
}


def main() -> int:
    """Run, print a table; exit 1 if a cycle claimed focus where there was none."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="names, separated by semicolons")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the configuration")
    parser.add_argument("--json", type=Path, help="write every cycle to this file, one object a line")
    parser.add_argument("--list", action="store_true", help="say what there is, and stop")
    chosen = parser.parse_args()
    if chosen.list:
        print("\n".join(f"{name:28s} {' '.join(guard.keys)}" for name, guard in GUARDS.items()))
        return 0
    names = list(GUARDS) if chosen.only is None else [one.strip() for one in chosen.only.split(";")]
    unknown = [name for name in names if name not in GUARDS]
    if unknown:
        parser.error(f"unknown: {', '.join(unknown)}; --list says what there is (separate names by semicolons)")
    out = None if chosen.json is None else chosen.json.open("w", encoding="utf-8")
    false = 0
    print(f"{'misfortune':28s}{'right':>6s}{'false':>6s}{'worst um':>9s}  refused")
    for name in names:
        count = Count()
        for seed in range(chosen.first, chosen.first + chosen.seeds):
            row = meet(GUARDS[name], seed, chosen.set)
            _add(count, row)
            if out is not None:
                print(json.dumps({"misfortune": name, **row}), file=out, flush=True)
        false += count.false
        print(_line(name, count, chosen.seeds), flush=True)
    if out is not None:
        out.close()
    return int(false > 0)


def meet(guard: Guard, seed: int, chosen: Sequence[str] = ()) -> dict[str, Any]:
    """Run one cycle, with *chosen* keys set; return its result, the error of the resting glass, and its CPU time."""
    start_um = 200.0 if seed % 2 else -200.0
    keys = [*guard.base, *guard.keys, f"sim.seed={seed}", f"sim.start_um={start_um}", "journal.enabled=false", *chosen]
    config = load(overrides=keys)
    begun = time.process_time()
    parts = rig.build(config)
    row: dict[str, Any] = {"seed": seed, "start_um": start_um, "scene": getattr(parts.truth, "scene", None)}
    try:
        result = FocusCycle(parts, CycleSettings.from_config(config), FocusRequest(roi=guard.roi), Notes()).run()
        row |= result_fields(result)
        error_um = None if parts.truth is None else parts.truth.errors(result)["final_error_um"]
        row["error_um"] = None if error_um is None else error_um - first_met_um(guard, row)
        row["right"] = row["error_um"] is not None and abs(row["error_um"]) <= config.sim.depth_of_focus_um
    except ElpdError as error:
        row |= {"outcome": error.kind, "reason": str(error), "warnings": []}
    finally:
        rig.release(parts)
    row["cpu_s"] = time.process_time() - begun
    return row


def first_met_um(guard: Guard, row: dict[str, Any]) -> float:
    """Return which plane the last sweep met first, from that of the scene's left half."""
    sign = row["details"].get("sweep_sign", 1)
    return min(0.0, guard.second_plane_um) if sign > 0 else max(0.0, guard.second_plane_um)


class Notes:
    """A sink that keeps nothing."""

    def note(self, event: str, /, **fields: Any) -> None:
        """Let it go."""


def _add(count: Count, row: dict[str, Any]) -> None:
    count.cpu_s += row["cpu_s"]
    count.warned.update(f"{warning.split(';')[0]}" for warning in row["warnings"])
    if row["outcome"] != "FOCUSED":
        count.refused[row["outcome"]] += 1
        return
    count.worst_um = max(count.worst_um, abs(row["error_um"]))
    if row["right"]:
        count.right += 1
    else:
        count.false += 1


def _line(name: str, count: Count, seeds: int) -> str:
    refused = ", ".join(f"{number} {outcome}" for outcome, number in count.refused.most_common())
    worst = f"{count.worst_um:9.2f}" if count.right + count.false else f"{'':9s}"
    return f"{name:28s}{count.right:6d}{count.false:6d}{worst}  {refused or '-'}   ({count.cpu_s / seeds:.1f} CPU s)"


if __name__ == "__main__":
    sys.exit(main())
