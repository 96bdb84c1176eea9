"""The picture in focus, from one out of focus and the events between: how bright each pixel was when it turned.

An event is worth a change of log intensity that nobody knows: thresholds differ between cameras, and pixels hold
back. But a lens makes no light, it only moves it about: the mean intensity of a region is the same in focus and out of
it, but for what crosses the border. With a start picture I and the events' level n since then,

    mean I·(exp(θ·n) - 1) = 0

has θ = 0 for a root, and because the exponential bends upwards, one more: what an event is worth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.vision.integral import inside_margin

if TYPE_CHECKING:
    from numpy.typing import NDArray

LEAST_WORTH, MOST_WORTH = 0.02, 0.5
"""Contrast thresholds of event sensors, in log intensity; a root beyond them is not a threshold."""

_STEPS = 48
_HALVINGS = 20
_LIMIT = 6.0
"""Contrasts beyond e^6 are not of a scene."""

BRIGHTEST = 99.5
"""Percentile of brightness that stands for the brightest parts, so that one lamp is no yardstick."""


def worth_of_an_event(start: NDArray[np.float32], level: NDArray[np.float32], margin: int) -> float | None:
    """Return what an event is worth in log intensity, ``None`` where light is not conserved by any worth.

    Parameters
    ----------
    start
        (height, width): linear intensity when the first event came, in any unit.
    level
        (height, width): events since then, ON less OFF, in focus.
    margin
        Pixels at the border that do not count.
    """
    inside = inside_margin(level.shape, margin)
    light = np.maximum(start[inside], 0.0).astype(np.float64).ravel()
    events = level[inside].astype(np.float64).ravel()
    if light.sum() <= 0.0:
        return None

    def gained(worth: float) -> float:
        return float(light @ np.expm1(np.clip(worth * events, -_LIMIT, _LIMIT)))

    worths = np.geomspace(LEAST_WORTH, MOST_WORTH, _STEPS)
    if gained(worths[0]) >= 0.0:
        return None
    above = next((k for k, worth in enumerate(worths) if gained(worth) >= 0.0), None)
    if above is None:
        return None
    low, high = float(worths[above - 1]), float(worths[above])
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if gained(middle) >= 0.0 else (middle, high)
    return 0.5 * (low + high)


def in_focus(start: NDArray[np.float32], level: NDArray[np.float32], worth: float, margin: int) -> NDArray[np.float64]:
    """Return the picture in focus, (height, width), relative to its brightest parts and capped there."""
    lit = np.maximum(start, 0.0) * np.exp(np.clip(worth * level.astype(np.float64), -_LIMIT, _LIMIT))
    top = float(np.percentile(lit[inside_margin(lit.shape, margin)], BRIGHTEST))
    return np.asarray(np.minimum(lit / max(top, 1e-12), 1.0), dtype=np.float64)
