"""What the camera looks at: natural pictures in linear light, and a few synthetic ones.

The pictures are CC0 or public-domain photographs (``scenes/LICENCES.md``), stored grey as JPEG at their own resolution.
The sRGB curve is undone and a floor of 0.3 % of full scale added (stray light and quantisation), so intensities
span 0.003 to 1, about 50 dB. A sensor larger than a picture sees it continued by mirror images at the picture's own
scale, because enlarging would leave nothing fine enough to be in or out of focus.
"""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.errors import ConfigError

if TYPE_CHECKING:
    from numpy.typing import NDArray

PICTURES = ("astronaut", "brick", "camera", "chelsea", "coffee", "grass", "gravel", "rocket")
SYNTHETIC = ("flat", "edges", "bars", "siemens")
NAMES = (*PICTURES, *SYNTHETIC)
RANDOM = "random"
FLOOR = 0.003


def choose_scene(name: str, rng: np.random.Generator) -> str:
    """Return *name*, or for ``random`` one of the natural pictures. Raises ``ConfigError`` if there is none such."""
    drawn = PICTURES[int(rng.integers(len(PICTURES)))]
    if name == RANDOM:
        return drawn
    if name not in NAMES:
        raise ConfigError(f"sim.scene is {name!r}; known: {', '.join((RANDOM, *NAMES))}")
    return name


def scene_canvas(name: str, width: int, height: int, margin_px: int) -> NDArray[np.float32]:
    """Return linear intensity, (height + 2·margin, width + 2·margin) float32 in 0.003 .. 1, centred on the scene."""
    canvas_width, canvas_height = width + 2 * margin_px, height + 2 * margin_px
    if name in SYNTHETIC:
        return _synthetic(name, canvas_width, canvas_height)
    return _cut(_linear(_read(name)), canvas_width, canvas_height)


def _read(name: str) -> NDArray[np.uint8]:
    data = resources.files("elpd_drivers.sim").joinpath("scenes", f"{name}.jpg").read_bytes()
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return np.asarray(picture, np.uint8)


def _linear(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Undo the sRGB curve (IEC 61966-2-1) and add the floor."""
    v = grey.astype(np.float64) / 255.0
    linear = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    return (FLOOR + (1 - FLOOR) * linear).astype(np.float32)


def _cut(picture: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Cut the middle out, continuing the picture by mirror images where it is too small."""
    rows = _mirrored(picture.shape[0], height)
    columns = _mirrored(picture.shape[1], width)
    return np.ascontiguousarray(picture[np.ix_(rows, columns)])


def _mirrored(size: int, wanted: int) -> NDArray[np.intp]:
    index = (np.arange(wanted) + (size - wanted) // 2) % (2 * size)
    return np.where(index < size, index, 2 * size - 1 - index).astype(np.intp)


def _synthetic(name: str, width: int, height: int) -> NDArray[np.float32]:
    y, x = np.mgrid[:height, :width].astype(np.float64)
    if name == "flat":
        return np.full((height, width), 0.2, np.float32)
    if name == "bars":
        # Vertical bars only: a shift along them changes nothing, one across them looks like a change of blur.
        bars = 0.05 + 0.4 * (np.floor(x / 24) % 2) + 0.3 * (np.floor(x / 37) % 2) + 0.1 * (np.floor(x / 7) % 2)
        return np.asarray(bars, np.float32)
    if name == "edges":
        # Vertical bars of several widths and contrasts over horizontal ones: step edges in both directions.
        picture = 0.2 + 0.15 * (np.floor(x / 24) % 2) + 0.08 * (np.floor(y / 40) % 2) + 0.05 * (np.floor(x / 7) % 2)
        return np.asarray(picture, np.float32)
    angle = np.arctan2(y - height / 2, x - width / 2)
    star = 0.25 + 0.2 * np.clip(4 * np.sin(24 * angle), -1, 1)
    return np.asarray(star, np.float32)
