"""How well focus could be told at best in one pass if nobody knows how slow the photoreceptors are.

    python tools/lag_limit.py --set davis-dark [--seed 700] [--cache DIR]

The benchmark's limit to what the signs of events tell (``benchmarks/limit.py``) takes every pixel to answer at once. A
photoreceptor answers late by its time constant, s times that of the brightest, and events of slowness s tell only
``focus + s·lag``. With the information I of all signs, spread evenly over the N events about focus, the two unknowns
have the Fisher matrix

    I · [[1, mean s], [mean s, mean s²]]      so that      sigma(focus) = 1/√I · √(mean s² / var s)

The slowness is the simulated sensor's own, of the noise-free picture in focus. A lag that is known beforehand to a
share of itself adds ``1/(share·lag)²`` to the lower right. Static scenes; lengths in um of lens travel.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from benchmarks.cases import Case, SweepRecording, load_or_make
from benchmarks.optics import FocusRenderer, load_psf
from benchmarks.retina import relative_bandwidth
from benchmarks.scenes import load_picture
from benchmarks.sets import SETS

REACH_UM = 45.0
"""As of the signs' limit: so far around focus events are counted."""

KNOWN = (0.5, 0.25, 0.1)
"""Shares of the lag to which it may be known."""

NORMAL_MEAN = float(np.sqrt(2.0 / np.pi))
"""Mean absolute error over the standard deviation."""


def slowness_of_events(recording: SweepRecording) -> np.ndarray:
    """Return how many times slower than the brightest the pixel of each event about focus is, (n,)."""
    chosen = recording.case.of_set
    side = 3 * (chosen.size_px + 2 * chosen.margin_px)
    picture = FocusRenderer(load_picture(recording.case.scene, side), load_psf(1), chosen.margin_px).frame(
        0.0, (0.0, 0.0)
    )
    places = chosen.start_um + chosen.um_per_us * (recording.t_us - chosen.sweep_begin_us)
    near = (np.abs(places) <= REACH_UM) & (recording.t_us >= chosen.sweep_begin_us)
    roi = recording.roi
    near &= (recording.x >= roi.x) & (recording.x < roi.x + roi.width)
    near &= (recording.y >= roi.y) & (recording.y < roi.y + roi.height)
    return 1.0 / relative_bandwidth(picture[recording.y[near], recording.x[near]])


def limit_um(signs_um: float, slowness: np.ndarray, lag_um: float, known: float) -> float:
    """Return the least standard deviation of focus where the lag, *lag_um*, is known to a share of itself."""
    information = np.array([[1.0, slowness.mean()], [slowness.mean(), np.square(slowness).mean()]]) / signs_um**2
    if np.isfinite(known):
        information[1, 1] += 1.0 / (known * lag_um) ** 2
    return float(np.sqrt(np.linalg.inv(information)[0, 0]))


def main() -> int:
    """Print a line for each scene and their means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", default="davis-dark", choices=[name for name, one in SETS.items() if one.motions])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cache", type=Path, help="where cases are kept, as of tools/benchmark.py")
    asked = parser.parse_args()
    chosen = SETS[asked.set]
    lag_um = chosen.um_per_us * 1e6 / (2.0 * np.pi * chosen.retina.cutoff_hz)
    columns = ["lag known", "unknown", *(f"to {share:.0%}" for share in KNOWN)]
    print(f"{asked.set}: the brightest pixels are late by {lag_um:.2f} um; standard deviations of focus in um, lag ...")
    print(f"{'scene':12s}{'slowness':>16s}" + "".join(f"{one:>12s}" for one in columns))
    table = []
    for scene in chosen.scenes:
        recording = load_or_make(Case(asked.set, scene, 1, "static", asked.seed), asked.cache)
        slowness, signs_um = slowness_of_events(recording), recording.sign_limit_um
        row = [signs_um, *(limit_um(signs_um, slowness, lag_um, known) for known in (np.inf, *KNOWN))]
        table.append(row)
        words = f"{slowness.mean():.1f} +- {slowness.std():.1f}"
        print(f"{scene:12s}{words:>16s}" + "".join(f"{one:12.2f}" for one in row))
    means = NORMAL_MEAN * np.nanmean(table, axis=0)
    print(f"{'mean |error|':28s}" + "".join(f"{one:12.2f}" for one in means))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
