"""How long focusing takes on the simulated rig: from the lens's first step to rest at focus, verified, phase by phase.

    python tools/focus_time.py [--seeds 10] [--board tic] [--camera evk4] [--free] [--set KEY=VALUE] [--json]

The lens begins 200 um from focus and is sent the right way. The simulated world stands still while this program
computes, so what computing takes on this machine is measured (CPU time of one thread, nothing of the simulator's) and
*charged*: the world's clock is moved on by as much, and packets and the lens's replies wait meanwhile as they would on
a rig. ``--free`` charges nothing, which shows what the rig alone takes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from elpd import rig
from elpd.config import Config, load
from elpd.focus import cycle, watch
from elpd.focus.aftermath import Aftermath
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.focus.watch import Watch
from elpd.units import HostNs

if TYPE_CHECKING:
    from collections.abc import Iterator

    from elpd.ports import Clock
    from elpd.records import CameraPacket, ElpSample, FocusEstimate

PHASES = ("sweep", "stop", "recross", "return", "verify")


class Nowhere:
    """Where the notes go."""

    def note(self, event: str, /, **fields: Any) -> None:
        """Take a note, and forget it."""


class Meter:
    """What computing has taken in one cycle; where there is a clock it is charged to it."""

    clock: Clock | None = None
    spent_ms: dict[str, float] = {}  # noqa: RUF012  (one cycle at a time)

    @classmethod
    def charge(cls, what: str, begun: float) -> None:
        """Charge what was computed since *begun* to the world."""
        spent = time.thread_time() - begun
        cls.spent_ms[what] = cls.spent_ms.get(what, 0.0) + 1e3 * spent
        if cls.clock is not None:
            cls.clock.sleep_until(HostNs(cls.clock.now_ns() + round(1e9 * spent)))


class TimedWatch(Watch):
    """A watch whose computing is metered."""

    def feed(self, packet: CameraPacket) -> list[ElpSample]:
        """Judge a packet."""
        begun = time.thread_time()
        samples = super().feed(packet)
        Meter.charge("watch", begun)
        return samples


class TimedAftermath(Aftermath):
    """An aftermath whose computing is metered."""

    def hear_out(self, packet: CameraPacket) -> None:
        """Take a packet after the decision."""
        begun = time.thread_time()
        super().hear_out(packet)
        Meter.charge("watch", begun)

    def estimate(self) -> FocusEstimate | None:
        """Say where focus was."""
        begun = time.thread_time()
        found = super().estimate()
        Meter.charge("estimate", begun)
        return found


def main() -> int:
    """Run, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--board", default="tic", choices=["tic", "grbl"])
    parser.add_argument("--camera", default="evk4", choices=["evk4", "davis346"])
    parser.add_argument("--free", action="store_true", help="let computing take no time")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any configuration key")
    parser.add_argument("--json", action="store_true", help="one JSON object per cycle, and no table")
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    cycle.Watch = TimedWatch  # type: ignore[misc]
    watch.Aftermath = TimedAftermath  # type: ignore[misc]
    overrides = [f"sim.board={chosen.board}", f"sim.camera={chosen.camera}", *chosen.set, "journal.enabled=false"]
    config = load(overrides=overrides)
    focus(config, chosen.first, charge=False)  # warms caches up
    rows = []
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        row = focus(config, seed, charge=not chosen.free)
        rows.append(row)
        print(json.dumps(row) if chosen.json else line(row), flush=True)
    if not chosen.json:
        print("\n".join(summary([row for row in rows if row["outcome"] == "FOCUSED"])))
    return 0


def focus(config: Config, seed: int, *, charge: bool) -> dict[str, Any]:
    """Run one cycle; return how long each phase took in the rig's time, and the CPU time of what was computed."""
    up = config.sim.start_um < 0
    sim = config.sim.model_copy(update={"seed": seed})
    lens = config.lens.model_copy(update={"first_direction": "up" if up else "down"})
    config = config.model_copy(update={"sim": sim, "lens": lens})
    parts = rig.build(config)
    Meter.clock, Meter.spent_ms = parts.clock if charge else None, {}
    try:
        result = cycle.FocusCycle(parts, CycleSettings.from_config(config), FocusRequest(), Nowhere()).run()
        truth = {} if parts.truth is None else parts.truth.errors(result)
    finally:
        rig.release(parts)
    took = {phase.name: phase.ms for phase in result.phases}
    row: dict[str, Any] = {"seed": seed, "scene": getattr(parts.truth, "scene", ""), "outcome": result.outcome.value}
    row |= {f"{name}_ms": took.get(name, 0.0) for name in PHASES}
    row["total_ms"] = sum(took.get(name, 0.0) for name in PHASES)
    row["reason"] = result.reason
    row |= {f"cpu_{name}_ms": Meter.spent_ms.get(name, 0.0) for name in ("watch", "estimate")}
    return row | {"overshoot_um": _beyond(truth.get("stop_error_um"), up=up), "final_error_um": truth["final_error_um"]}


def _beyond(error_um: float | None, *, up: bool) -> float | None:
    return None if error_um is None else error_um if up else -error_um


def line(row: dict[str, Any]) -> str:
    """Return one cycle as a line."""
    head = f"seed {row['seed']:4d} {row['scene']:10s} {row['outcome']:15s}"
    if row["outcome"] != "FOCUSED":
        return f"{head} {row['reason']}"
    phases = "  ".join(f"{name} {row[f'{name}_ms']:5.1f}" for name in PHASES)
    return (
        f"{head} {row['total_ms']:6.1f} ms ({phases})  beyond focus {row['overshoot_um']:5.1f} um, at rest "
        f"{row['final_error_um']:+5.2f}; CPU {row['cpu_watch_ms']:.0f} + {row['cpu_estimate_ms']:.0f} ms"
    )


def summary(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the table over all cycles in focus."""
    yield ""
    if not rows:
        return
    yield f"{len(rows)} in focus{'median':>22s}{'mean':>9s}{'worst':>9s}"
    for name in ("total_ms", *(f"{phase}_ms" for phase in PHASES), "overshoot_um", "cpu_watch_ms", "cpu_estimate_ms"):
        values = [row[name] for row in rows]
        yield f"{name:24s}{np.median(values):9.1f}{np.mean(values):9.1f}{np.max(values):9.1f}"


if __name__ == "__main__":
    sys.exit(main())
