"""How slow each pixel's photoreceptor is, by how bright the picture is where focus was.

A pixel is as slow as the light that it has when it turns. A temporal map shows that; a frame from before the sweep was
blurred, and the events since say what it became.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.light import in_focus
from elpd.vision.turns import Slowness

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.vision.rebuilt import EventStretch

DARK = 0.08
"""Dark current, relative to the brightest parts: below it a photoreceptor gets no slower (v2e's 20 of 255 levels)."""

DARK_OF_MAP = 0.01
"""The same for a temporal map: it is made of the photocurrents themselves, the dark current is in it already."""

WORTHS = (2.5, 5.0, 10.0, 20.0, 40.0)
"""Thresholds per unit of log intensity that are tried where nothing tells: sensors have 3 to 20, and below the dark
current a unit of log intensity is more light than it seems."""

WORTH_UNKNOWN = 0.25
"""Standard deviation, in shares, of what an event is worth by the light that a lens conserves: some crosses a region's
border, and thresholds differ from pixel to pixel (seven dim scenes: 0.17 to 0.26 for a true 0.2)."""

DARK_UNKNOWN = 0.25
"""The same of the dark current: it is relative to the brightest parts of a region, which need not be bright."""


def by_brightness(
    brightness: NDArray[np.float32] | None, events: EventStretch, dark: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return each pixel's say in S, and its slowness: how many times slower than the brightest its receptor is."""
    if brightness is None:
        shape = (events.height, events.width)
        return np.ones(shape, dtype=np.float32), np.ones(shape)
    smooth = cv2.GaussianBlur(brightness, (0, 0), 4.0) + np.float32(dark)
    weight = np.asarray(smooth / np.float32(smooth.mean()), dtype=np.float32)
    return weight, (1.0 + dark) / (np.maximum(brightness, 0.0).astype(np.float64) + dark)


def slownesses_in_focus(
    start: NDArray[np.float32], level: NDArray[np.float32], worth: float, margin: int
) -> list[Slowness]:
    """Return how slow each pixel is in the picture in focus; then with worth and dark current an error off."""
    found = []
    for share, dark in (
        (1.0, DARK),
        (1.0 - WORTH_UNKNOWN, DARK),
        (1.0 + WORTH_UNKNOWN, DARK),
        (1.0, DARK * (1.0 - DARK_UNKNOWN)),
        (1.0, DARK * (1.0 + DARK_UNKNOWN)),
    ):
        found.append(Slowness.of((1.0 + dark) / (in_focus(start, level, share * worth, margin) + dark)))
    return found


def slownesses(
    start: NDArray[np.float32] | None, level: NDArray[np.float32], slowness: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Return candidates of how slow each pixel is, where it is not known what an event is worth in log intensity.

    A pixel is as slow as the light that it has when it turns, and the start picture was blurred. So several worths are
    tried, and the picture as it was.
    """
    if start is None:
        return [slowness]
    found = [slowness]
    bright = np.maximum(start.astype(np.float64), 0.0) + DARK
    for worth in WORTHS:
        lit = bright * np.exp(np.clip(level.astype(np.float64) / worth, -5.0, 5.0))
        found.append((1.0 + DARK) / np.clip(lit, DARK, 1.0 + DARK))
    return found
