"""How the scene moves across the sensor, in pixels, while the lens sweeps.

Three kinds are the ELP paper's (its synthetic data set): a velocity drawn anew for every 1 ms frame, normal with mean
3 px/s and standard deviation 20 (moderate) or 100 px/s (violent); because it is white, the path is a random walk of a
few pixels only. ``shake`` is what a hand does: an Ornstein-Uhlenbeck velocity of 100 px/s rms with 30 ms correlation.
The path is folded back into the margin of the rendered canvas, as if the hand turned round. A steady *pan* may be added
to any kind: over bars that run along it, or in a scene with edges of one direction, motion and blur are hard to tell
apart.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from elpd.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np

NODE_US = 1_000
DRIFT_PX_S = 3.0
WHITE_SD_PX_S = {"moderate": 20.0, "violent": 100.0}
SHAKE_RMS_PX_S = 100.0
SHAKE_CORRELATION_MS = 30.0
KINDS = ("static", "moderate", "violent", "shake")
KEPT_NODES = 1024


class SceneMotion:
    """The displacement of the scene over time: linear between nodes 1 ms apart, drawn as they are asked for.

    Parameters
    ----------
    kind
        One of ``KINDS``.
    reach_px
        The path stays within ± this, in x and in y.
    pan_px_s
        A steady velocity (x, y) on top.
    """

    def __init__(
        self, kind: str, rng: np.random.Generator, reach_px: float, pan_px_s: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        if kind not in KINDS:
            raise ConfigError(f"sim.motion is {kind!r}; known: {', '.join(KINDS)}")
        self.moving = kind != "static" or pan_px_s != (0.0, 0.0)
        self._pan_px_s = pan_px_s
        self._kind = kind
        self._rng = rng
        self._reach_px = reach_px
        self._velocity_px_s = (0.0, 0.0)
        self._first = 0
        self._nodes = [(0.0, 0.0)]

    def displacement_px(self, since_birth_us: float) -> tuple[float, float]:
        """Return (x, y) at an instant not more than a second before the latest one asked for."""
        if not self.moving:
            return 0.0, 0.0
        pan_x, pan_y = (1e-6 * since_birth_us * speed for speed in self._pan_px_s)
        node, within_us = divmod(since_birth_us, NODE_US)
        index = int(node)
        while self._first + len(self._nodes) <= index + 1:
            self._grow()
        before, after = self._nodes[index - self._first], self._nodes[index + 1 - self._first]
        part = within_us / NODE_US
        return (
            _fold(before[0] + (after[0] - before[0]) * part + pan_x, self._reach_px),
            _fold(before[1] + (after[1] - before[1]) * part + pan_y, self._reach_px),
        )

    def _grow(self) -> None:
        step_s = NODE_US * 1e-6
        draw = self._rng.standard_normal(2)
        if self._kind == "static":
            vx = vy = 0.0
        elif self._kind == "shake":
            keep = math.exp(-NODE_US * 1e-3 / SHAKE_CORRELATION_MS)
            kick = SHAKE_RMS_PX_S * math.sqrt((1 - keep * keep) / 2)
            vx = keep * self._velocity_px_s[0] + kick * draw[0]
            vy = keep * self._velocity_px_s[1] + kick * draw[1]
        else:
            sd = WHITE_SD_PX_S[self._kind]
            vx, vy = DRIFT_PX_S + sd * draw[0], DRIFT_PX_S + sd * draw[1]
        self._velocity_px_s = (vx, vy)
        x, y = self._nodes[-1]
        self._nodes.append((x + vx * step_s, y + vy * step_s))
        if len(self._nodes) > 2 * KEPT_NODES:
            del self._nodes[:KEPT_NODES]
            self._first += KEPT_NODES


def _fold(x: float, reach: float) -> float:
    """Reflect *x* at ±reach until it lies between them."""
    period = 4 * reach
    x = (x + reach) % period
    return (x if x < 2 * reach else period - x) - reach
