"""How scenes move in front of the lens.

The paper draws a velocity anew for every frame of 1 ms, normal about a slow drift, and lets the translations add up.
Its text leaves open whether pixels are the sensor's or those of the three times finer picture; here they are the
sensor's, and a case set may scale them to the other reading, which is three times gentler. White velocity of 100 px/s
is only 0.1 px per millisecond and a random walk of about 3 px in a second: ``shake`` is what a trembling hand does, a
velocity of the same size that lasts for 30 ms, and ``dynamic`` what a steady one does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Motion:
    """Drift and jitter in px/s along each axis, and how long a jitter's velocity lasts in ms (0: one frame)."""

    drift_px_s: float
    jitter_px_s: float
    lasts_ms: float = 0.0


MOTIONS = {
    "static": Motion(0.0, 0.0),
    "moderate": Motion(3.0, 20.0),
    "violent": Motion(3.0, 100.0),
    "dynamic": Motion(0.0, 30.0, lasts_ms=50.0),
    "shake": Motion(0.0, 100.0, lasts_ms=30.0),
}


def shifts_px(motion: Motion, frames: int, frame_ms: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the accumulated translation (frames, 2) as (x, y), zero in the first frame."""
    draws = rng.standard_normal((frames - 1, 2)) * motion.jitter_px_s
    if motion.lasts_ms > 0.0:
        keep = float(np.exp(-frame_ms / motion.lasts_ms))
        for k in range(1, draws.shape[0]):
            draws[k] = keep * draws[k - 1] + np.sqrt(1.0 - keep * keep) * draws[k]
    steps = (draws + motion.drift_px_s) * (frame_ms / 1e3)
    return np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))
