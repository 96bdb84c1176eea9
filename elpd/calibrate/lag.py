"""How late photoreceptors are, against how bright they are.

A pixel whose photoreceptor lags by τ sees focus go by τ late, so a lens that goes by at speed v is ``v·τ`` further on.
Mirror pairs (``elpd.vision.pairs``) tell, pixel by pixel, where the lens was. In one direction two speeds give

    m_1 - m_2 = (v_1 - v_2)·τ

and backlash, an asymmetric lens, unequal thresholds and the place of focus itself drop out, because they are the same
at both. It is fitted to all pairs at once, ``m = z_up/down ± v·τ``, for each class of brightness. The refractory
period (an event stands for the level at its end, and so comes early) and an error of the clock between camera and lens
shift all pixels alike: the line ``τ = τ_0 + τ_1·s`` over the slowness s (1 for the brightest parts, in inverse
proportion to light, as ``elpd.vision.slowness`` counts it) keeps them apart in τ_0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.calibrate.level_pairs import level_pairs
from elpd.calibrate.quantity import Quantity
from elpd.vision.pairs import Pairs, find_pairs, weighted_mode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.calibrate.evidence import Pass, Sweeps
    from elpd.records import Geometry

DARK = 0.04
"""Dark current, relative to the brightest parts of the picture: below it a photoreceptor gets no slower."""

CLASSES = 6
FEWEST_PAIRS = 150
"""Pairs of one class of brightness; with fewer, fewer classes are made."""

STEADY = 0.98
"""Share of full speed at which the lens counts as steady."""

REACH_DOF = 3.0
"""Pairs this far from the mode, in depths of focus, are looked at; the fit gives those that disagree less say."""

MODE_DOF = 0.5
LAW = 0.5
"""Relative error of the lag that scatter does not show: a photoreceptor follows the light of the moment, which changes
with defocus, a peak as short as the lag is passed on flattened, and how dark current bounds the lag is not known. As
large as the scatter about the simulator's truth over scenes, thresholds and seeds (``tools/calibration.py``)."""

_SPEED_US = 500.0


@dataclass(frozen=True, slots=True)
class LagClass:
    """Pixels of one brightness: its mean relative to the brightest parts, their mean slowness, and their lag.

    ``lag`` is less the constant that all classes share.
    """

    brightness: float
    slowness: float
    lag: Quantity
    pairs: int


@dataclass(frozen=True, slots=True)
class Lag:
    """``per_slowness`` is τ_1, the lag of the brightest parts; ``constant`` is τ_0; both us."""

    per_slowness: Quantity
    constant: Quantity
    classes: tuple[LagClass, ...]


@dataclass(frozen=True, slots=True)
class _Crossings:
    """Pairs of all passes: middle um, signed speed um/s, whether upward, slowness, pixel number, weight."""

    middle: NDArray[np.float64]
    velocity: NDArray[np.float64]
    up: NDArray[np.bool_]
    brightness: NDArray[np.float64]
    pixel: NDArray[np.int64]
    weight: NDArray[np.float64]


def slowness_of(brightness: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how many times slower than the brightest a photoreceptor is; as ``elpd.vision.slowness`` has it."""
    slow: NDArray[np.float64] = (1.0 + DARK) / (np.maximum(brightness, 0.0) + DARK)
    return slow


def measure_lag(
    sweeps: Sequence[Sweeps],
    brightness: NDArray[np.float32] | None,
    good: NDArray[np.bool_],
    geometry: Geometry,
    depth_of_focus_um: float,
    *,
    doubt: float = 0.0,
) -> Lag:
    """Measure the photoreceptors' lag on there-and-backs through focus at two speeds or more.

    Parameters
    ----------
    brightness:
        (height, width), relative to the brightest parts.
    doubt:
        Relative error of the slowness that follows from *brightness*.
    """
    if brightness is None:
        return _none("nothing says which pixels are bright: that takes frames, or an aperture to expose with")
    if len(sweeps) < 2:
        return _none("that takes sweeps through focus at two speeds")
    found = []
    for sweep in sorted(sweeps, key=lambda one: one.speed_um_s)[:2]:
        for one in sweep.passes:
            pairs = focus_pairs(sweep, one, good, geometry, depth_of_focus_um)
            if pairs is not None:
                found.append(_crossings(pairs, one, sweep, brightness))
    speeds = {round(abs(float(one.velocity.mean()))) for one in found if one.middle.size}
    if len(speeds) < 2:
        return _none(
            "focus was not passed at two speeds: no pixels turned together on the way; focus first, then sweep round it"
        )
    return _line(_joined(found), depth_of_focus_um, float(np.hypot(LAW, doubt)))


def _none(reason: str) -> Lag:
    return Lag(Quantity.none(reason, "us"), Quantity.none(reason, "us"), ())


def focus_pairs(
    sweep: Sweeps,
    one: Pass,
    good: NDArray[np.bool_],
    geometry: Geometry,
    depth_of_focus_um: float,
    ratio: float | None = None,
) -> tuple[Pairs, NDArray[np.float64]] | None:
    """Return the pairs around focus of one pass, with weights; ``None`` if focus was not passed at a steady speed.

    Positions are the ruler's times the pass's sign, so that they rise. *good* is (height, width). With *ratio*, C_on
    over C_off, the halves of a pair are at equal light where thresholds differ too.
    """
    events = sweep.events.between(one.begin_us, one.end_us)
    t_us, x, y, on = events.chosen(good[events.y, events.x])
    if t_us.size < FEWEST_PAIRS:
        return None
    shape = (geometry.height, geometry.width)
    position = sweep.path.at(t_us)
    if ratio is None:
        pairs = find_pairs(t_us, x, y, on, one.sign * position, shape)
    else:
        pairs = level_pairs(t_us, x, y, on, one.sign * position, ratio)
    if pairs.on.size < FEWEST_PAIRS:
        return None
    gap = np.maximum(pairs.after - pairs.before, 0.02 * depth_of_focus_um)
    rough = weighted_mode(pairs.middle, 1.0 / gap, MODE_DOF * depth_of_focus_um)
    if rough is None:
        return None
    # What the events have drawn when focus is passed tells peaks from troughs, and so which turns are focus.
    until = int(np.searchsorted(one.sign * position, rough.at))
    level = np.zeros(shape, np.float32)
    np.add.at(level, (y[:until], x[:until]), np.where(on[:until] == 1, ratio or 1.0, -1.0).astype(np.float32))
    smooth = cv2.GaussianBlur(level, (0, 0), 1.0)
    curvature = cv2.Laplacian(smooth, cv2.CV_32F)[pairs.y, pairs.x].astype(np.float64)
    believed = (2.0 * pairs.on - 1.0) * curvature > 0.0
    weight = np.where(believed, np.abs(curvature) / gap, 0.0)
    mode = weighted_mode(pairs.middle, weight, MODE_DOF * depth_of_focus_um)
    if mode is None:
        return None
    believed &= np.abs(pairs.middle - mode.at) <= REACH_DOF * depth_of_focus_um
    if int(believed.sum()) < FEWEST_PAIRS or not _steady(sweep, one, mode.at * one.sign, depth_of_focus_um):
        return None
    taken = Pairs(*(getattr(pairs, name)[believed] for name in ("before", "after", "after_us", "x", "y", "on")))
    return taken, weight[believed]


def _steady(sweep: Sweeps, one: Pass, at_um: float, depth_of_focus_um: float) -> bool:
    """Whether the lens went at full speed for some depths of focus on either side of a place."""
    reach_us = 1e6 * 2.0 * REACH_DOF * depth_of_focus_um / sweep.speed_um_s
    when = sweep.path.time_of(at_um, 0.5 * (one.begin_us + one.end_us))
    speeds = [1e6 * sweep.path.speed_at(when + part * reach_us, _SPEED_US) for part in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    return bool(min(speeds) > STEADY * sweep.speed_um_s)


def _crossings(
    found: tuple[Pairs, NDArray[np.float64]], one: Pass, sweep: Sweeps, brightness: NDArray[np.float32]
) -> _Crossings:
    pairs, weight = found
    size = pairs.on.size
    return _Crossings(
        one.sign * pairs.middle,
        np.full(size, one.sign * sweep.speed_um_s),
        np.full(size, one.sign > 0),
        brightness[pairs.y, pairs.x].astype(np.float64),
        pairs.y.astype(np.int64) * brightness.shape[1] + pairs.x,
        weight / weight.mean(),
    )


def _joined(found: Sequence[_Crossings]) -> _Crossings:
    return _Crossings(
        *(
            np.concatenate([getattr(one, name) for one in found])
            for name in ("middle", "velocity", "up", "brightness", "pixel", "weight")
        )
    )


def _line(all_: _Crossings, depth_of_focus_um: float, law: float) -> Lag:
    """Fit each class of brightness by itself, then the line through the classes."""
    count = int(np.clip(all_.middle.size // (4 * FEWEST_PAIRS), 1, CLASSES))
    edges = np.quantile(all_.brightness, np.linspace(0.0, 1.0, count + 1))
    number = np.clip(np.searchsorted(edges, all_.brightness, side="right") - 1, 0, count - 1)
    slow = slowness_of(all_.brightness)
    classes = []
    for k in range(count):
        inside = number == k
        part = _Crossings(*(getattr(all_, name)[inside] for name in _Crossings.__slots__))
        lag = _class_lag(part, depth_of_focus_um)
        if lag is not None:
            classes.append(LagClass(float(part.brightness.mean()), float(slow[inside].mean()), lag, int(inside.sum())))
    if len(classes) < 2 or np.ptp([one.slowness for one in classes]) < 0.5:
        return Lag(
            Quantity.none("bright and dark pixels were not apart enough to tell a lag that depends on light", "us"),
            Quantity.none("the same lag at every brightness cannot be told from it", "us"),
            (),
        )
    s = np.array([one.slowness for one in classes])
    tau = np.array([one.lag.value for one in classes], np.float64)
    sigma = np.array([one.lag.sigma for one in classes], np.float64)
    design = np.stack([np.ones_like(s), s], axis=1) / sigma[:, None]
    inverse = np.linalg.inv(design.T @ design)
    constant, slope = (float(one) for one in inverse @ (design.T @ (tau / sigma)))
    # Birge: a line that misses its points by more than their errors is known less well.
    freedom = max(1, len(classes) - 2)
    misfit = float(np.square((tau - constant - slope * s) / sigma).sum()) / freedom
    wider = float(np.sqrt(max(1.0, misfit)))
    return Lag(
        Quantity.of(slope, float(np.hypot(wider * np.sqrt(inverse[1, 1]), law * slope)), "us"),
        Quantity.of(constant, float(np.hypot(wider * np.sqrt(inverse[0, 0]), law * slope * s.min())), "us"),
        tuple(
            LagClass(
                one.brightness,
                one.slowness,
                Quantity.of(t - constant, float(np.hypot(e, law * (t - constant))), "us"),
                one.pairs,
            )
            for one, t, e in zip(classes, tau, sigma, strict=True)
        ),
    )


def _class_lag(part: _Crossings, depth_of_focus_um: float) -> Quantity | None:
    """Fit ``middle = z_up or z_down + velocity·lag`` robustly; the pairs of one pixel share its faults."""
    design = np.stack([part.up, ~part.up, 1e-6 * part.velocity], axis=1).astype(np.float64)
    design = design[:, design.any(axis=0)]
    parameters = np.zeros(design.shape[1])
    for k in range(design.shape[1] - 1):
        parameters[k] = float(np.median(part.middle[design[:, k] > 0.0]))
    scale = depth_of_focus_um
    inverse: NDArray[np.float64] = np.eye(design.shape[1])
    weight = part.weight
    for _ in range(40):
        residual = part.middle - design @ parameters
        weight = part.weight * np.square(np.maximum(0.0, 1.0 - np.square(residual / (4.7 * scale))))
        normal = design.T @ (design * weight[:, None])
        if weight.sum() <= 0.0 or np.linalg.cond(normal) > 1e14:
            return None
        inverse = np.asarray(np.linalg.inv(normal), np.float64)
        parameters = inverse @ (design.T @ (weight * part.middle))
        near = np.abs(part.middle - design @ parameters)
        order = np.argsort(near, kind="stable")
        half = int(np.searchsorted(np.cumsum(part.weight[order]), 0.5 * part.weight.sum()))
        scale = max(1.4826 * float(near[order][min(half, near.size - 1)]), 1e-3 * depth_of_focus_um)
    scores = design * (weight * (part.middle - design @ parameters))[:, None]
    _, owner = np.unique(part.pixel, return_inverse=True)
    by_pixel = np.stack([np.bincount(owner, weights=column) for column in scores.T], axis=1)
    covariance = inverse @ (by_pixel.T @ by_pixel) @ inverse
    return Quantity.of(float(parameters[-1]), float(np.sqrt(covariance[-1, -1])), "us")
