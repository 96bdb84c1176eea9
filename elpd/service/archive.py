"""The runs on disk, as the socket tells them: a list, one in full, and a budget that the oldest pay for.

Folders come and go while they are read (a new run, the budget, a person), so what cannot be read is left out of a list
and refused by name.
"""

from __future__ import annotations

import json
import re
import shutil
from typing import TYPE_CHECKING, Any

import structlog

from elpd.errors import UsageError
from elpd.record.journal import DECISIONS_FILE, RUN_FILE, is_run
from elpd.service.messages import RunAnswer, RunsAnswer, RunSummary

if TYPE_CHECKING:
    from pathlib import Path

MOST_SAMPLES = 2000
_STAMPED = re.compile(r"(\d{4})(\d{2})(\d{2})T(\d{2})(\d{2})(\d{2})Z-\d{3}")

log = structlog.get_logger(__name__)


def runs(directory: Path, limit: int) -> RunsAnswer:
    """Return the newest runs."""
    return RunsAnswer(runs=[_summary(folder, head) for folder, head in _newest_first(directory, limit)])


def run(directory: Path, name: str) -> RunAnswer:
    """Return one run. Raises ``UsageError`` if there is none of that name."""
    folder = directory / name
    head = _head(folder) if folder.parent == directory and is_run(folder) else None
    if head is None:
        raise UsageError(f"there is no run {name!r}; `runs` lists those there are")
    samples = _samples(folder)
    step = max(1, -(-len(samples) // MOST_SAMPLES))
    return RunAnswer(
        name=name,
        result=head.get("result"),
        error=head.get("error"),
        samples=samples[::step],
        config=head["config"],
        files=sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()),
    )


def keep_budget(directory: Path, budget_bytes: float) -> None:
    """Delete the oldest runs until all of ours fit. The newest stays, whatever its size.

    Runs that a person renamed are not ours, and neither counted nor deleted.
    """
    try:
        folders = sorted(one for one in directory.iterdir() if _STAMPED.fullmatch(one.name) and is_run(one))
    except OSError:
        return
    sizes = [sum(file.stat().st_size for file in one.rglob("*") if file.is_file()) for one in folders]
    total, gone = sum(sizes), 0
    for folder, size in zip(folders[:-1], sizes[:-1], strict=True):
        if total <= budget_bytes:
            break
        shutil.rmtree(folder, ignore_errors=True)
        total, gone = total - size, gone + 1
    if gone:
        log.info("old runs deleted", runs=gone, left_mb=total / 1e6, budget_mb=budget_bytes / 1e6)


def _newest_first(directory: Path, limit: int) -> list[tuple[Path, dict[str, Any]]]:
    try:
        folders = [folder for folder in directory.iterdir() if is_run(folder)]
    except OSError:
        return []
    folders.sort(key=_when, reverse=True)
    heads = ((folder, _head(folder)) for folder in folders[:limit])
    return [(folder, head) for folder, head in heads if head is not None]


def _when(folder: Path) -> float:
    try:
        return (folder / RUN_FILE).stat().st_mtime
    except OSError:
        return 0.0


def _head(folder: Path) -> dict[str, Any] | None:
    try:
        head = json.loads((folder / RUN_FILE).read_bytes())
    except (OSError, ValueError):
        return None
    return head if isinstance(head, dict) else None


def _summary(folder: Path, head: dict[str, Any]) -> RunSummary:
    stamp = _STAMPED.fullmatch(folder.name)
    result, error = head.get("result") or {}, head.get("error") or {}
    return RunSummary(
        name=folder.name,
        at=None if stamp is None else "{}-{}-{}T{}:{}:{}Z".format(*stamp.groups()),
        outcome=result.get("outcome"),
        reason=result.get("reason") or error.get("message"),
        focus_um=result.get("focus_um"),
        sigma_um=result.get("sigma_um"),
        final_um=result.get("final_um"),
        duration_ms=result.get("duration_ms"),
        kept=stamp is None,
    )


def _samples(folder: Path) -> list[tuple[float | None, int, float | None, int]]:
    samples = []
    try:
        with (folder / DECISIONS_FILE).open("rb") as lines:
            for line in lines:
                note = json.loads(line)
                if note.get("event", note.get("note")) == "window":
                    samples.append((note["position_um"], note["elp"], note["score"], note["end_us"]))
    except (OSError, ValueError, KeyError):
        return samples  # a run that was cut off tells what it has
    return samples
