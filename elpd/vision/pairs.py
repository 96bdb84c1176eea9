"""Mirror pairs: where the lens was when the blur turned, pixel by pixel, without knowing contrast or threshold.

Near focus a pixel's log intensity rises to an extremum and comes back. Its events sample that curve at levels one
threshold apart: after a run of two or more equal events at t0 and t1, the first opposite event at t2 lies one threshold
below t1's level, which is t0's level. Equal level before and after the turn means equal blur, so focus is the midpoint
of the *lens positions* at t0 and t2, for any contrast, threshold, texture or blur curve that is symmetric in focus.
The sign change of the Event Laplacian Product has no such luck: it is late by a contrast-dependent amount.

Many pixels also turn for other reasons (noise, an edge sweeping over them), so pairs are gated by sign and time and
combined by their weighted *mode*, not their mean. Scene motion makes mirrors of its own: pairs alone are not to be
trusted in motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray


@kernel(
    "int64(int64[::1], uint16[::1], uint16[::1], uint8[::1], float64[::1], int64[:, :, ::1], float64[:, :, ::1], "
    "float64[::1], float64[::1], int64[::1], uint16[::1], uint16[::1], uint8[::1])"
)
def mirror_pairs(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    position: NDArray[np.float64],
    run: NDArray[np.int64],
    memory: NDArray[np.float64],
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    after_us: NDArray[np.int64],
    pair_x: NDArray[np.uint16],
    pair_y: NDArray[np.uint16],
    pair_on: NDArray[np.uint8],
) -> int:
    """Find the mirror pairs of an event stream; return how many were written to the output arrays.

    Parameters
    ----------
    t_us, x, y, on:
        Events in time order; ``on`` is 1 or 0.
    position:
        Lens position at each event, any unit.
    run:
        (height, width, 2) ``int64`` state, zero at first: length of the present run of equal polarities, and its
        polarity.
    memory:
        (height, width, 2) ``float64`` state: lens positions of the last event but one, and of the last.
    before, after, after_us, pair_x, pair_y, pair_on:
        Outputs, at least as long as the input: lens positions of the two halves of a pair, time, pixel and polarity of
        its second half.
    """
    found = 0
    for i in range(t_us.size):
        row = y[i]
        column = x[i]
        if run[row, column, 0] > 0 and run[row, column, 1] == on[i]:
            run[row, column, 0] += 1
        else:
            if run[row, column, 0] >= 2:
                before[found] = memory[row, column, 0]
                after[found] = position[i]
                after_us[found] = t_us[i]
                pair_x[found] = column
                pair_y[found] = row
                pair_on[found] = on[i]
                found += 1
            run[row, column, 0] = 1
            run[row, column, 1] = on[i]
        memory[row, column, 0] = memory[row, column, 1]
        memory[row, column, 1] = position[i]
    return found


@dataclass(frozen=True, slots=True)
class Pairs:
    """Mirror pairs: positions of the halves, pixel and polarity of the second half."""

    before: NDArray[np.float64]
    after: NDArray[np.float64]
    after_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]

    @property
    def middle(self) -> NDArray[np.float64]:
        """Each pair's own idea of focus."""
        return 0.5 * (self.before + self.after)


@dataclass(frozen=True, slots=True)
class Mode:
    """The mode of a weighted sample: where, how well known (one standard deviation), from how many, how peaked.

    ``share`` is the part of all weight within two kernel widths of the mode.
    """

    at: float
    sigma: float
    count: float
    share: float


def find_pairs(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    position: NDArray[np.float64],
    shape: tuple[int, int],
) -> Pairs:
    """Return every mirror pair of a recorded stretch; *shape* is (height, width)."""
    size = t_us.size
    run = np.zeros((*shape, 2), dtype=np.int64)
    memory = np.zeros((*shape, 2), dtype=np.float64)
    before = np.empty(size)
    after = np.empty(size)
    after_us = np.empty(size, dtype=np.int64)
    pair_x = np.empty(size, dtype=np.uint16)
    pair_y = np.empty(size, dtype=np.uint16)
    pair_on = np.empty(size, dtype=np.uint8)
    n = mirror_pairs(t_us, x, y, on, position, run, memory, before, after, after_us, pair_x, pair_y, pair_on)
    return Pairs(before[:n], after[:n], after_us[:n], pair_x[:n], pair_y[:n], pair_on[:n])


def weighted_mode(values: NDArray[np.float64], weights: NDArray[np.float64], width: float) -> Mode | None:
    """Return the mode of a weighted sample under a Gaussian kernel of standard deviation *width*.

    The standard error is the spread within two widths over the root of the effective number there; ``None`` when
    there is no weight or no width.
    """
    total = float(weights.sum())
    if values.size == 0 or total <= 0.0 or width <= 0.0:
        return None
    # Histogram at a tenth of the kernel, smooth, take the top cell; then mean-shift on the exact values.
    low = float(values.min()) - 4.0 * width
    cells = int((float(values.max()) + 4.0 * width - low) / (0.1 * width)) + 1
    if cells > 1_000_000:
        return None
    density, _ = np.histogram(values, bins=cells, range=(low, low + cells * 0.1 * width), weights=weights)
    kernel_x = np.arange(-40, 41) * 0.1
    smooth = np.convolve(density, np.exp(-0.5 * kernel_x**2), mode="same")
    at = low + (int(np.argmax(smooth)) + 0.5) * 0.1 * width
    for _ in range(30):
        pull = weights * np.exp(-0.5 * ((values - at) / width) ** 2)
        moved = float(np.dot(pull, values) / pull.sum()) if pull.sum() > 0.0 else at
        if abs(moved - at) < 1e-6 * width:
            break
        at = moved
    near = np.abs(values - at) <= 2.0 * width
    w = weights[near]
    count = float(w.sum() ** 2 / np.square(w).sum())
    spread = float(np.sqrt(np.dot(w, (values[near] - at) ** 2) / w.sum()))
    return Mode(at, spread / np.sqrt(count), count, float(w.sum()) / total)
