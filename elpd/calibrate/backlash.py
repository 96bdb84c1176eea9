"""The play between motor and glass, from focus passed in both directions.

Read-back is blind to play: going up, the motor is half of it ahead of the glass, going down half of it behind. So the
same focus is read at two places, ``z_up - z_down = play``, and nothing but the scene can show it. Whatever answers
late shifts both readings along their own motion by ``v·lag``; at two speeds, both ways, play and lag are solved for
together: ``z = middle ± play/2 ± v·lag``.

One shift along the motion does not grow with speed: where ON and OFF thresholds differ, the two halves of a mirror pair
are not at equal light, which would pass for play. So the ratio of the thresholds is measured first, on the same
there-and-backs, and pairs are made level by it (``elpd.calibrate.level_pairs``). What is left has opposite signs where
brightness peaks and where it dips: each pass is fitted with a term for that.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from elpd.calibrate.lag import focus_pairs
from elpd.calibrate.play import Play, Reading
from elpd.calibrate.quantity import Quantity
from elpd.calibrate.thresholds import NoiseRates, measure_balance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.calibrate.evidence import Evidence

FEWEST_PASSES = 2
"""In each direction at each speed: with one, nothing tells how well passes agree."""

STRAIGHT = 0.1
"""Relative error of what unequal thresholds are corrected by: between two events light does not change evenly."""

CURVED = 0.15
"""Relative error of the way that the lag makes: dark pixels follow a fast change less than in proportion to speed."""


def measure_backlash(evidence: Evidence, depth_of_focus_um: float) -> Play:
    """Measure the play on there-and-backs through focus at two speeds."""
    otherwise = evidence.why_not("sweeps", "focus was not passed often enough in both directions")
    if not evidence.sweeps:
        return solve([], otherwise)
    geometry = evidence.geometry
    good = np.ones((geometry.height, geometry.width), np.bool_)
    ratio = measure_balance(evidence.sweeps, NoiseRates(0.0, 0.0), good, geometry).ratio
    if ratio.value is None:
        why = f"without the balance of ON and OFF there is none, and {ratio.reason}"
        return Play(Quantity.none(why, "um"), Quantity.none(why, "us"), ())
    found = solve(_readings(evidence, good, depth_of_focus_um, ratio.value), otherwise)
    naive = solve(_readings(evidence, good, depth_of_focus_um, 1.0), otherwise)
    play = found.backlash_um
    if play.value is None or play.sigma is None or naive.backlash_um.value is None:
        return found
    doubt_um = STRAIGHT * abs(play.value - naive.backlash_um.value)
    return replace(found, backlash_um=Quantity.of(play.value, math.hypot(play.sigma, doubt_um), "um"))


def _readings(evidence: Evidence, good: NDArray[np.bool_], depth_of_focus_um: float, ratio: float) -> list[Reading]:
    """Return where each pass saw focus, by pairs that a ratio of thresholds makes level."""
    readings = []
    for sweep in evidence.sweeps:
        for one in sweep.passes:
            pairs = focus_pairs(sweep, one, good, evidence.geometry, depth_of_focus_um, ratio)
            if pairs is None:
                continue
            found, weight = pairs
            dip = 2.0 * found.on.astype(np.float64) - 1.0
            place = _place(one.sign * found.middle, dip, weight, depth_of_focus_um)
            if place is not None:
                at, sigma = place
                readings.append(Reading(speed_um_s=one.sign * sweep.speed_um_s, focus_um=at, sigma_um=sigma))
    return readings


def solve(readings: Sequence[Reading], otherwise: str) -> Play:
    """Solve ``z = middle ± play/2 + v·lag`` for play and lag, by the passes' errors and by how well they agree.

    *otherwise* is the reason where nothing was read.
    """
    speeds = sorted({abs(one.speed_um_s) for one in readings})
    passes = [sum(one.speed_um_s == sign * speed for one in readings) for speed in speeds for sign in (1, -1)]
    if len(speeds) < 2 or min(passes) < FEWEST_PASSES:
        why = otherwise
        if readings:
            why = (
                f"focus was seen in {', '.join(map(str, passes))} passes only (up and down, slow to fast; at least "
                f"{FEWEST_PASSES} each are needed); aim at more texture or light"
            )
        return Play(Quantity.none(why, "um"), Quantity.none(why, "us"), tuple(readings))
    speed = np.array([one.speed_um_s for one in readings])
    at = np.array([one.focus_um for one in readings])
    sigma = np.array([one.sigma_um for one in readings])
    design = np.stack([np.ones_like(at), 0.5 * np.sign(speed), 1e-6 * speed], axis=1)
    inverse = np.linalg.inv(design.T @ (design / sigma[:, None] ** 2))
    found = inverse @ (design.T @ (at / sigma**2))
    freedom = at.size - 3
    misfit = float(np.square((at - design @ found) / sigma).sum()) / freedom
    wider = math.sqrt(max(1.0, misfit) * freedom / max(freedom - 2, 1))  # few passes: Student's tails
    play, lag_us = float(found[1]), float(found[2])
    lag_way_um = 2.0 * 1e-6 * abs(lag_us) * speeds[-1]
    play_sigma = math.hypot(wider * math.sqrt(inverse[1, 1]), CURVED * lag_way_um)
    return Play(
        Quantity.of(play, play_sigma, "um"),
        Quantity.of(lag_us, wider * math.sqrt(inverse[2, 2]), "us"),
        tuple(readings),
    )


def _place(
    middle: NDArray[np.float64], dip: NDArray[np.float64], weight: NDArray[np.float64], depth_of_focus_um: float
) -> tuple[float, float] | None:
    """Return where peaks and dips (*dip* -1 and 1) agree that focus is, and its standard error; robustly."""
    kinds = [k for k in (-1.0, 1.0) if float(weight[dip == k].sum()) > 0.05 * float(weight.sum())]
    columns = [np.ones_like(middle), dip] if len(kinds) == 2 else [np.ones_like(middle)]
    design = np.stack(columns, axis=1)
    found = np.zeros(len(columns))
    found[0] = float(np.median(middle))
    scale, inverse, biweight = depth_of_focus_um, np.eye(len(columns)), weight
    for _ in range(40):
        residual = middle - design @ found
        biweight = weight * np.square(np.maximum(0.0, 1.0 - np.square(residual / (4.7 * scale))))
        normal = design.T @ (design * biweight[:, None])
        if biweight.sum() <= 0.0 or np.linalg.cond(normal) > 1e12:
            return None
        inverse = np.asarray(np.linalg.inv(normal), np.float64)
        found = inverse @ (design.T @ (biweight * middle))
        near = np.abs(middle - design @ found)
        order = np.argsort(near, kind="stable")
        half = int(np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum()))
        scale = max(1.4826 * float(near[order][min(half, near.size - 1)]), 1e-3 * depth_of_focus_um)
    scores = design * (biweight * (middle - design @ found))[:, None]
    covariance = inverse @ (scores.T @ scores) @ inverse
    return float(found[0]), math.sqrt(float(covariance[0, 0]))
