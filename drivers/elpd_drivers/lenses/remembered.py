"""Where a motor was left, in a file: for controllers that keep no position, so that each session need not home.

The file is gone before a motor begins to move, and comes back when it rests: a crash, a cut of power or a lost reply
leaves no file, and the lens is homed. It is believed only for the motor and the ruler that it was written for.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from elpd.errors import ConfigError, LensError

if TYPE_CHECKING:
    from collections.abc import Mapping


class Remembered:
    """A position that outlives the session; nothing of it happens with an empty *path*.

    Parameters
    ----------
    path
        The file. Its directory must exist and be writable: ``ConfigError``.
    of
        What the position belongs to; a file that was written for anything else is not believed.
    """

    def __init__(self, path: str, of: Mapping[str, object]) -> None:
        self._path = Path(path).expanduser() if path else None
        self._of = dict(of)
        if self._path is not None and not os.access(self._path.parent, os.W_OK | os.X_OK):
            raise ConfigError(
                f"lens.position_file: cannot write into {self._path.parent}; make that directory, or leave the key out"
            )

    def recall(self) -> int | None:
        """Return where the motor was left, in steps; None if that is not known."""
        if self._path is None:
            return None
        try:
            found = json.loads(self._path.read_text("utf-8"))
        except (OSError, ValueError):
            return None
        steps = found.pop("steps", None) if isinstance(found, dict) else None
        return steps if found == self._of and isinstance(steps, int) and not isinstance(steps, bool) else None

    def forget(self) -> None:
        """Make sure that nothing is believed if this ends badly; before a motion. Raises ``LensError`` if it cannot."""
        if self._path is None:
            return
        try:
            self._path.unlink(missing_ok=True)
            self._make_lasting()
        except OSError as error:
            raise LensError(
                f"lens: cannot remove {self._path} ({error.strerror}), which would be wrong after this move; "
                "nothing was moved; remove it, or leave lens.position_file out"
            ) from None

    def keep(self, steps: int) -> None:
        """Note where the motor rests. If that fails it is not remembered, and the next session homes."""
        if self._path is None:
            return
        new = self._path.with_name(f"{self._path.name}.new")
        with suppress(OSError):
            new.write_text(json.dumps({**self._of, "steps": steps}), "utf-8")
            new.replace(self._path)

    def _make_lasting(self) -> None:
        """See that a cut of power does not bring the file back."""
        assert self._path is not None, "asked only with a path"
        directory = os.open(self._path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)
