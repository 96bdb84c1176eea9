"""What people have set and want to find again: regions, presets, the mode, the temperature at the last focus.

Changes take effect in memory at once; writing them is the desk's business, and a disk that refuses is a warning.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, ValidationError

from elpd.errors import UsageError
from elpd.service import store
from elpd.service.messages import ModeName, Preset, RoiBox  # noqa: TC001  (pydantic asks for them at run time)

if TYPE_CHECKING:
    from pathlib import Path

FILE = "service.json"


class Thermometer(BaseModel):
    """Where focus was, and how warm it was then; *sign* is the side that the lens came from."""

    model_config = ConfigDict(frozen=True)

    focus_um: float
    celsius: float
    sign: int = 0


class Content(BaseModel):
    """The file's content. A newer daemon's keys are dropped, not refused."""

    model_config = ConfigDict(frozen=True)

    roi: RoiBox | None = None
    named: dict[str, RoiBox] = {}
    presets: dict[str, Preset] = {}
    mode: ModeName | None = None
    period_s: float | None = None
    thermometer: Thermometer | None = None
    open: bool = False
    """Whether a daemon holds the rig: one that finds this set when it starts knows that another ended badly."""


class Kept:
    """The content, changed by methods and written by ``save``. Thread-safe.

    Parameters
    ----------
    directory
        Where the file lies.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / FILE
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        found, self.complaint = store.read(self.path)
        """What to tell about the file, if anything."""
        try:
            self._content = Content.model_validate(found or {})
        except ValidationError as error:
            self.complaint = f"{self.path}: {error.errors()[0]['msg'].lower()}; defaults are used"
            self._content = Content()
        self._dirty = False

    @property
    def content(self) -> Content:
        """Everything, as it is now."""
        return self._content

    @property
    def roi(self) -> RoiBox | None:
        """The default region."""
        return self._content.roi

    def presets(self) -> list[Preset]:
        """Return all presets by name."""
        return [preset for _, preset in sorted(self._content.presets.items())]

    def preset(self, name: str) -> Preset:
        """Return one. Raises ``UsageError`` with the names there are."""
        found = self._content.presets.get(name)
        if found is None:
            raise UsageError(
                f"there is no preset {name!r}; there are: {', '.join(sorted(self._content.presets)) or 'none'}"
            )
        return found

    def save_preset(self, preset: Preset) -> None:
        """Add or replace a preset."""
        self.change(presets={**self._content.presets, preset.name: preset})

    def delete_preset(self, name: str) -> None:
        """Forget a preset. Raises ``UsageError`` if there is none."""
        self.preset(name)
        self.change(presets={key: value for key, value in self._content.presets.items() if key != name})

    def set_roi(self, roi: RoiBox | None, name: str | None = None) -> None:
        """Set the default region, or the one of a name."""
        if name is None:
            self.change(roi=roi)
        elif roi is not None:
            self.change(named={**self._content.named, name: roi})

    def delete_roi(self, name: str) -> None:
        """Forget a region. Raises ``UsageError`` if there is none of that name."""
        if name not in self._content.named:
            raise UsageError(
                f"there is no region {name!r}; there are: {', '.join(sorted(self._content.named)) or 'none'}"
            )
        self.change(named={key: value for key, value in self._content.named.items() if key != name})

    def change(self, **changes: Any) -> None:
        """Replace fields, in memory."""
        with self._lock:
            self._content = self._content.model_copy(update=changes)
            self._dirty = True

    def save(self) -> None:
        """Write what has changed. Raises ``OSError``; what is in memory stays, and the next ``save`` tries again."""
        with self._writing:
            with self._lock:
                content, dirty, self._dirty = self._content, self._dirty, False
            if not dirty:
                return
            try:
                store.write(self.path, content.model_dump(mode="json"))
            except OSError:
                self._dirty = True
                raise
