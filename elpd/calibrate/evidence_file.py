"""Evidence on disk: an ``.npz`` that gives the same profile again, on any machine, with a better method one day.

Flat arrays under plain names: ``rest.t_us``, ``sweep0.path_um``, ``step3.before`` and so on; what is not an array
stands in ``head``, a JSON text.
"""

from __future__ import annotations

import json
import zipfile
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.calibrate.evidence import Columns, Evidence, Pass, Rest, Step, Sweeps
from elpd.errors import FormatError, UsageError
from elpd.records import Geometry
from elpd.vision.ruler import Ruler

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

FORMAT = 1
_TYPES = {"t_us": np.int64, "x": np.uint16, "y": np.uint16, "on": np.uint8}


def is_evidence(path: Path) -> bool:
    """Say whether a file is one of ours, by what is in it."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "head.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def save_evidence(path: Path, evidence: Evidence, on: Mapping[str, Any], depth_of_focus_um: float) -> None:
    """Write evidence, what it was taken on (``MeasuredOn`` as a mapping) and the depth of focus.

    Raises ``UsageError`` where the file cannot be written.
    """
    head: dict[str, Any] = {
        "format": FORMAT,
        "on": dict(on),
        "depth_of_focus_um": depth_of_focus_um,
        "geometry": [evidence.geometry.width, evidence.geometry.height],
        "brightness_doubt": evidence.brightness_doubt,
        "black": evidence.black,
        "lost_events": evidence.lost_events,
        "missing": evidence.missing or {},
        "rest": None if evidence.rest is None else [evidence.rest.begin_us, evidence.rest.end_us],
        "sweeps": [
            {"speed_um_s": one.speed_um_s, "begin_us": one.begin_us, "end_us": one.end_us, "passes": one.passes}
            for one in evidence.sweeps
        ],
        "steps": [{"duration_s": one.duration_s, "speed_um_s": one.speed_um_s} for one in evidence.steps],
    }
    arrays: dict[str, NDArray[Any]] = {"head": np.array(json.dumps(head))}
    if evidence.rest is not None:
        arrays |= _named("rest", evidence.rest.events)
    for k, sweep in enumerate(evidence.sweeps):
        arrays |= _named(f"sweep{k}", sweep.events)
        arrays |= {f"sweep{k}.path_us": sweep.path.times_us, f"sweep{k}.path_um": sweep.path.positions}
    for k, step in enumerate(evidence.steps):
        arrays |= _named(f"step{k}", step.events)
        arrays |= {f"step{k}.before": step.before, f"step{k}.after": step.after}
    if evidence.brightness is not None:
        arrays["brightness"] = evidence.brightness
    try:
        with path.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
    except OSError as error:
        raise UsageError(f"{path}: the evidence cannot be written ({error.strerror or error})") from None


def load_evidence(path: Path) -> tuple[Evidence, dict[str, Any], float]:
    """Return evidence, what it was taken on, and the depth of focus. Raises ``FormatError``."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = {name: archive[name] for name in archive.files}
        head = json.loads(str(found["head"]))
        if head["format"] != FORMAT:
            raise FormatError(f"{path}: evidence of format {head['format']}, this elpd reads {FORMAT}")
        rest = None
        if head["rest"] is not None:
            rest = Rest(_columns(found, "rest"), *head["rest"])
        sweeps = tuple(_sweep(found, f"sweep{k}", one) for k, one in enumerate(head["sweeps"]))
        steps = tuple(
            Step(found[f"step{k}.before"], found[f"step{k}.after"], _columns(found, f"step{k}"), **one)
            for k, one in enumerate(head["steps"])
        )
        evidence = Evidence(
            Geometry(*head["geometry"]),
            rest,
            sweeps,
            steps,
            found.get("brightness"),
            head["brightness_doubt"],
            head["black"],
            None,
            head["lost_events"],
            head["missing"],
        )
        return evidence, head["on"], float(head["depth_of_focus_um"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise FormatError(
            f"{path}: damaged, or not what `elpd calibrate sensor --keep` wrote ({type(error).__name__}: {error})"
        ) from None


def _sweep(found: Mapping[str, NDArray[Any]], name: str, head: Mapping[str, Any]) -> Sweeps:
    path = Ruler.of_path(found[f"{name}.path_us"], found[f"{name}.path_um"])
    passes = tuple(Pass(*one) for one in head["passes"])
    return Sweeps(head["speed_um_s"], _columns(found, name), path, head["begin_us"], head["end_us"], passes)


def _named(name: str, events: Columns) -> dict[str, NDArray[Any]]:
    return {f"{name}.{column}": values for column, values in events._asdict().items()}


def _columns(found: Mapping[str, NDArray[Any]], name: str) -> Columns:
    return Columns(*(found[f"{name}.{column}"].astype(kind, copy=False) for column, kind in _TYPES.items()))
