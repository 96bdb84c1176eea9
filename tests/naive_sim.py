"""Slow, obvious twins of the simulated sensor's kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

F = np.float32


def blend_shifted(
    a: NDArray[Any], b: NDArray[Any], weight: float, top: float, left: float, height: int, width: int
) -> NDArray[np.float64]:
    """Catmull-Rom interpolation of the blend at (top + y, left + x), from its textbook definition."""
    blend = a.astype(np.float64) * (1 - weight) + b.astype(np.float64) * weight

    def cubic(p: NDArray[np.float64], f: float) -> float:
        return float(
            0.5
            * (
                2 * p[1]
                + (p[2] - p[0]) * f
                + (2 * p[0] - 5 * p[1] + 4 * p[2] - p[3]) * f**2
                + (3 * p[1] - p[0] - 3 * p[2] + p[3]) * f**3
            )
        )

    out = np.empty((height, width))
    row, column = int(np.floor(top)), int(np.floor(left))
    for y in range(height):
        for x in range(width):
            patch = blend[row + y - 1 : row + y + 3, column + x - 1 : column + x + 3]
            out[y, x] = cubic(np.array([cubic(line, left - column) for line in patch]), top - row)
    return out


def step_pixels(
    target: NDArray[Any],
    level: NDArray[Any],
    reference: NDArray[Any],
    gain: NDArray[Any],
    spread_on: NDArray[Any],
    spread_off: NDArray[Any],
    held: NDArray[Any],
    release_us: NDArray[Any],
    c_on: float,
    c_off: float,
    spread: float,
    refractory_us: int,
    begin_us: int,
    end_us: int,
) -> list[tuple[int, int, int]]:
    """One pixel after the other, as the docstring of the kernel says; returns (t, pixel, on)."""
    events = []
    span = F(end_us - begin_us)
    for i in range(len(target)):
        first = level[i]
        level[i] = last = first + (target[i] - first) * gain[i]
        slope = (last - first) / span
        on_at = F(c_on) * (F(1) - F(128) * F(spread)) + F(c_on) * F(spread) * F(spread_on[i])
        off_at = F(c_off) * (F(1) - F(128) * F(spread)) + F(c_off) * F(spread) * F(spread_off[i])
        free = begin_us
        if held[i]:
            if release_us[i] >= end_us:
                continue
            held[i] = 0
            free = max(begin_us, int(release_us[i]))
            reference[i] = first + slope * F(free - begin_us)
        while not held[i]:
            if last - reference[i] >= on_at:
                on, crossing = 1, reference[i] + on_at
            elif reference[i] - last >= off_at:
                on, crossing = 0, reference[i] - off_at
            else:
                break
            t = free if slope == 0 else begin_us + int((crossing - first) / slope)
            t = min(max(t, free), end_us - 1)
            events.append((t, i, on))
            free = t + refractory_us
            if free >= end_us:
                held[i], release_us[i] = 1, free
            else:
                reference[i] = first + slope * F(free - begin_us)
    return events


def fire_noise(
    candidates: list[tuple[int, int, int]],
    level: NDArray[Any],
    reference: NDArray[Any],
    held: NDArray[Any],
    release_us: NDArray[Any],
    c_on: float,
    c_off: float,
    dice: NDArray[Any],
    refractory_us: int,
) -> list[tuple[int, int, int]]:
    """Candidates are (t, pixel, kind); returns (t, pixel, on)."""
    events = []
    for (t, i, kind), die in zip(candidates, dice, strict=True):
        if held[i] and release_us[i] > t:
            continue
        residual = F(0) if held[i] else level[i] - reference[i]
        nearer_on = die * (F(c_on) + F(c_off)) < residual + F(c_off)
        events.append((t, i, int(kind == 1 or nearer_on)))
        held[i], release_us[i] = 1, t + refractory_us
    return events
