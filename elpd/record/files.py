"""Files that appear whole or not at all, and which format a new one has.

A recording that is converted must not stand there half written under its name: it is written beside it and renamed at
the end, when it is on the disk.
"""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING

from elpd.errors import FormatError, UsageError
from elpd.events.stream import installed_formats
from elpd.ports import WritableFormat

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def writable_formats() -> dict[str, tuple[WritableFormat, str]]:
    """Return every word of ``--format`` that is installed: what writes it, and its usual suffix."""
    return {
        word: (candidate, suffix)
        for candidate in installed_formats().values()
        if isinstance(candidate, WritableFormat)
        for word, suffix in candidate.writes.items()
    }


def format_for(path: Path, word: str | None) -> tuple[WritableFormat, str]:
    """Return what writes *word*, or the format that the suffix of *path* usually means.

    Raises
    ------
    UsageError
        If no installed format has that word or suffix; the message lists those there are.
    FormatError
        If a package is missing; the message says how to install it.
    """
    known = writable_formats()
    if word is None:
        word = next((name for name, (_, suffix) in known.items() if suffix == path.suffix.lower()), None)
        if word is None:
            suffixes = ", ".join(dict.fromkeys(suffix for _, suffix in known.values())) or "none"
            raise UsageError(
                f"{path.name}: {f'no format has the suffix {path.suffix!r}' if path.suffix else 'there is no suffix'}; "
                f"known are {suffixes}; or say which format with --format"
            )
    if word not in known:
        raise UsageError(f"--format {word!r} cannot be written; known are {', '.join(known)}")
    found = known[word][0]
    missing = found.can_write(word)
    if missing is not None:
        raise FormatError(f"{path.name}: {missing}")
    return found, word


def refuse_to_overwrite(path: Path, *, force: bool) -> None:
    """Raise ``UsageError`` if *path* cannot be a new file, or is an old one and *force* is not given."""
    if path.is_dir():
        raise UsageError(f"{path} is a directory; give a file's name")
    if not path.parent.is_dir():
        raise UsageError(f"{path}: there is no folder {path.parent}; make it first")
    if path.exists() and not force:
        raise UsageError(f"{path} exists; give another name, or --force to replace it")


@contextmanager
def appearing_whole(path: Path, *, force: bool) -> Iterator[Path]:
    """Give a name beside *path* to write to; at the end it becomes *path*, or after an error is removed.

    Raises ``UsageError`` if *path* exists, also if it came into being meanwhile, unless *force* is given.
    """
    refuse_to_overwrite(path, force=force)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        refuse_to_overwrite(path, force=force)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
