"""The last temporal map on disk, so that a person can look, draw, and then focus on *that* map.

A map goes stale: the scene changes, the lens moves, somebody swaps the camera. So the file says when and at which lens
position it was made, and ``check`` refuses one that does not fit, with the numbers.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.errors import FormatError, UsageError
from elpd.records import TemporalImage
from elpd.units import SensorUs

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.records import Geometry

VERSION = 1

MAX_AGE_S = 1800.0
"""Half an hour: a coffee break, not a night."""

MAX_SHIFT_DOF = 4.0
"""A map made within this many depths of focus of where the lens is now shows the same blur."""


@dataclass(frozen=True, slots=True)
class StoredMap:
    """A map with its circumstances. ``made_unix_s`` is wall-clock time, for people and for the age check alone."""

    image: TemporalImage
    position_um: float
    made_unix_s: float

    def check(self, geometry: Geometry, position_um: float, depth_of_focus_um: float, now_unix_s: float) -> None:
        """Raise ``UsageError`` unless the map fits the sensor, is young enough, and was made about here."""
        height, width = self.image.log_intensity.shape
        if (width, height) != (geometry.width, geometry.height):
            raise UsageError(
                f"the last map has {width}x{height} pixels, the sensor {geometry.width}x{geometry.height}; "
                "make a new one with `elpd expose`"
            )
        age_s = now_unix_s - self.made_unix_s
        if not 0 <= age_s <= MAX_AGE_S:
            raise UsageError(
                f"the last map is {age_s:.0f} s old (limit {MAX_AGE_S:.0f}); make a new one with `elpd expose`"
            )
        shift_um = abs(position_um - self.position_um)
        if shift_um > MAX_SHIFT_DOF * depth_of_focus_um:
            raise UsageError(
                f"the last map was made with the lens at {self.position_um:.1f} um, it is now at {position_um:.1f} "
                f"({shift_um:.1f} um away, limit {MAX_SHIFT_DOF * depth_of_focus_um:.1f}); "
                f"move the lens back or make a new map with `elpd expose`"
            )


def save(path: Path, stored: StoredMap) -> None:
    """Write atomically: a reader sees the old map or the new one, never half of one."""
    image = stored.image
    facts = {
        "version": VERSION,
        "position_um": stored.position_um,
        "made_unix_s": stored.made_unix_s,
        **{key: value for key, value in asdict(image).items() if key not in {"log_intensity", "valid"}},
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, log_intensity=image.log_intensity, valid=image.valid, facts=json.dumps(facts))
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".tmp")
    with draft.open("wb") as file:
        file.write(buffer.getvalue())
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)


def load(path: Path) -> StoredMap:
    """Read a stored map. Raises ``FormatError`` if the file is not one."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as data:
            facts = json.loads(str(data["facts"]))
            if facts.pop("version") != VERSION:
                raise FormatError(f"{path}: a map of another version; make a new one with `elpd expose`")
            position_um, made_unix_s = float(facts.pop("position_um")), float(facts.pop("made_unix_s"))
            facts["open_us"] = SensorUs(facts["open_us"])
            image = TemporalImage(log_intensity=data["log_intensity"], valid=data["valid"], **facts)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise FormatError(f"{path}: not a stored map ({error}); make a new one with `elpd expose`") from None
    return StoredMap(image, position_um, made_unix_s)
