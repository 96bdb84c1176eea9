"""Find the format that reads an event file: the entry-point group ``elpd.formats``, ours and a stranger's alike."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from elpd.errors import FormatError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.ports import RecordingFormat, RecordingReader


def open_recording(path: Path) -> RecordingReader:
    """Open *path* with the first installed format that recognises its bytes; the caller closes the reader.

    Raises
    ------
    UsageError
        If there is no such file.
    FormatError
        If no format recognises it, or it is damaged.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such file" if not path.exists() else f"{path}: is not a file")
    known: list[str] = []
    for entry in sorted(entry_points(group="elpd.formats"), key=lambda entry: entry.name):
        recording: RecordingFormat = entry.load()
        if recording.recognises(path):
            return recording.open(path)
        known.append(entry.name)
    raise FormatError(
        f"{path}: not an event file that any installed format reads ({', '.join(known) or 'none installed'}); "
        "`elpd check` lists the formats"
    )
