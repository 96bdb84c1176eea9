"""Does continuous mode hear that focus has moved? ``python tools/continuous.py [--seeds 101 102 …] [--json]``. Prints.

For each seed a simulated rig focuses once and then listens, the lens at rest. Focus jumps by so many um and back again,
and each time a fresh `Evidence` says how much sharpness was lost, in what counts as out of focus (1). Then focus creeps
away by 24 um in so many seconds. A row tells how often that was noticed, and the loss that was measured. `nothing` is
the same time without any step: every loss there is a false alarm.

Events come of what changes: a jump shows at once, a creep must stand out of the noise of the time that it takes, and
what the camera did not listen to it cannot know. `--noise-hz` is the rate of a pixel that sees nothing change.
With `--noise-hours` as many hours of such noise alone are drawn (even over pixels, signs and time) and heard with each
seed's picture: any loss at all, however small, is counted there.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import structlog

from elpd import rig
from elpd.config import load
from elpd.events.decoder import EventArrays
from elpd.events.stream import PacketDecoder
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.record.session import focus_on
from elpd.records import Roi
from elpd.service.evidence import AFTERGLOW_S, BIN_S, Evidence

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.ports import RigParts

STEPS_UM = (3.0, 6.0, 12.0, 24.0)
STEP_MS = 40.0
AFTER_S = 0.4
CREEP_UM, CREEPS_S = 24.0, (5.0, 20.0)
SEEDS = (101, 102, 103, 104, 105, 106)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--noise-hz", type=float, default=1.0)
    parser.add_argument("--quiet-s", type=float, default=30.0, help="how long nothing happens, a seed")
    parser.add_argument("--noise-hours", type=float, default=0.0)
    parser.add_argument("--dof", type=float, help="modes.defocus_dof: what counts as out of focus")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(50))
    losses: dict[str, list[float]] = {}
    for seed in asked.seeds:
        for name, loss in trials(seed, asked).items():
            losses.setdefault(name, []).extend(loss)
    rows = [
        {
            "name": name,
            "trials": len(loss),
            "noticed": round(float(np.mean(np.array(loss) > 1)), 3),
            "loss": [round(float(value), 2) for value in np.quantile(loss, (0.1, 0.5, 0.9))],
        }
        for name, loss in losses.items()
    ]
    if asked.json:
        print(json.dumps({"rows": rows}))
        return 0
    print("                      trials  noticed   loss: 10 %, half, 90 %")
    for row in rows:
        print(f"{row['name']:20s} {row['trials']:6d} {100 * row['noticed']:7.0f} %   {row['loss']}")
    return 0


def trials(seed: int, asked: argparse.Namespace) -> dict[str, list[float]]:
    """Return the losses that were heard on one rig, by what happened."""
    size = ("sim.width=320", "sim.height=240", "journal.enabled=false")
    noise_hz, quiet_s, noise_hours = asked.noise_hz, asked.quiet_s, asked.noise_hours
    chosen = [] if asked.dof is None else [f"modes.defocus_dof={asked.dof}"]
    config = load(overrides=[*size, f"sim.seed={seed}", f"sim.noise_hz={noise_hz}", *chosen, *asked.set])
    parts = rig.build(config)
    truth: Any = parts.truth
    session = focus_on(parts, config, FocusRequest())
    ruler = session.sharpest
    if ruler is None:
        return {f"not weighed: {session.result.outcome.value}": [0.0]}
    allowance = ruler.at(config.modes.defocus_dof * CycleSettings.from_config(config).depth_of_focus_um)
    roi, weights = Roi(*session.result.details["roi"]), ruler.weights
    parts.camera.start()
    out: dict[str, list[float]] = {}

    def hear(name: str, seconds: float, happen: Callable[[], None]) -> None:
        evidence = Evidence(weights, roi, allowance)
        listen(parts, evidence, 1.5 * AFTERGLOW_S)
        happen()
        listen(parts, evidence, seconds)
        out.setdefault(name, []).append(evidence.loss)

    def shift(by_um: float, over_ms: float) -> Callable[[], None]:
        return lambda: truth.drift.shift(parts.clock.now_ns(), by_um, over_ms)

    if noise_hours > 0:
        false = noise_alone(Evidence(weights, roi, allowance), roi, noise_hz, noise_hours, seed)
        out[f"{noise_hours:g} h of noise"] = [false]
    hear("nothing", quiet_s, lambda: None)
    for step_um in STEPS_UM:
        for sign in (1, -1):
            hear(f"step {step_um:g} um", AFTER_S, shift(sign * step_um, STEP_MS))
            hear(f"back {step_um:g} um", AFTER_S, shift(-sign * step_um, STEP_MS))
    for seconds in CREEPS_S:
        hear(f"{CREEP_UM:g} um in {seconds:g} s", seconds, shift(CREEP_UM, 1e3 * seconds))
        hear("back", AFTER_S, shift(-CREEP_UM, STEP_MS))
    rig.release(parts)
    return out


def noise_alone(evidence: Evidence, roi: Roi, noise_hz: float, hours: float, seed: int) -> float:
    """Return the largest loss that noise alone has made."""
    chance = np.random.default_rng(seed)
    most, now_s = 0.0, 0.0
    for _ in range(round(3600 * hours / BIN_S)):
        now_s += BIN_S
        count = int(chance.poisson(roi.width * roi.height * noise_hz * BIN_S))
        x = roi.x + chance.integers(roi.width, size=count)
        y = roi.y + chance.integers(roi.height, size=count)
        on = chance.integers(2, size=count, dtype=np.uint8)
        evidence.hear(EventArrays(np.zeros(count, np.int64), x.astype(np.uint16), y.astype(np.uint16), on), now_s)
        most = max(most, evidence.loss)
    return most


def listen(parts: RigParts, evidence: Evidence, seconds: float) -> None:
    """Let the evidence hear the camera for a while."""
    decoder = PacketDecoder(parts.camera.geometry)
    end_ns = parts.clock.now_ns() + round(1e9 * seconds)
    while parts.clock.now_ns() < end_ns:
        packet = parts.camera.read(0.01)
        if packet is not None:
            evidence.hear(decoder.feed(packet), parts.clock.now_ns() / 1e9)


if __name__ == "__main__":
    sys.exit(main())
