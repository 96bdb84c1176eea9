"""Registered regression: what motion does to the events is taken out of them before they are asked about focus.

A picture that has gone stale makes a product with the events turn negative before focus. The classical remedy is to
know where the picture has gone. While picture L moves by u and blurs, events of threshold C add up to

    C·E = -u·∇L + κ·∇²L,      κ = ½·d(σ²)

so least squares over the region tell the shift u of every tick and κ at once; the picture is then looked at where it
has gone (the sum of all u), and what a wrong place does to it is a second derivative along the motion, which is
regressed out as well while the scene moves. κ is negative while focus is approached. The picture must be as blurred as
what the sensor sees, or u comes out too small: of six blurs the one is taken that explains most. The threshold is what
frames say the events between them were worth, a usual one where there is one frame. The weights are the picture's
brightness, because bright pixels answer at once.

This is the benchmark's ablation: ``elpd`` follows motion in no such way. It is causal but for the time step, a share of
the record. Known to work where edges of all directions move by some pixels between two frames; late like every change
of sign, because pixels that turn are silent first.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.baselines.stack import Estimate, FocusStack, no_answer

if TYPE_CHECKING:
    from numpy.typing import NDArray

TICKS = 256
"""A tick is a fifth of a depth of focus of the benchmark's sweeps."""

BLURS_PX = (0.6, 1.0, 1.6, 2.5, 4.0, 6.0)
MEMORY_TICKS = 8.0
"""How long what a blur explains is remembered."""

USUAL_THRESHOLD = 0.2
GROUND = 10.0 / 255.0
"""Added to brightness before its logarithm."""

MOVES = 9.0
"""χ² of two components above which a tick's shift is motion."""

SIGMAS = 6.0
"""What turns round is believed when it has gone back so many standard deviations."""

Maps = tuple["NDArray[np.float32]", ...]


def estimate(stack: FocusStack) -> Estimate:
    """Return when κ changed its sign; no answer where no change is certain."""
    if not stack.frames:
        return no_answer("no frame to register")
    edges_us = np.linspace(stack.begin_us, stack.end_us, TICKS + 1)
    picture: _Picture | None = None
    waiting = list(stack.frames)
    sums: list[tuple[float, float, float]] = []
    thresholds = _Thresholds()
    for begin_us, end_us in pairwise(edges_us):
        while waiting and waiting[0].t_us <= begin_us:
            frame = waiting.pop(0)
            levels = _levels(frame.pixels, stack)
            thresholds.see(levels, frame.t_us, stack)
            picture = _Picture(levels)
        if picture is None:
            continue
        first, last = (int(place) for place in np.searchsorted(stack.t_us, (begin_us, end_us)))
        seen = _cut(stack, first, last, picture.shift_px)
        score, variance = picture.explain(seen, thresholds.worth)
        sums.append((end_us, score, variance))
    return _turning(np.array(sums))


def _turning(sums: NDArray[np.float64]) -> Estimate:
    """Return the top of the running score once it has fallen from it beyond chance."""
    if len(sums) < 3:
        return no_answer("too short")
    times_us, scores, variances = sums.T
    running, spread = np.cumsum(scores), np.cumsum(variances)
    # What motion and correlated noise add to counting: from how successive ticks differ.
    differ = np.cumsum(np.square(np.diff(scores, prepend=0.0))) / 2.0
    over = np.maximum(1.0, differ / np.maximum(spread, 1e-12))
    top = np.maximum.accumulate(running)
    at_top = np.maximum.accumulate(np.where(running >= top, np.arange(running.size), 0))
    fallen = top - running
    certain = fallen > SIGMAS * np.sqrt(over * np.maximum(spread - spread[at_top], 1e-12))
    risen = top > SIGMAS * np.sqrt(over * np.maximum(spread[at_top], 1e-12))
    decided = np.flatnonzero(certain & risen)
    curve = {"t_us": times_us.tolist(), "running": running.tolist()}
    if not decided.size:
        return no_answer("no change of sign beyond chance", curve=curve)
    when = int(decided[0])
    return Estimate(float(times_us[at_top[when]]), float(times_us[when]), {"curve": curve})


@dataclass(slots=True)
class _Thresholds:
    """What an event is worth in log intensity, by least squares of frames on the events between them."""

    worth: float = USUAL_THRESHOLD
    _before: tuple[NDArray[np.float32], int] | None = None
    _products: float = 0.0
    _squares: float = 0.0

    def see(self, levels: NDArray[np.float32], t_us: int, stack: FocusStack) -> None:
        """Take a frame."""
        if self._before is not None:
            first, last = (int(place) for place in np.searchsorted(stack.t_us, (self._before[1], t_us)))
            net, _ = _cut(stack, first, last, np.zeros(2))
            self._products += float((net * (levels - self._before[0])).sum())
            self._squares += float(np.square(net).sum())
            if self._products > 0.0:
                self.worth = self._products / self._squares
        self._before = levels, t_us


class _Picture:
    """A picture at several blurs, and where its scene has gone."""

    def __init__(self, levels: NDArray[np.float32]) -> None:
        self.shift_px = np.zeros(2)
        self._maps: list[Maps] = []
        self._normal: list[NDArray[np.float64]] = []
        self._explained = np.zeros(len(BLURS_PX))
        bright = np.exp(cv2.GaussianBlur(levels, (0, 0), 4.0))
        self._weight = np.asarray(bright / bright.mean(), np.float32)
        for blur_px in BLURS_PX:
            blurred = cv2.GaussianBlur(levels, (0, 0), blur_px)
            down, right = np.gradient(blurred)
            down_down, down_right = np.gradient(down)
            _, right_right = np.gradient(right)
            maps = tuple(np.asarray(one, np.float32) for one in (right, down, right_right, down_right, down_down))
            self._maps.append(maps)
            self._normal.append(_products(maps, maps, self._weight))

    def explain(self, seen: tuple[NDArray[np.float32], NDArray[np.float32]], worth: float) -> tuple[float, float]:
        """Follow the scene through a tick's events; return the score (positive on the way to focus) and its variance.

        *seen* is the net and the number of events, (height, width), laid where the picture was.
        """
        net, count = seen
        right_sides = [_products(maps, (net,), self._weight)[:, 0] for maps in self._maps]
        first = np.zeros((3, 5))  # right, down, Laplacian
        first[0, 0] = first[1, 1] = first[2, 2] = first[2, 4] = 1.0
        fits = [_fit(first, normal, b) for normal, b in zip(self._normal, right_sides, strict=True)]
        self._explained *= 1.0 - 1.0 / MEMORY_TICKS
        self._explained += [explained for _, explained in fits]
        best = int(np.argmax(self._explained))
        maps, normal, b = self._maps[best], self._normal[best], right_sides[best]
        (right, down, _), _ = fits[best]
        u = -worth * np.array([right, down])
        chosen = first
        length = float(np.hypot(*u))
        noise = float((np.square(self._weight) * count).sum()) / max(float(self._weight.sum()), 1e-12)
        moved = _fit(first[:2], normal, b)[1] / max(noise, 1e-12)
        if moved > MOVES and length > 0.0:
            x, y = u / length
            chosen = np.vstack([first[:2], [0.0, 0.0, x * x, 2.0 * x * y, y * y], first[2]])
        # The Laplacian, freed of what motion explains: its product with the events tells focus alone.
        others, laplacian = chosen[:-1], chosen[-1]
        inner = others @ normal @ others.T
        share = np.linalg.pinv(inner, hermitian=True) @ (others @ normal @ laplacian)
        free = laplacian - share @ others
        rest = sum(np.float32(a) * one for a, one in zip(free, maps, strict=True))
        score = -float(free @ b)
        variance = float((np.square(self._weight * rest) * count).sum())
        self.shift_px += u
        return score, variance


def _fit(
    rows: NDArray[np.float64], normal: NDArray[np.float64], b: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Return the coefficients of *rows* of the maps, and the energy that they explain."""
    side = rows @ b
    found = np.linalg.pinv(rows @ normal @ rows.T, hermitian=True) @ side
    return found, float(found @ side)


def _products(one: Maps, other: Maps, weight: NDArray[np.float32]) -> NDArray[np.float64]:
    left = np.stack([(weight * a).ravel() for a in one])
    right = np.stack([b.ravel() for b in other])
    return np.asarray((left @ right.T).astype(np.float64))


def _levels(pixels: NDArray[np.uint8], stack: FocusStack) -> NDArray[np.float32]:
    """Return the region's log intensity."""
    roi = stack.roi
    cut = pixels[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width].astype(np.float32) / np.float32(255.0)
    return np.asarray(np.log(cut + np.float32(GROUND)), np.float32)


def _cut(
    stack: FocusStack, first: int, last: int, shift_px: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the net and the number of events, (height, width) of the region, each moved back by the shift."""
    roi = stack.roi
    x, y = (
        np.rint(column[first:last] - float(moved)).astype(np.int64) - begin
        for column, moved, begin in zip((stack.x, stack.y), shift_px, (roi.x, roi.y), strict=True)
    )
    inside = (x >= 0) & (x < roi.width) & (y >= 0) & (y < roi.height)
    place = y[inside] * roi.width + x[inside]
    sign = 2.0 * stack.on[first:last][inside] - 1.0
    size = roi.width * roi.height
    net, count = np.bincount(place, sign, size), np.bincount(place, minlength=size)
    return net.reshape(roi.height, -1).astype(np.float32), count.reshape(roi.height, -1).astype(np.float32)
