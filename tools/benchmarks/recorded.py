"""Sweeps that others made, in the ELP authors' layout with a ``truth.json`` beside them.

They keep the benchmark honest: another simulator, another lens model, other pictures. Only sweeps through focus are
taken, of one second at 0.8 um/ms, with frames; what must *not* lead to focus is scored elsewhere. The truth is read
here and handed to nobody but the score.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from benchmarks.cases import Case, SweepRecording, region
from benchmarks.limit import SignLimit
from benchmarks.retina import RetinaEvents
from benchmarks.sets import SETS
from elpd.baselines.contrast import tenengrad
from elpd.baselines.rates import vertex

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

MOTIONS = ("static", "moderate", "violent")
FRAME_FOLDERS = ("davis_frames_50", "davis_frames_1")
_LIMIT_BIN_US = 2_000


def recorded_cases(folder: Path) -> list[Case]:
    """Return the usable sweeps in *folder*, in order of name."""
    cases = []
    for path in sorted(folder.glob("*/truth.json")):
        truth = json.loads(path.read_text(encoding="utf-8"))
        # A suffix says in whose pixels the motion was drawn; the kind of motion is the same.
        motion = next((word for word in MOTIONS if str(truth.get("motion")).startswith(word)), None)
        set_name = f"third-{truth.get('preset')}"
        plain = path.parent.name.startswith(str(truth.get("preset"))) and not truth.get("must_fail")
        if motion is not None and set_name in SETS and plain:
            cases.append(Case(set_name, str(truth["scene"]), int(truth["fov"]), motion, 0, path.parent))
    return cases


def read_recorded(case: Case) -> SweepRecording:
    """Return the sweep that *case* names."""
    folder = case.folder
    if folder is None:
        raise ValueError(f"{case.name} is a case to be made, not a recording")
    truth: dict[str, Any] = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    events = np.load(folder / "event.npy", allow_pickle=False)
    paths = sorted(
        (path for name in FRAME_FOLDERS for path in (folder / name).glob("*.jpg")), key=lambda path: int(path.stem)
    )
    frames = np.stack([np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8) for path in paths])
    frame_t_us = np.array([int(path.stem) for path in paths])
    chosen = case.of_set
    edges = np.array([tenengrad(frame, region(chosen)) for frame in frames])
    sharpest_us = float(np.interp(vertex(edges, int(np.argmax(edges))), np.arange(edges.size), frame_t_us))
    return SweepRecording(
        case=case,
        t_us=events["t"].astype(np.int64),
        x=events["x"].astype(np.uint16),
        y=events["y"].astype(np.uint16),
        on=(events["p"] > 0).astype(np.uint8),
        frame_t_us=frame_t_us,
        frames=frames,
        sharpest_um=(sharpest_us - float(truth["gt_us"])) * chosen.um_per_us,
        truth_us=float(truth["gt_us"]),
        sign_limit_um=_sign_limit_um(case, events, frame_t_us, frames, float(truth["gt_us"])),
    )


def _sign_limit_um(
    case: Case, events: NDArray[Any], frame_t_us: NDArray[np.int64], frames: NDArray[np.uint8], truth_us: float
) -> float:
    """Return the statistical limit, with the nearest frame for the picture of the moment."""
    chosen = case.of_set
    limit = SignLimit(region(chosen))
    edges_us = np.arange(int(events["t"][0]), int(events["t"][-1]) + _LIMIT_BIN_US, _LIMIT_BIN_US)
    places = np.searchsorted(events["t"], edges_us)
    for begin_us, begin, end in zip(edges_us, places[:-1], places[1:], strict=False):
        part = events[begin:end]
        seen = RetinaEvents(part["t"], part["x"], part["y"], (part["p"] > 0).astype(np.uint8))
        middle_us = begin_us + _LIMIT_BIN_US // 2
        nearest = frames[int(np.argmin(np.abs(frame_t_us - middle_us)))].astype(np.float32)
        limit.add(seen, nearest, (middle_us - truth_us) * chosen.um_per_us)
    return limit.sigma_um(chosen.depth_of_focus_um)
