"""Slow, obvious twins of the kernels that look for focus."""

from collections import defaultdict
from itertools import pairwise
from typing import Any


def cap_pixels(t_us: Any, x: Any, y: Any, burst: Any, decay_us: Any) -> Any:
    """Keep an event unless its pixel's debt would exceed decay_us; time pays the debt off."""
    debt, last = defaultdict(int), defaultdict(int)
    keep = []
    for t, column, row in zip(t_us, x, y, strict=True):
        pixel = (column, row)
        debt[pixel] = max(0, debt[pixel] - (t - last[pixel]))
        last[pixel] = t
        allowed = debt[pixel] + decay_us // burst <= decay_us
        if allowed:
            debt[pixel] += decay_us // burst
        keep.append(allowed)
    return keep


def sum_windows(t_us: Any, x: Any, y: Any, on: Any, weights: Any, region: Any, edges_us: Any) -> Any:
    """Sum each window by asking every event whether it belongs there."""
    x0, y0, x1, y1 = region
    rows = []
    for begin, end in pairwise(edges_us):
        elp = energy = n_on = n_off = 0
        for t, column, row, brighter in zip(t_us, x, y, on, strict=True):
            if begin <= t < end and x0 <= column < x1 and y0 <= row < y1:
                weight = int(weights[row][column])
                polarity = 1 if brighter else -1
                elp -= polarity * weight
                energy += weight * weight
                n_on += brighter == 1
                n_off += brighter == 0
        rows.append([elp, energy, n_on, n_off])
    return rows


def stamp_events(events: Any, stamp: Any, height: Any, width: Any) -> Any:
    band = [[0.0] * width for _ in range(height)]
    reach = len(stamp) // 2
    for x, y, on in events:
        for row in range(-reach, reach + 1):
            for column in range(-reach, reach + 1):
                if 0 <= y + row < height and 0 <= x + column < width:
                    band[y + row][x + column] += (1 if on else -1) * stamp[row + reach][column + reach]
    return band


def mirror_pairs(t_us: Any, x: Any, y: Any, on: Any, position: Any) -> Any:
    """Return (before, after, t, x, y, on) of each opposite event that follows two equal ones of its pixel."""
    history = defaultdict(list)
    pairs = []
    for t, column, row, polarity, here in zip(t_us, x, y, on, position, strict=True):
        past = history[column, row]
        if len(past) >= 2 and past[-1][0] == past[-2][0] != polarity:
            pairs.append((past[-2][1], here, t, column, row, polarity))
        past.append((polarity, here))
    return pairs


def knots(events: Any) -> Any:
    """Return the (position, level) knots of one pixel's events [(position, step)], levels joined linearly."""
    points = [(-float("inf"), 0.0)]
    level = 0.0
    for k, (here, step) in enumerate(events):
        if k == 0:
            points.append((here, level))  # constant up to the first event, then it has been crossed
        elif events[k - 1][1] * step < 0:
            last = events[k - 1][0]
            mirrored = (last + here) / 2
            if k >= 2 and events[k - 2][1] * events[k - 1][1] > 0:
                mirrored = max(here - (last - events[k - 2][0]), mirrored)
            points.append((mirrored, level))
        level += step
        points.append((here, level))
    return points


def steps_with_losses(events: Any, deaf_us: Any, most: Any) -> Any:
    """Return how far the level of one pixel went with each of its events [(time, on)]."""
    lost = [0.0]
    for (before, was_on), (now, on) in pairwise(events):
        heard = max(now - before - deaf_us, deaf_us / most)
        lost.append(deaf_us / heard if on == was_on and deaf_us > 0 else 0.0)
    lost.append(0.0)
    return [(1.0 if on else -1.0) * (1.0 + 0.5 * (lost[k] + lost[k + 1])) for k, (_, on) in enumerate(events)]


def level_at(events: Any, tick: Any) -> Any:
    """Return one pixel's level at a tick, from its knots."""
    points = knots(events)
    for (left, low), (right, high) in pairwise(points):
        if left <= tick < right:
            if left == -float("inf"):
                return low
            return low + (high - low) * (tick - left) / (right - left)
    return points[-1][1]
