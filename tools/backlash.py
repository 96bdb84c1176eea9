"""How true the error of a measured play is: simulated sensors before lenses with play, error over standard error.

    python tools/backlash.py --seeds 26

Draws thresholds, refractory period, lag, scene and play from each seed, passes focus both ways at two speeds, measures,
and prints by how many standard errors the answer is off: mean and root mean square, which should be 0 and 1.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from elpd_drivers.sim.sensor import BiasLevels
from played import there_and_back_with_play

from elpd.calibrate.backlash import measure_backlash

SCENES = ("camera", "coffee", "gravel", "chelsea", "grass", "astronaut")


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    chosen = parser.parse_args()
    scores = []
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        random = np.random.default_rng(seed)
        c_on, c_off = random.uniform(0.12, 0.30, 2)
        play_um = float(random.choice([0.0, 2.0, 4.0, 8.0]))
        sensor: dict[str, Any] = {"lag_us": float(random.choice([20.0, 40.0, 60.0]))}
        scene = str(random.choice(SCENES))
        focus = BiasLevels(float(c_on), float(c_off), int(random.choice([100, 300, 500])))
        evidence = there_and_back_with_play(play_um, seed, scene, size=(128, 96), focus=focus, **sensor)
        found = measure_backlash(evidence, 6.0).backlash_um
        if found.value is not None and found.sigma is not None:
            scores.append((found.value - play_um) / found.sigma)
        print(f"{seed} {scene}, thresholds {c_on / c_off:.2f}: {found} ({play_um:g})", flush=True)
    rms = float(np.sqrt(np.mean(np.square(scores))))
    print(f"{len(scores)} of {chosen.seeds} measured, mean {np.mean(scores):+.2f}, rms {rms:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
