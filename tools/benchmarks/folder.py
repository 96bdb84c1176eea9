"""The folder of a run, and what must not change while it is being filled.

``run.json`` says what the folder's rows have in common: seeds, the generation of cases, and a digest of the code that
made them. A run that is taken up again with another seed or other code would mix numbers that do not belong together,
so it is refused; new methods, sets, rates and cases may join.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import elpd_drivers

import elpd
from benchmarks.cases import GENERATION
from elpd.errors import UsageError

NAME = "run.json"
_ROOMS = ("baselines", "events", "focus", "motion", "record", "vision")
_MAKES_ROWS = (
    "cases", "cycles", "limit", "methods", "optics", "recorded", "retina", "rig", "rows", "scenery", "scenes", "sets",
    "shake", "shutter", "starts",
)  # fmt: skip


def claim(out: Path, seeds: list[int], weights: Path | None, *, resume: bool, redo: list[str]) -> Path:
    """Make or take up the folder of a run; return where its rows go.

    Raises
    ------
    UsageError
        If it holds results and *resume* was not asked for, or results that other seeds, other weights or other code
        made. With *redo*, other code is taken for the reason to do something again.
    """
    rows = out / "rows"
    wanted = {"seeds": seeds, "cases": GENERATION, "weights": _digest_of(weights), "code": code_digest()}
    if any(rows.glob("*.json")):
        if not resume:
            raise UsageError(f"{out} holds results already; give --resume to go on, or another --out")
        _check(out, wanted, redo=redo)
    rows.mkdir(parents=True, exist_ok=True)
    (out / NAME).write_text(json.dumps(wanted), encoding="utf-8")
    return rows


def _check(out: Path, wanted: dict[str, Any], *, redo: list[str]) -> None:
    try:
        found = json.loads((out / NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise UsageError(f"{out} holds rows but no {NAME} to say what made them; give another --out") from None
    told = {
        "seeds": "--seed and --seeds as before",
        "cases": "the code that began it",
        "weights": "the same --e2vid-weights",
        "code": "the code that began it, or name with --redo what has to be done again",
    }
    for key, needed in told.items():
        # A run without weights asks nothing of those that were there.
        if found.get(key) == wanted[key] or (key == "weights" and None in (found.get(key), wanted[key])):
            continue
        if key != "code" or not redo:
            raise UsageError(
                f"{out} was begun with {key} {found.get(key)}, and this is {wanted[key]}: their rows do not belong "
                f"together; to go on it takes {needed}; else give another --out"
            )


def code_digest() -> str:
    """Return 12 hex digits that change with any line of what makes rows: the controller, the cases, the methods."""
    digest = hashlib.sha3_224()
    here, room = Path(__file__).parent, Path(elpd.__file__).parent
    own = [here / f"{name}.py" for name in _MAKES_ROWS]
    rooms = [*(room / one for one in _ROOMS), Path(elpd_drivers.__file__).parent]
    for path in (*own, *sorted(path for one in rooms for path in one.rglob("*.py"))):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _digest_of(weights: Path | None) -> str | None:
    return None if weights is None or not weights.is_file() else hashlib.sha3_224(weights.read_bytes()).hexdigest()[:12]
