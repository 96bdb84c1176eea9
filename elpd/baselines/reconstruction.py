"""A picture from events alone, without an aperture and without weights: the high-pass filter.

After the events-only form of the complementary filter (Scheirlinck, Barnes and Mahony, *Continuous-time intensity
estimation using event cameras*, ACCV 2018). Every pixel holds an estimate of its log intensity, relative to what it
rested at: an event adds its threshold, and in between the estimate decays,

    dL/dt = -α·L + Σₖ pₖ·c(pₖ)·δ(t - tₖ)

so that what noise and unequal thresholds integrate to stays bounded. Solved exactly from event to event, one
exponential each; the answer is smoothed by a Gaussian, as they do. It was chosen among the reconstructions that need no
training because it has no iterations to tune and no flow or variational problem to solve (Bardow 2016, Kim 2014,
Cook 2011), and because what it gives at a time uses nothing later. Here it makes the reference for the ablation "no
EvTemMap": what the paper did with E2VID.

Known to work where pictures appear or edges cross the sensor. A defocused sweep shows it only *changes* of blur: a
picture much like the Laplacian of the scene, with nothing of what does not change. That is its limit, not a mistake.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Geometry

CUT_OFF_RAD_S = 5.0
"""α: what rests for more than a fifth of a second fades. A sweep is over by then."""

SMOOTHING_PX = 1.0


def reconstruct(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    geometry: Geometry,
    until_us: int,
) -> NDArray[np.float32]:
    """Return log intensity (height, width) at *until_us*, in ON thresholds, relative to rest.

    Events are in order of time and none is later than *until_us*. OFF events count by the ratio of ON to OFF events in
    the whole, which makes up for unequal thresholds where as much brightens as darkens; with one polarity alone, by 1.
    Raises ``ValueError`` for events after *until_us*.
    """
    if t_us.size and t_us[-1] > until_us:
        raise ValueError(f"an event of {t_us[-1]} us is later than the picture of {until_us} us")
    brighter = int(np.count_nonzero(on))
    darker = on.size - brighter
    off_step = brighter / darker if brighter and darker else 1.0
    level = np.zeros((geometry.height, geometry.width))
    last_us = np.full((geometry.height, geometry.width), float(t_us[0]) if t_us.size else float(until_us))
    x, y, on = np.ascontiguousarray(x), np.ascontiguousarray(y), np.ascontiguousarray(on)
    leak_steps(np.ascontiguousarray(t_us), x, y, on, CUT_OFF_RAD_S * 1e-6, off_step, level, last_us)
    level *= np.exp(-CUT_OFF_RAD_S * 1e-6 * (until_us - last_us))
    return np.asarray(cv2.GaussianBlur(level, (0, 0), SMOOTHING_PX), dtype=np.float32)


@kernel("void(int64[::1], uint16[::1], uint16[::1], uint8[::1], float64, float64, float64[:, ::1], float64[:, ::1])")
def leak_steps(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    decay_per_us: float,
    off_step: float,
    level: NDArray[np.float64],
    last_us: NDArray[np.float64],
) -> None:
    """Carry *level* and *last_us* (height, width), of each pixel's last event, through the events (n,)."""
    for k in range(t_us.size):
        row, column = y[k], x[k]
        level[row, column] *= np.exp(-decay_per_us * (t_us[k] - last_us[row, column]))
        level[row, column] += 1.0 if on[k] else -off_step
        last_us[row, column] = t_us[k]
