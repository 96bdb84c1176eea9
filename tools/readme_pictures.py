"""Draw a run of `elpd demo`, as README shows it: the ELP curve over the lens position, and the scene before and after.

    elpd demo                                                   # names the folder that it recorded
    python tools/readme_pictures.py RUN tools/docs/images/focus.png

Everything is read from the run's folder. Needs matplotlib (``pip install '.[docs]'``), which nothing else does.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from elpd.cli.demo import MAGNIFIED_PX, magnified

SMOOTHED_WINDOWS = 5
INK, BLUE, GREY, RED = "#222222", "#1f5fa8", "#9a9a9a", "#b23a2e"


def main() -> int:
    """Draw one run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a folder that `elpd demo` recorded")
    parser.add_argument("out", type=Path, help="the PNG to write")
    chosen = parser.parse_args()
    mpl.use("Agg")
    head = json.loads((chosen.run / "run.json").read_text())
    notes = [json.loads(line) for line in (chosen.run / "decisions.jsonl").read_text().splitlines()]
    figure, (plot, before, after) = plt.subplots(
        1, 3, figsize=(11.0, 3.6), width_ratios=(2.2, 1, 1), layout="constrained"
    )
    draw_sweeps(plot, notes, head["result"], head["truth"])
    draw_scene((before, after), chosen.run / "before-after.png", head["result"]["details"]["roi"], head["truth"])
    figure.savefig(chosen.out, dpi=110)
    print(f"{chosen.out}: {head['result']['outcome']}, {head['result']['reason']}")
    return 0


def draw_sweeps(plot: Any, notes: list[dict[str, Any]], result: dict[str, Any], truth: dict[str, Any]) -> None:
    """Draw ELP over the way to true focus: each direction of travel, and where the lens stopped and came to rest."""
    origin_um = truth["focus_um"]
    largest = 1.0
    sweeps = list(split(notes))
    for nth, windows in enumerate(sweeps):
        position_um = np.array([window["position_um"] for window in windows]) - origin_um
        span = np.ones(min(SMOOTHED_WINDOWS, len(windows)))
        elp = np.convolve([window["elp"] for window in windows], span / span.size, mode="same")
        largest = max(largest, float(np.abs(elp).max()))
        last = nth == len(sweeps) - 1
        label = "the sweep" if last else "the probe: negative, focus lies behind"
        plot.plot(position_um, elp, color=BLUE if last else RED, lw=1.8, label=label)
    plot.axhline(0.0, color=INK, lw=0.8)
    for at_um, colour, text in (
        (result["focus_um"] - origin_um, INK, f"rest: {truth['final_error_um']:+.2f} um"),
        (result["stop_um"] - origin_um, GREY, f"stop: {truth['stop_error_um']:+.1f} um, then back"),
    ):
        plot.axvline(at_um, color=colour, lw=1.0, ls="--", label=text)
    plot.set_ylim(-0.42 * largest, 1.12 * largest)
    plot.set_yticks([0.0], ["0"])
    plot.set_xlabel("lens position from true focus (um)")
    plot.set_ylabel("Event Laplacian Product")
    plot.legend(frameon=False, fontsize=8, loc="lower center", ncols=2)
    for side in ("top", "right"):
        plot.spines[side].set_visible(False)


def split(notes: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Gather the windows of each direction of travel."""
    sweeps: list[list[dict[str, Any]]] = []
    for note in notes:
        if note["event"] == "phase" and note["name"] == "sweep":
            sweeps.append([])
        if note["event"] == "window":
            sweeps[-1].append(note)
    return [sweep for sweep in sweeps if sweep]


def draw_scene(plots: tuple[Any, Any], path: Path, roi: list[int], truth: dict[str, Any]) -> None:
    """Draw the part of the region with most detail, before and after."""
    both = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    halves = np.hsplit(both, 2)
    x, y, width, height = roi
    cut = magnified(halves[1].astype(np.float32), (x, y, width, height), MAGNIFIED_PX)
    for plot, half, title in zip(plots, halves, ("before", f"after: {truth['final_error_um']:+.2f} um"), strict=True):
        plot.imshow(half[cut], cmap="gray", vmin=0, vmax=255)
        plot.set_title(title, fontsize=10)
        plot.set_axis_off()


if __name__ == "__main__":
    raise SystemExit(main())
