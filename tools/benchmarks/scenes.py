"""Pictures to look at: the seven that stand for the paper's seven scenes.

They come from scikit-image's example data, CC0 or public domain (``data/scenes/LICENCES.md``), and are the benchmark's
own copies: what is measured with must not change because a demonstration wants to look different. Each is cut to a
square and resampled to the grid. Grey values are taken for linear intensity, as the paper and v2e do.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

PICTURES = Path(__file__).parent / "data" / "scenes"
SCENES = ("astronaut", "brick", "camera", "chelsea", "coffee", "grass", "gravel")
BLANKS = ("wall", "card", "cap")
_BLANK_DN = {"wall": 200.0, "card": 60.0, "cap": 0.0}


def load_picture(name: str, side: int) -> NDArray[np.float32]:
    """Return the middle square of scene *name* as (side, side) float32 of 0 to 255.

    ``BLANKS`` are even fields of grey.
    """
    if name in _BLANK_DN:
        return np.full((side, side), _BLANK_DN[name], dtype=np.float32)
    grey = cv2.imread(str(PICTURES / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise FileNotFoundError(f"scene {name}: no picture of that name; choose from {', '.join(SCENES)}")
    short = min(grey.shape)
    top, left = (grey.shape[0] - short) // 2, (grey.shape[1] - short) // 2
    square = grey[top : top + short, left : left + short].astype(np.float32)
    resampled = cv2.resize(square, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(resampled, 0.0, 255.0), dtype=np.float32)
