"""What outlives the daemon: one small file, whole or not at all, with the one before it beside it.

Written to a draft, synced, renamed, the folder synced: a power cut leaves the old file or the new one. A sum over the
content tells a file that rotted or was cut off; then the copy of before is used, and that is said. A disk that cannot
be written costs persistence, never focus.
"""

from __future__ import annotations

import hashlib
import json
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

FORMAT = 1


def write(path: Path, content: dict[str, Any]) -> None:
    """Replace *path*; what was there becomes the copy of before. Raises ``OSError``, the old file untouched."""
    body = json.dumps(content, sort_keys=True, allow_nan=False)
    text = json.dumps({"format": FORMAT, "sum": _sum(body), "content": content}, sort_keys=True, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with draft.open("w", encoding="utf-8") as file:
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
        if _readable(path) is not None:
            path.replace(before(path))
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def read(path: Path) -> tuple[dict[str, Any] | None, str | None]:
    """Return what is kept and, if it is not the newest, what to tell the person. Never raises."""
    newest = _readable(path)
    if newest is not None:
        return newest, None
    older = _readable(before(path))
    if older is not None and not path.exists():  # the power failed between the two renames: nothing is lost but this
        return older, f"{path}: the newest state is missing; the copy of before is used"
    if older is not None:
        return older, f"{path}: damaged or cut off; the copy of before is used"
    if path.exists():
        return None, f"{path}: damaged or cut off, and there is no good copy of before; defaults are used"
    return None, None


def before(path: Path) -> Path:
    """Return where the copy of before lies."""
    return path.with_name(f"{path.name}.before")


def _readable(path: Path) -> dict[str, Any] | None:
    try:
        whole = json.loads(path.read_text(encoding="utf-8"))
        content = whole["content"]
        good = whole["format"] == FORMAT and whole["sum"] == _sum(json.dumps(content, sort_keys=True))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return content if good and isinstance(content, dict) else None


def _sum(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8")).hexdigest()
