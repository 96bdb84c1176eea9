"""The journal: one folder per run, complete enough to run it again.

A run's folder holds ``run.json`` (who, with what configuration, what was asked, how it ended), the tape of every
device call (``elpd.record.tape``), and ``decisions.jsonl``, one line per note of the cycle. Whatever else the decision
depended on, such as a reference picture made by an earlier run, is attached. In virtual time every byte inside depends
on the seed alone; the wall clock appears in the folder's name only.

A journal never stands in the way of focusing: a disk that is full, slow to free or read-only ends the journal with one
warning and a ``truncated`` mark, and the run goes on.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Self

import structlog

from elpd import __version__
from elpd.record.codec import note_line, to_json
from elpd.record.tape import Opener, TapeWriter, open_file, tape_rig

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from elpd.config import Config
    from elpd.ports import RigParts

RUN_FORMAT = 1
RUN_FILE = "run.json"
DECISIONS_FILE = "decisions.jsonl"

NOT_OF_A_RUN = ("journal", "service", "api", "modes", "temperature")
"""Sections of the configuration that no cycle's decision depends on."""

FLUSH_PHASES = frozenset({"choose", "done"})
"""Phases at whose beginning the lens stands still and nothing is about to move: time to write."""

RESERVE_BYTES = 64 << 20
"""A journal leaves this much of the disk to others."""

_FOLDER_NAME = re.compile(r"\d{8}T\d{6}Z-\d{3}")

log = structlog.get_logger(__name__)


class RunWriter:
    """One run on disk; an ``elpd.ports.RunSink``. Nothing here raises for the disk.

    ::

        with RunWriter.begin(config, request, parts) as run:
            result = FocusCycle(run.parts, settings, request, run, observer, run.watch(cancelled)).run()
            run.finish(result_fields(result))

    Parameters
    ----------
    config
        The whole configuration; its ``journal`` section says where runs go and stays out of the folder.
    request
        What was asked for: a dataclass or a mapping. A file that it names is copied into the run.
    started_utc
        For the folder's name; now, unless told.
    opener, free_bytes
        How files are opened and how free space is measured; tests bring failing ones.

    """

    parts: RigParts
    """The rig to use: recorded, or as it was given where there is no journal."""

    def __init__(
        self,
        config: Config,
        request: Any,
        *,
        started_utc: datetime | None = None,
        opener: Opener = open_file,
        free_bytes: Callable[[Path], int] | None = None,
    ) -> None:
        self.path: Path | None = None
        self.truncated: str | None = None
        self.tape = TapeWriter(None)
        self._opener = opener
        self._free_bytes = free_bytes or (lambda path: shutil.disk_usage(path).free)
        self._memory_limit_bytes = round(config.journal.memory_mb * 1e6)
        self._lines: list[str] = []
        self._lines_bytes = 0
        self._decisions: IO[bytes] | None = None
        self._taking_notes = config.journal.enabled
        self._ended = False
        asked: dict[str, Any] = json.loads(to_json(request))
        self._head: dict[str, Any] = {
            "format": RUN_FORMAT,
            "elpd": __version__,
            "config": config.model_dump(mode="json", exclude=set(NOT_OF_A_RUN)),
            "request": asked,
            "attachments": {},
        }
        if config.journal.enabled:
            self._start(config.journal.directory, config.journal.keep, started_utc or datetime.now(UTC))
            self.tape = TapeWriter(self.path, memory_limit_bytes=self._memory_limit_bytes, opener=opener)

    @classmethod
    def begin(cls, config: Config, request: Any, parts: RigParts, **options: Any) -> Self:
        """Open a run for *parts*; ``run.parts`` is the rig to use from here on. *options* as in the constructor."""
        run = cls(config, request, **options)
        run.parts = parts if run.path is None else tape_rig(parts, run.tape)
        return run

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        self.finish(None, error=error)

    def watch(self, cancelled: Callable[[], int]) -> Callable[[], int]:
        """Put the answers of *cancelled* on the tape as well: the decision depends on them."""
        return self.tape.watch(cancelled)

    def note(self, event: str, /, **fields: Any) -> None:
        """Take one note; a note of a phase in which nothing moves is the moment to write what has gathered."""
        if self._taking_notes:
            line = note_line(event, fields)
            self._lines_bytes += len(line)
            self._lines.append(line)
            if self._lines_bytes > self._memory_limit_bytes:
                self._stop(f"{self._lines_bytes / 1e6:.1f} MB of notes waited to be written; raise journal.memory_mb")
        if event == "phase" and fields.get("name") in FLUSH_PHASES:
            self.flush()

    def flush(self) -> None:
        """Write what has gathered."""
        self._guarded(self._write_gathered)

    def finish(
        self,
        result: Mapping[str, Any] | None,
        *,
        error: BaseException | None = None,
        truth: Mapping[str, float | None] | None = None,
    ) -> None:
        """Write the end of the run: the JSON fields of its result, or the error that ended it. Idempotent.

        *truth* is what a simulator knows; it is kept for people and never compared.
        """
        if self._ended:
            return
        self._ended = True
        self._guarded(self._write_gathered)
        self._taking_notes = False
        self.tape.close()
        if self._decisions is not None:
            with contextlib.suppress(OSError):
                self._decisions.close()
        if self.path is None:
            return
        problem = None if error is None else {"kind": type(error).__name__, "message": str(error)}
        known = None if truth is None else dict(truth)
        try:  # even a truncated run says how it ended, where a few bytes still fit
            self._write_head(self.path, result=None if result is None else dict(result), error=problem, truth=known)
        except OSError as failure:
            self._stop(f"{self.path}: {failure.strerror or failure}")

    # --- disk --------------------------------------------------------------------------------------------------

    def _start(self, parent: Path, keep: int, started_utc: datetime) -> None:
        """Make the folder, write its head, let the oldest runs go."""
        try:
            parent.mkdir(parents=True, exist_ok=True)
            directory = _new_folder(parent, started_utc)
            self._copy_files(directory)
            self._write_head(directory)
            self.path = directory
            forget_old_runs(parent, keep)
        except OSError as error:
            self._stop(f"{parent}: {error.strerror or error}; set journal.directory to a folder that can be written")

    def _copy_files(self, directory: Path) -> None:
        """Keep what the request refers to, such as a stored reference: it may be another file tomorrow."""
        for name, value in self._head["request"].items():
            if isinstance(value, str) and (source := Path(value)).is_file():
                copy = f"{name}{source.suffix}"
                with self._opener(directory / copy, "wb") as file:
                    file.write(source.read_bytes())
                self._head["attachments"][name] = copy

    def _guarded(self, write: Callable[[Path], None]) -> None:
        if self.path is None or not self._taking_notes:
            return
        try:
            free = self._free_bytes(self.path)
            needed = RESERVE_BYTES + self._lines_bytes + self.tape.waiting_bytes
            if free < needed:
                self._stop(
                    f"{self.path}: {free / 1e6:.0f} MB free, {needed / 1e6:.0f} MB needed with the reserve of "
                    f"{RESERVE_BYTES / 1e6:.0f} MB; free some space or lower journal.keep"
                )
                return
            write(self.path)
        except OSError as error:
            self._stop(f"{self.path}: {error.strerror or error}; free some space or set journal.directory")

    def _write_gathered(self, directory: Path) -> None:
        self.tape.flush()
        if self.tape.truncated is not None:
            self._mark_truncated(self.tape.truncated)
        if not self._lines:
            return
        if self._decisions is None:
            self._decisions = self._opener(directory / DECISIONS_FILE, "wb")
        lines, self._lines, self._lines_bytes = self._lines, [], 0
        self._decisions.write("".join(f"{line}\n" for line in lines).encode("ascii"))
        self._decisions.flush()

    def _write_head(self, directory: Path, *, result: Any = None, error: Any = None, truth: Any = None) -> None:
        """Replace ``run.json`` whole: it is the old one or the new one, never a piece."""
        head = {**self._head, "result": result, "error": error, "truth": truth, "truncated": self.truncated}
        temporary = directory / f"{RUN_FILE}.tmp"
        with self._opener(temporary, "wb") as file:
            file.write(json.dumps(json.loads(to_json(head)), indent=2).encode("ascii") + b"\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(directory / RUN_FILE)

    def _stop(self, reason: str) -> None:
        """End the journal: nothing can or may be written any more."""
        self._taking_notes = False
        self._lines, self._lines_bytes = [], 0
        self.tape.abandon(reason)
        self._mark_truncated(reason)

    def _mark_truncated(self, reason: str) -> None:
        """Remember that something is missing, say so once."""
        if self.truncated is None:
            self.truncated = reason
            log.warning("journal truncated; focus goes on", reason=reason)


def forget_old_runs(parent: Path, keep: int) -> list[Path]:
    """Delete all but the newest *keep* runs; return what was deleted.

    Only folders that carry both our kind of name and our ``run.json`` count: rename a run and it stays for ever.
    """
    runs = sorted(folder for folder in parent.iterdir() if is_run(folder) and _FOLDER_NAME.fullmatch(folder.name))
    old = runs[: max(0, len(runs) - keep)]
    for folder in old:
        shutil.rmtree(folder, ignore_errors=True)  # another process may be at it too; the next run tries again
    return old


def is_run(folder: Path) -> bool:
    """Say whether *folder* holds a ``run.json`` of ours."""
    if folder.is_symlink() or not folder.is_dir():
        return False
    try:
        head = json.loads((folder / RUN_FILE).read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(head, dict) and {"format", "elpd", "config", "request"} <= head.keys()


def _new_folder(parent: Path, started_utc: datetime) -> Path:
    """Make ``<UTC time>-<nnn>``, after all that are there: names sort by age, whatever was deleted meanwhile."""
    second = f"{started_utc:%Y%m%dT%H%M%SZ}"
    taken = [int(name) for path in parent.glob(f"{second}-???") if (name := path.name[-3:]).isdigit()]
    for number in range(max(taken, default=0) + 1, 1000):
        folder = parent / f"{second}-{number:03d}"
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise OSError("a thousand runs in one second; that is not a rig")
