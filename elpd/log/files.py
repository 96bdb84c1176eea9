"""Log lines in a file, one JSON object each, in files that do not grow for ever.

At ``LIMIT_BYTES`` the file is renamed to FILE.1 (and that to FILE.2, ...), ``KEPT`` old ones stay. A full disk
costs lines, never the program: the next line that can be written says how many, as ``lost_lines``.
"""

from __future__ import annotations

import logging
import sys
from logging.handlers import RotatingFileHandler
from typing import TYPE_CHECKING

from elpd.log.fields import json_text, with_traceback

if TYPE_CHECKING:
    from pathlib import Path

    from structlog.typing import EventDict

LIMIT_BYTES = 16_000_000
KEPT = 4


class JsonLines:
    """A log file. Raises ``OSError`` when it cannot be opened."""

    def __init__(self, path: Path, limit_bytes: int = LIMIT_BYTES) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = _Rotating(path, maxBytes=limit_bytes, backupCount=KEPT, encoding="utf-8")

    def __call__(self, event: EventDict) -> None:
        """Write one line."""
        lost = self._file.lost
        line = json_text(with_traceback(event) | ({"lost_lines": lost} if lost else {}))
        self._file.handle(logging.makeLogRecord({"msg": line}))
        if lost and self._file.lost == lost:
            self._file.lost = 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class _Rotating(RotatingFileHandler):
    """Counts what it could not write, and says so once."""

    lost = 0

    def handleError(self, _: logging.LogRecord) -> None:  # noqa: N802  (the library's name)
        if not self.lost:
            sys.stderr.write(f"elpd: log file {self.baseFilename}: {sys.exc_info()[1]}; lines are lost\n")
        self.lost += 1
