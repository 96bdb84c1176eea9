"""Run a recorded cycle again and compare: the same result, the same decisions, byte for byte.

The cycle's own code runs against the tape; what it notes is compared line by line with what it noted then. The report
names the *first* difference in the order in which a reader can follow it: a note that differs, else a question to a
device that differs, else the result. Nothing is written.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from elpd.errors import FormatError
from elpd.record.codec import note_line, to_json
from elpd.record.journal import DECISIONS_FILE, RUN_FILE, RUN_FORMAT
from elpd.record.playback import TapeReader, replay_rig

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from elpd.ports import RigParts, RunSink


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """What ``run.json`` says, and where the rest lies."""

    path: Path
    elpd: str
    config: dict[str, Any]
    request: dict[str, Any]
    result: dict[str, Any] | None
    error: dict[str, str] | None
    truth: dict[str, float | None] | None
    truncated: str | None
    attachments: dict[str, str]

    def attachment(self, name: str) -> Path | None:
        """Return the run's copy of a file that the request named, ``None`` if it named none."""
        return self.path / self.attachments[name] if name in self.attachments else None


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """How a replay ended. ``result`` is the replayed one (its JSON fields), ``None`` where the cycle did not end."""

    result: dict[str, Any] | None
    error: dict[str, str] | None
    identical: bool
    first_difference: str | None
    calls: int


def load_run(path: Path) -> RecordedRun:
    """Read a run's folder. Raises ``FormatError`` with what was found instead."""
    try:
        head = json.loads((path / RUN_FILE).read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        found = _found_instead(path)
        raise FormatError(
            f"{path}: is no run folder: {found}; runs lie in journal.directory, and `elpd runs` lists them"
        ) from None
    except (OSError, ValueError) as error:
        raise FormatError(f"{path / RUN_FILE}: cannot be read ({error}); is it a run of elpd?") from None
    wanted = {"format", "elpd", "config", "request", "result", "error", "truth", "truncated", "attachments"}
    if not isinstance(head, dict) or not wanted <= head.keys():
        raise FormatError(f"{path / RUN_FILE}: is not a run of elpd: it lacks some of {', '.join(sorted(wanted))}")
    if head["format"] != RUN_FORMAT:
        raise FormatError(
            f"{path}: run format {head['format']}, this elpd reads {RUN_FORMAT}; replay it with elpd {head['elpd']}"
        )
    del head["format"]
    return RecordedRun(path=path, **{key: head[key] for key in sorted(wanted - {"format"})})


def replay_run(
    run: RecordedRun,
    run_cycle: Callable[[RigParts, RecordedRun, RunSink, Callable[[], int]], Mapping[str, Any]],
) -> ReplayReport:
    """Run the cycle again.

    Parameters
    ----------
    run
        From ``load_run``.
    run_cycle
        Builds the cycle from the run's configuration, request and attachments and runs it on the given rig, sink and
        *cancelled*; returns the JSON fields of the result.

    Raises
    ------
    FormatError
        If the folder is damaged. A cycle that fails or asks something else is a finding, not an exception.

    """
    notes = _Notes()
    tape = TapeReader(run.path)
    result: dict[str, Any] | None = None
    error: dict[str, str] | None = None
    try:
        result = json.loads(to_json(run_cycle(replay_rig(tape), run, notes, tape.cancelled)))
    except FormatError:
        raise
    except (Exception, KeyboardInterrupt) as failure:  # noqa: BLE001  (whatever ended the run then may end it now)
        error = {"kind": type(failure).__name__, "message": str(failure)}
    finally:
        calls, unasked = tape.asked, tape.remaining()
        tape.close()
    difference = (
        _notes_difference(run, notes.lines, ended=tape.divergence is None)
        or (str(tape.divergence) if tape.divergence else None)
        or _ending_difference(run, result, error)
        or (f"the replay ended after {calls} calls; {unasked} more were recorded" if unasked else None)
        or (f"the recording is incomplete: {tape.truncated}" if tape.truncated else None)
    )
    return ReplayReport(result, error, difference is None, difference, calls)


class _Notes:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, event: str, /, **fields: Any) -> None:
        self.lines.append(note_line(event, fields))


def _notes_difference(run: RecordedRun, replayed: list[str], *, ended: bool) -> str | None:
    """Compare notes as bytes; where the replay was cut short, only as far as it came."""
    try:
        recorded = (run.path / DECISIONS_FILE).read_bytes().decode("ascii", "replace").splitlines()
    except FileNotFoundError:
        recorded = []
    for number, (before, now) in enumerate(zip(recorded, replayed, strict=False), 1):
        if before != now:
            return f"decision {number}: recorded {before}, replayed {now}"
    if len(replayed) > len(recorded):
        return f"decision {len(recorded) + 1}: recorded none, replayed {replayed[len(recorded)]}"
    if ended and len(recorded) > len(replayed):
        return f"decision {len(replayed) + 1}: recorded {recorded[len(replayed)]}, replayed none"
    return None


def _ending_difference(run: RecordedRun, result: dict[str, Any] | None, error: dict[str, str] | None) -> str | None:
    recorded = run.result
    if result != recorded:
        for key in [*(recorded or {}), *(result or {})]:
            before, now = (recorded or {}).get(key), (result or {}).get(key)
            if before != now:
                return f"result: {key}: recorded {to_json(before)}, replayed {to_json(now)}"
    if error != run.error:
        return f"ending: recorded {to_json(run.error)}, replayed {to_json(error)}"
    return None


def _found_instead(path: Path) -> str:
    if not path.exists():
        return "it does not exist"
    if not path.is_dir():
        return "it is a file"
    names = sorted(item.name for item in path.iterdir())
    runs = [name for name in names if (path / name / RUN_FILE).exists()]
    if runs:
        return f"it holds {len(runs)} of them; the newest is {path / runs[-1]}"
    return f"it has no {RUN_FILE}; found {', '.join(names[:5]) or 'nothing'}"
