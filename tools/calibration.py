"""How true the sensor calibration's errors are: simulated sensors of many kinds, error over standard error.

    python tools/calibration.py --seeds 10

Draws thresholds, refractory period, noise, mismatch and scene from each seed, takes rest and there-and-backs with the
simulated sensor, measures, and prints how many standard errors each answer is off: mean and root mean square, which
should be 0 and 1.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from elpd_drivers.sim.optics import DARK
from elpd_drivers.sim.sensor import BiasLevels
from sensor_evidence import there_and_back
from sim_rigs import MARGIN_PX

from elpd.calibrate.profile import MeasuredOn
from elpd.calibrate.sensor import measure_sensor

SCENES = ("camera", "coffee", "gravel", "chelsea", "grass", "astronaut")
ON = MeasuredOn(device="simulated sensor", serial=None, width=128, height=96, settings={})


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    chosen = parser.parse_args()
    off: dict[str, list[float]] = {}
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        random = np.random.default_rng(seed)
        c_on, c_off = random.uniform(0.12, 0.30, 2)
        refractory_us = int(random.choice([100, 300, 500, 1000]))
        sensor = {
            "noise_hz": float(random.choice([0.1, 1.0, 3.0])),
            "mismatch": float(random.choice([0.02, 0.035, 0.1])),
            "lag_us": float(random.choice([20.0, 40.0, 60.0])),
        }
        scene = str(random.choice(SCENES))
        focus = BiasLevels(float(c_on), float(c_off), refractory_us)
        setup, evidence = there_and_back(seed, scene, size=(128, 96), focus=focus, reach_um=120.0, **sensor)
        light = setup.canvas[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
        truth = {
            "threshold_ratio": c_on / c_off,
            "mismatch": sensor["mismatch"],
            "refractory_us": refractory_us,
            "lag_us": sensor["lag_us"] / (float(np.percentile(light, 99)) + DARK),
        }
        found = measure_sensor(evidence, ON, 6.0).quantities()
        for name, true in truth.items():
            quantity = found[name]
            if quantity.value is not None and quantity.sigma is not None:
                off.setdefault(name, []).append((quantity.value - true) / quantity.sigma)
        print(f"{seed} {scene}: " + "; ".join(f"{name} {found[name]} ({true:.4g})" for name, true in truth.items()))
    for name, scores in off.items():
        rms = float(np.sqrt(np.mean(np.square(scores))))
        print(f"{name}: {len(scores)} of {chosen.seeds} measured, mean {np.mean(scores):+.2f}, rms {rms:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
