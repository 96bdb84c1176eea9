"""Slow, obvious twins of the peers' and the benchmark's kernels, and little focus stacks whose truth is known."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from elpd.baselines import FocusStack, StackFrame
from elpd.records import Geometry, Roi

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

# --- twins -------------------------------------------------------------------------------------------------------


def golden_search(t_us: Sequence[int], stop_us: float = 1_000.0) -> float:
    """EGS by scanning every event in every step."""
    begin, end = float(t_us[0]), float(t_us[-1])
    answer = 0.5 * (begin + end)
    while end - begin > stop_us:
        kept = [float(t) for t in t_us if begin <= t <= end]
        if len(kept) < 2 or kept[-1] <= kept[0]:
            break
        begin, end = kept[0], kept[-1]
        span = end - begin
        width = 0.618 * span
        first, second = begin, begin + 0.381 * span
        count = [sum(opening < t <= opening + width for t in kept) for opening in (first, second)]
        chosen = second if count[1] > count[0] else first
        answer = next((t for t in kept if t > chosen + 0.5 * width), kept[-1])
        end = next((t for t in kept if t > chosen + width), kept[-1])
        begin = end - width
    return answer


def mirror_similarity(on: Sequence[float], off: Sequence[float], reach: int) -> list[float]:
    """Correlate rates with their mirror image about every half index."""
    bins = len(on)
    answer = []
    for s in range(2 * bins - 1):
        pairs = [(i, s - i) for i in range(bins) if i < s - i < bins]
        pairs = sorted(pairs, key=lambda pair: pair[1] - pair[0])[:reach]
        a = np.array([value for i, _ in pairs for value in (on[i], off[i])])
        b = np.array([value for _, j in pairs for value in (off[j], on[j])])
        varied = len(pairs) >= 2 and a.std() > 0.0 and b.std() > 0.0
        answer.append(float(np.corrcoef(a, b)[0, 1]) if varied else -1.0)
    return answer


def adaptive_filter(raw: Sequence[float]) -> list[float]:
    """The released ELP filter, one value at a time."""
    out: list[float] = []
    for k, value in enumerate(raw):
        window = raw[max(0, k - 9) : k + 1]
        near = abs(value - sum(window) / len(window)) <= 5e4
        out.append(0.4 * value + 0.6 * out[-1] if out and near else float(value))
    return out


def leak_steps(
    events: Sequence[tuple[int, int, int, int]],
    decay_per_us: float,
    off_step: float,
    shape: tuple[int, int],
    until_us: int,
) -> NDArray[np.float64]:
    """Leaky integration, read as the sum it is: every event's step, faded since it happened."""
    level = np.zeros(shape)
    for t_us, x, y, on in events:
        level[y, x] += (1.0 if on else -off_step) * math.exp(-decay_per_us * (until_us - t_us))
    return level


def voxel_grid(
    events: Sequence[tuple[int, int, int, int]], shape: tuple[int, int], bins: int = 5
) -> NDArray[np.float64]:
    """A hat function over each bin, one event at a time."""
    grid = np.zeros((bins, *shape))
    begin, span = events[0][0], max(events[-1][0] - events[0][0], 1)
    for t_us, x, y, on in events:
        place = (bins - 1) * (t_us - begin) / span
        for one in range(bins):
            grid[one, y, x] += (1.0 if on else -1.0) * max(0.0, 1.0 - abs(place - one))
    return grid


def fold_spectrum(
    nodes: Sequence[NDArray[np.complex128]], weights: Sequence[float], shift_cells: tuple[float, float]
) -> NDArray[np.complex128]:
    """Blend half spectra, shift by (x, y) cells, and take every third cell, by way of the large image."""
    side = nodes[0].shape[0]
    blend = sum(weight * node for weight, node in zip(weights, nodes, strict=True))
    y, x = np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :]
    moved = blend * np.exp(-2j * np.pi * (shift_cells[0] * x + shift_cells[1] * y))
    # The small spectrum carries a factor of nine that sampling every third cell takes out again.
    return np.fft.rfft2(np.fft.irfft2(moved, s=(side, side))[::3, ::3]) * 9.0


def cross_thresholds(
    levels: tuple[NDArray[np.float64], NDArray[np.float64]],
    times_us: tuple[float, float],
    thresholds: NDArray[np.float64],
    refractory_us: float,
    noise: Sequence[tuple[float, int, int]],
    reference: NDArray[np.float64],
    busy_until_us: NDArray[np.float64],
) -> list[tuple[float, int, int]]:
    """One frame interval of the retina, pixel by pixel, as the text of the model says it."""
    begin, end = times_us
    found = []
    for t, pixel, on in noise:
        if t >= busy_until_us[pixel]:
            found.append((t, pixel, on))
            busy_until_us[pixel] = t + refractory_us
    for pixel in range(levels[0].size):
        start, slope = levels[0][pixel], (levels[1][pixel] - levels[0][pixel]) / (end - begin)
        now = begin
        while now < end:
            if busy_until_us[pixel] > now:
                now = min(busy_until_us[pixel], end)
                reference[pixel] = start + slope * (now - begin)
                continue
            level = start + slope * (now - begin)
            up, down = reference[pixel] + thresholds[pixel, 0], reference[pixel] - thresholds[pixel, 1]
            if level - up >= 0.0:
                when, on = now, 1
            elif down - level >= 0.0:
                when, on = now, 0
            elif slope > 0.0:
                when, on = now - (level - up) / slope, 1
            elif slope < 0.0:
                when, on = now - (down - level) / -slope, 0
            else:
                break
            if when >= end:
                break
            found.append((when, pixel, on))
            busy_until_us[pixel] = when + refractory_us
    return found


# --- little stacks -----------------------------------------------------------------------------------------------

SIDE = 48
SWEEP_US = 200_000


def little_stack(
    picture: NDArray[np.float64],
    *,
    focus_us: float = 100_000.0,
    threshold: float = 0.1,
    frame_every_us: int | None = 10_000,
    move: Callable[[float], float] = lambda _: 0.0,
    widest_px: float = 4.0,
) -> FocusStack:
    """Sweep a Gaussian blur over *picture* (SIDE, SIDE), positive intensities, and record what pixels would say.

    The width is a hyperbola about *focus_us*, as a lens's is; *move* gives a shift along x in pixels at a time. One
    level crossing per pixel and half millisecond at most, no noise: what a peer gets wrong here is its own doing.
    """
    y, x = np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None, :]
    spectrum = np.fft.rfft2(picture)
    step_us = 500
    reference = None
    events: list[tuple[int, int, int, int]] = []
    frames = []
    for t_us in range(0, SWEEP_US + 1, step_us):
        sigma_px = math.hypot(0.8, widest_px * (t_us - focus_us) / focus_us)
        blur = np.exp(-2.0 * (np.pi * sigma_px) ** 2 * (x * x + y * y) - 2j * np.pi * x * move(t_us))
        image = np.maximum(np.fft.irfft2(spectrum * blur, s=(SIDE, SIDE)), 1e-3)
        level = np.log(image)
        if reference is None:
            reference = level.copy()
        for sign, on in ((1.0, 1), (-1.0, 0)):
            rows, columns = np.nonzero(sign * (level - reference) >= threshold)
            reference[rows, columns] += sign * threshold
            # Spread over the step, so that stamps are not all alike.
            stamps = t_us + (37 * rows + 11 * columns) % step_us
            events.extend(zip(stamps, columns, rows, np.full(rows.size, on), strict=True))
        if frame_every_us is not None and t_us % frame_every_us == 0:
            scaled = np.clip(np.round(image * 90.0), 0, 255).astype(np.uint8)
            frames.append(StackFrame(t_us, scaled))
    columns = np.array(sorted(events), dtype=np.int64).reshape(-1, 4)
    return FocusStack(
        np.ascontiguousarray(columns[:, 0]),
        columns[:, 1].astype(np.uint16),
        columns[:, 2].astype(np.uint16),
        columns[:, 3].astype(np.uint8),
        Geometry(SIDE, SIDE),
        Roi(0, 0, SIDE, SIDE),
        0,
        SWEEP_US + step_us,
        tuple(frames),
    )


def texture(seed: int) -> NDArray[np.float64]:
    """Patches of random brightness, as much bright as dark on a logarithmic scale: (SIDE, SIDE), about 1."""
    rng = np.random.default_rng(seed)
    coarse = np.exp(rng.uniform(-1.0, 1.0, (SIDE // 3, SIDE // 3)))
    return np.kron(coarse, np.ones((3, 3)))


def stars(seed: int) -> NDArray[np.float64]:
    """Bright points on a dim ground: (SIDE, SIDE)."""
    rng = np.random.default_rng(seed)
    sky = np.full((SIDE, SIDE), 0.1)
    for row, column in rng.integers(2, SIDE - 2, (12, 2)):
        sky[row : row + 2, column : column + 2] = 2.0
    return sky


def stack_of_rates(on: Sequence[int], off: Sequence[int], bin_us: int = 1_000) -> FocusStack:
    """A stack without space: so many ON and OFF events, evenly spaced, in each bin."""
    stamps = []
    for k, (n_on, n_off) in enumerate(zip(on, off, strict=True)):
        for count, polarity in ((n_on, 1), (n_off, 0)):
            stamps.extend((k * bin_us + math.floor((m + 0.5) * bin_us / count), polarity) for m in range(count))
    table = np.array(sorted(stamps), dtype=np.int64).reshape(-1, 2)
    zeros = np.zeros(table.shape[0], dtype=np.uint16)
    return FocusStack(
        np.ascontiguousarray(table[:, 0]),
        zeros,
        zeros,
        table[:, 1].astype(np.uint8),
        Geometry(1, 1),
        Roi(0, 0, 1, 1),
        0,
        len(on) * bin_us,
    )
