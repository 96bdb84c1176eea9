"""Pictures to look at: the seven that stand for the paper's seven scenes.

They are the simulated world's own pictures (``elpd_drivers/sim/scenes``, CC0 or public domain, see ``LICENCES.md``
there), cut to a square and resampled to the benchmark's grid. Grey values are taken for linear intensity, as the paper
and v2e do.
"""

from __future__ import annotations

from importlib.resources import as_file, files
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

SCENES = ("astronaut", "brick", "camera", "chelsea", "coffee", "grass", "gravel")
BLANKS = ("wall", "card", "cap")
_BLANK_DN = {"wall": 200.0, "card": 60.0, "cap": 0.0}


def load_picture(name: str, side: int) -> NDArray[np.float32]:
    """Return the middle square of scene *name* as (side, side) float32 of 0 to 255.

    ``BLANKS`` are even fields of grey.
    """
    if name in _BLANK_DN:
        return np.full((side, side), _BLANK_DN[name], dtype=np.float32)
    with as_file(files("elpd_drivers.sim") / "scenes" / f"{name}.jpg") as path:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise FileNotFoundError(f"scene {name}: no picture of that name; choose from {', '.join(SCENES)}")
    short = min(grey.shape)
    top, left = (grey.shape[0] - short) // 2, (grey.shape[1] - short) // 2
    square = grey[top : top + short, left : left + short].astype(np.float32)
    resampled = cv2.resize(square, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(resampled, 0.0, 255.0), dtype=np.float32)
