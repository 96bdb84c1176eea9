"""How often the first direction is wrong, and what it costs to know it, on the simulated rig.

    python tools/first_direction.py [--seeds 100] [--first 0] [--camera evk4] [--motion static] [--start-um -200]
                                    [--set KEY=VALUE] [--jobs 1] [--json]

Each seed is a scene, a place of focus, a path of the scene and a set of sensor imperfections; the lens begins beside
focus and is sent both ways, and the cycle is broken off at the first verdict, right or wrong, or where there was none
within ``--reach-um``. So a case takes half a second where a cycle takes several, and there can be hundreds.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import cv2
import numpy as np

from elpd import rig
from elpd.config import Config, load
from elpd.errors import ElpdError
from elpd.focus import cycle
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.focus.watch import Watch
from elpd.records import Direction

if TYPE_CHECKING:
    from elpd.records import CameraPacket, ElpSample
    from elpd.units import SensorUs


class Nowhere:
    """Where the notes go."""

    def note(self, event: str, /, **fields: Any) -> None:
        """Take a note, and forget it."""


class VerdictError(Exception):
    """Breaks a cycle off: there is a first direction, or there was none in reach."""


class FirstVerdict(Watch):
    """A watch that breaks the cycle off once it knows which way focus lies."""

    reach_um: ClassVar[float] = 0.0
    last: ClassVar[dict[str, Any]] = {}
    _begun_us = 0
    _sign = 0

    def begin(self, sign: int, at_us: SensorUs, turned_at_um: float | None = None) -> None:
        """Begin a direction of travel."""
        super().begin(sign, at_us, turned_at_um)
        self._begun_us, self._sign = int(at_us), sign

    def feed(self, packet: CameraPacket) -> list[ElpSample]:
        """Judge a packet."""
        samples = super().feed(packet)
        if not samples:
            return samples
        travel_um = self._sign * (samples[-1].position_um - self._locate(self._begun_us))  # type: ignore[arg-type]
        direction = Direction.APPROACHING if self.passed else self.direction
        if direction is not Direction.UNKNOWN or travel_um > self.reach_um:
            FirstVerdict.last = {
                "direction": direction.value,
                "travel_um": travel_um,
                "ms": 1e-3 * (samples[-1].end_us - self._begun_us),
                "moves": self.scene_moves,
            }
            raise VerdictError
        return samples


def main() -> int:
    """Run, print a table; exit 1 if a verdict was wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100, help="two cases each: towards focus and away from it")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--camera", default="evk4", choices=["evk4", "davis346"])
    parser.add_argument("--motion", default="static", choices=["static", "moderate", "violent", "shake"])
    parser.add_argument("--start-um", type=float, default=-200.0, help="start beside true focus")
    parser.add_argument("--reach-um", type=float, default=150.0, help="travel after which there is no verdict")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any configuration key")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="one JSON object per case, and no table")
    chosen = parser.parse_args()
    table = [f"sim.{key}={getattr(chosen, key)}" for key in ("camera", "motion", "start_um")]
    config = load(overrides=[*table, *chosen.set, "journal.enabled=false"])
    seeds = range(chosen.first, chosen.first + chosen.seeds)
    cases = [(seed, way) for seed in seeds for way in ("up", "down")]
    rows = []
    with ProcessPoolExecutor(chosen.jobs) as pool:
        for row in pool.map(partial(probe, config, chosen.reach_um), cases):
            rows.append(row)
            if chosen.json or row["verdict"] != "right":
                print(json.dumps(row) if chosen.json else line(row), flush=True)
    if not chosen.json:
        print(summary(rows))
    return int(any(row["verdict"] == "wrong" for row in rows))


def probe(config: Config, reach_um: float, case: tuple[int, str]) -> dict[str, Any]:
    """Run one cycle to its first verdict; return what it was and what it took."""
    seed, way = case
    cv2.setNumThreads(1)
    cycle.Watch = FirstVerdict  # type: ignore[misc]
    FirstVerdict.reach_um, FirstVerdict.last = reach_um, {}
    config = config.model_copy(
        update={
            "sim": config.sim.model_copy(update={"seed": seed}),
            "lens": config.lens.model_copy(update={"first_direction": way}),
        }
    )
    parts = rig.build(config)
    row: dict[str, Any] = {"seed": seed, "way": way, "scene": getattr(parts.truth, "scene", "")}
    towards = (config.sim.start_um < 0) == (way == "up")
    try:
        cycle.FocusCycle(parts, CycleSettings.from_config(config), FocusRequest(), Nowhere()).run()
        row["verdict"] = "refused"
    except VerdictError:
        row |= FirstVerdict.last
        right = Direction.APPROACHING if towards else Direction.RECEDING
        named = {right.value: "right", Direction.UNKNOWN.value: "none"}
        row["verdict"] = named.get(row["direction"], "wrong")
    except ElpdError as error:
        row |= {"verdict": "refused", "reason": str(error)}
    finally:
        rig.release(parts)
    return row


def line(row: dict[str, Any]) -> str:
    """Return one case as a line."""
    return "  ".join(f"{key} {value}" for key, value in row.items())


def summary(rows: list[dict[str, Any]]) -> str:
    """Return the table over all cases."""
    counts = {name: sum(row["verdict"] == name for row in rows) for name in ("right", "wrong", "none", "refused")}
    moving = sum(bool(row.get("moves")) for row in rows)
    lines = ["", f"{len(rows)} cases: " + ", ".join(f"{count} {name}" for name, count in counts.items())]
    lines.append(f"motion seen at rest in {moving}")
    told = [row for row in rows if row["verdict"] == "right"]
    for name, unit in (("travel_um", "um"), ("ms", "ms")):
        values = [row[name] for row in told] or [float("nan")]
        lines.append(
            f"to a right verdict: median {np.median(values):.1f}, p95 {np.percentile(values, 95):.1f}, "
            f"most {np.max(values):.1f} {unit}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
