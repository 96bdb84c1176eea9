"""Contrast thresholds: ON against OFF from sweeps there and back, their spread over pixels, and, with frames, in log.

**Ratio.** A lens that goes there and back returns every pixel to the level from which it came, so what ON events added
OFF events took away: ``C_on·N_on = C_off·N_off``, whatever scene, contrast or blur, and ``C_on / C_off = ΣN_off /
ΣN_on``. Three things disturb this, each is dealt with. What a pixel holds back since its last event differs between
the first motion and later ones: only there-and-backs that follow another are counted. Noise resets a pixel wherever it
stands, on average as far up as down, and leakage adds ON events, to lively and dull pixels alike: ``N_off = R·N_on +
constant`` over all pixels takes it out. (Both counts are rough, so the pixel's count at the *other* speed is the
instrument of this regression.) And a pixel is deaf for its refractory period after each event, so an event stands for
its threshold *and* for the change that was missed, which grows with speed: two speeds are extrapolated to none, ``R_0
= (v_2·R_1 - v_1·R_2) / (v_2 - v_1)``.

**Mismatch.** Per pixel ``D = N_off - R·N_on`` is zero but for what it holds back, noise, and the departure of its own
two thresholds from the sensor's: ``var D = q + (ρ_on² + ρ_off²)·N²``. ``N²`` tells the two apart. A spread that ON and
OFF share scales both counts and cannot be seen without frames; the number given is ``ρ`` for equal, independent
spreads.

**Absolute.** Between two pictures of a lens at rest ``ΔL = a·sign(ΔL) + C_on·N_on - C_off·N_off``; a is what pixels
hold back when they come to rest. Counts are rough and frames are noisy, so neither may be regressed on the other
alone: one half of each stack of frames is the instrument, the other the answer, whose errors are independent. Again
two speeds are extrapolated to none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.calibrate.quantity import Quantity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.calibrate.evidence import Step, Sweeps
    from elpd.records import Geometry

TILE_PX = 16
"""Errors are counted over squares of this side: what neighbours share is in them."""

ACTIVE = 12
"""Events from which on a pixel counts as lively."""

WELL_COUNTED = 24
"""Events from which on the spread of thresholds counts for more than the rounding to whole events."""

FEWEST_PIXELS = 200
NOISE_CHANGE = 0.1
"""Noise may be so much stronger while the lens moves than it was at rest; more than that is the scene's doing."""

FEWEST_FRAME_PIXELS = 200
STEEP = 2.0
"""Changes between pictures that count, in thresholds: smaller ones may hide in what a pixel holds back."""

DARKEST, BRIGHTEST = 0.2, 0.95
"""Grey levels that are believed, of full scale: darker the black level counts, brighter the frame clips."""

BEND = 0.1
"""Error of the extrapolation to no speed, in differences between the two speeds: deafness is not quite proportional."""


@dataclass(frozen=True, slots=True)
class NoiseRates:
    """Resting rates per pixel, Hz; zero where they are not known."""

    on_hz: float = 0.0
    off_hz: float = 0.0

    @property
    def both_hz(self) -> float:
        """ON and OFF together."""
        return self.on_hz + self.off_hz


@dataclass(frozen=True, slots=True)
class Balance:
    """ON against OFF: the ratio of thresholds C_on/C_off, and their spread over pixels, relative."""

    ratio: Quantity
    mismatch: Quantity


def measure_balance(
    sweeps: Sequence[Sweeps], noise: NoiseRates, good: NDArray[np.bool_], geometry: Geometry
) -> Balance:
    """Measure the ratio of ON to OFF thresholds and their mismatch on there-and-backs.

    Parameters
    ----------
    sweeps:
        At two speeds or more; the two slowest are extrapolated.
    good:
        (height, width), false where a pixel is hot.
    """
    if len(sweeps) < 2:
        reason = "that takes there-and-backs at two speeds"
        return Balance(Quantity.none(reason), Quantity.none(reason))
    ordered = sorted(sweeps, key=lambda one: one.speed_um_s)
    dull = _dull(ordered[0], noise, good)
    if dull is not None:
        return Balance(Quantity.none(dull), Quantity.none(dull))
    slow, fast = ordered[:2]
    counts = [one.events.counts(geometry) for one in (slow, fast)]
    lively = good & ((counts[0][0] + counts[0][1] >= ACTIVE) & (counts[1][0] + counts[1][1] >= ACTIVE))
    if int(lively.sum()) < FEWEST_PIXELS:
        reason = (
            f"{int(lively.sum())} pixels only made {ACTIVE} events or more while the lens moved (at least "
            f"{FEWEST_PIXELS}); aim at more texture, or sweep further"
        )
        return Balance(Quantity.none(reason), Quantity.none(reason))
    gap_um_s = fast.speed_um_s - slow.speed_um_s
    shares = fast.speed_um_s / gap_um_s, -slow.speed_um_s / gap_um_s
    tiles = _tiles(geometry)[good]
    influence = np.zeros(int(tiles.max()) + 1)
    ratios, slopes = [], []
    for share, (on, off), other in zip(shares, counts, reversed(counts), strict=True):
        instrument = (other[0] + other[1])[good].astype(np.float64)
        instrument -= instrument.mean()
        rises, falls = on[good].astype(np.float64), off[good].astype(np.float64)
        below = float(instrument @ rises)
        ratios.append(float(instrument @ falls) / below)
        imbalance = falls - ratios[-1] * rises
        imbalance -= imbalance.mean()
        influence += share * np.bincount(tiles, weights=instrument * imbalance, minlength=influence.size) / below
        asked = counts[0][0][good] + counts[0][1][good] >= WELL_COUNTED
        slopes.append(_spread(rises[asked], falls[asked], imbalance[asked], ratios[-1]))
    ratio = shares[0] * ratios[0] + shares[1] * ratios[1]
    bend = BEND * abs(ratios[1] - ratios[0])
    sigma = float(np.hypot(np.sqrt(np.square(influence).sum()), bend))
    return Balance(Quantity.of(ratio, sigma), _mismatch(slopes, slow.speed_um_s, fast.speed_um_s))


def _duration_s(sweep: Sweeps) -> float:
    return 1e-6 * (sweep.end_us - sweep.begin_us)


def _dull(sweep: Sweeps, noise: NoiseRates, good: NDArray[np.bool_]) -> str | None:
    """Say why a sweep shows nothing, if it does: a lens that stood still, a scene without texture."""
    duration_s = _duration_s(sweep)
    inside = int(good[sweep.events.y, sweep.events.x].sum())
    expected = noise.both_hz * duration_s * int(good.sum())
    if inside - expected > NOISE_CHANGE * expected + 6.0 * np.sqrt(expected + 1.0):
        return None
    return (
        f"nothing changed while the lens should have moved: {inside} events, noise alone makes {expected:.0f}; "
        "aim at texture, take the cap off, and check that the motor moves the lens"
    )


def _tiles(geometry: Geometry) -> NDArray[np.int64]:
    rows, columns = np.mgrid[0 : geometry.height, 0 : geometry.width] // TILE_PX
    return np.asarray(rows * (geometry.width // TILE_PX + 1) + columns, np.int64)


def _spread(
    on: NDArray[np.float64], off: NDArray[np.float64], imbalance: NDArray[np.float64], ratio: float
) -> tuple[float, float] | None:
    """Regress the squared imbalance of each pixel on its squared count; weights by the fit itself, in turns.

    Returns the slope and its error, ``None`` where pixels are few or count alike.
    """
    if on.size < FEWEST_PIXELS:
        return None
    count = 0.5 * (ratio * on + off)
    square = np.square(imbalance)
    design = np.stack([np.ones_like(count), count**2], axis=1)
    floor, slope = float(np.median(square)) + 1e-9, 0.0
    covariance = np.zeros((2, 2))
    for _ in range(20):
        weights = 1.0 / np.square(max(floor, 1e-3) + max(slope, 0.0) * count**2)
        normal = design.T @ (design * weights[:, None])
        if np.linalg.cond(normal) > 1e14:
            return None
        inverse = np.linalg.inv(normal)
        floor, slope = (float(one) for one in inverse @ (design.T @ (weights * square)))
        scores = design * (weights * (square - design @ np.array([floor, slope])))[:, None]
        covariance = inverse @ (scores.T @ scores) @ inverse
    return slope, float(np.sqrt(covariance[1, 1]))


def _mismatch(slopes: list[tuple[float, float] | None], slow: float, fast: float) -> Quantity:
    """Extrapolate to no speed, in the square of it: what deafness makes of steep and flat pixels is no mismatch."""
    if slopes[0] is None or slopes[1] is None:
        return Quantity.none(
            f"fewer than {FEWEST_PIXELS} pixels made {WELL_COUNTED} events, or all as many; "
            "sweep a scene of more contrast"
        )
    shares = fast**2 / (fast**2 - slow**2), -(slow**2) / (fast**2 - slow**2)
    slope = shares[0] * slopes[0][0] + shares[1] * slopes[1][0]
    # The pixels are the same at both speeds: their errors add up, they do not average.
    sigma = abs(shares[0]) * slopes[0][1] + abs(shares[1]) * slopes[1][1]
    if slope < 2.0 * sigma:
        bound = float(np.sqrt(0.5 * (max(slope, 0.0) + 2.0 * sigma)))
        return Quantity.none(
            f"the thresholds' spread does not stand above what pixels hold back and noise (it is below {bound:.3f}); "
            "sweep a scene of more contrast"
        )
    mismatch = float(np.sqrt(0.5 * slope))
    return Quantity.of(mismatch, sigma / (4.0 * mismatch))


# --- absolute, with frames -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Absolute:
    """Thresholds in natural log."""

    on: Quantity
    off: Quantity


def measure_absolute(
    steps: Sequence[Step],
    ratio: Quantity,
    good: NDArray[np.bool_],
    geometry: Geometry,
    black: float | None = None,
) -> Absolute:
    """Measure thresholds by comparing frames with the events between them; see the module's head.

    *black* is the frames' grey level of darkness; where nobody knows it, the error holds all that it may be.
    """
    if ratio.value is None:
        reason = "that takes the ratio of ON to OFF thresholds first: it is " + str(ratio)
        return Absolute(Quantity.none(reason), Quantity.none(reason))
    by_speed: dict[float, list[Step]] = {}
    for step in steps:
        by_speed.setdefault(step.speed_um_s, []).append(step)
    if len(by_speed) < 2:
        reason = "that takes frames of a lens at rest before and after moves at two speeds"
        return Absolute(Quantity.none(reason), Quantity.none(reason))
    slow, fast = sorted(by_speed)[:2]
    # Frames do not say where black is, only that it is no higher than their darkest pixels.
    levels = (0.0, _black_bound(steps)) if black is None else (black, black)
    top = float(max(step.before.max() for step in steps))
    found: list[tuple[float, NDArray[np.float64]]] = []
    bend = 0.0
    for level in levels:
        fits = [_fit(by_speed[v], ratio.value, good, geometry, level, top) for v in (slow, fast)]
        if fits[0] is None or fits[1] is None:
            reason = (
                f"fewer than {FEWEST_FRAME_PIXELS} pixels, neither dark nor saturated, changed by {STEEP:.0f} "
                "thresholds or more between two frames at rest; aim at more contrast"
            )
            return Absolute(Quantity.none(reason), Quantity.none(reason))
        share_slow, share_fast = fast / (fast - slow), -slow / (fast - slow)
        value = share_slow * fits[0][0] + share_fast * fits[1][0]
        found.append((value, share_slow * fits[0][1] + share_fast * fits[1][1]))
        bend = BEND * abs(fits[1][0] - fits[0][0])
    value = 0.5 * (found[0][0] + found[1][0])
    systematic = abs(found[0][0] - found[1][0]) / np.sqrt(12.0)
    sigma = float(np.hypot(np.sqrt(np.square(found[0][1]).sum()), systematic))
    sigma = float(np.hypot(sigma, bend))
    assert ratio.sigma is not None
    # The fit is of C_on with the ratio given: half of the ratio's error goes to each.
    doubt = 0.5 * ratio.sigma / ratio.value
    return Absolute(
        Quantity.of(value, float(np.hypot(sigma, doubt * value)), "ln"),
        Quantity.of(value / ratio.value, float(np.hypot(sigma, doubt * value)) / ratio.value, "ln"),
    )


def _black_bound(steps: Sequence[Step]) -> float:
    return float(min(np.percentile(step.before.mean(axis=0), 0.1) for step in steps))


def _fit(
    steps: Sequence[Step],
    ratio: float,
    good: NDArray[np.bool_],
    geometry: Geometry,
    black: float,
    top: float,
) -> tuple[float, NDArray[np.float64]] | None:
    """Return C_on and each tile's influence on it: the instrument's regression, a constant for each sign of change."""
    rows = [_row(step, ratio, good, geometry, black, top) for step in steps]
    instrument, change, count, tile = (np.concatenate(column) for column in zip(*rows, strict=True))
    threshold = _slope(instrument, change, count, np.abs(instrument) > 0.3)
    for _ in range(10):
        if threshold is None:
            return None
        steep = np.abs(instrument) > STEEP * threshold
        new = _slope(instrument, change, count, steep)
        if new is None or abs(new - threshold) < 1e-6:
            break
        threshold = new
    if threshold is None or int(steep.sum()) < FEWEST_FRAME_PIXELS:
        return None
    w, product = _centred(instrument, change - threshold * count, steep)
    _, denominator = _centred(instrument, count, steep)
    influence = np.bincount(tile[steep], weights=w * product, minlength=int(_tiles(geometry).max()) + 1) / float(
        w @ denominator
    )
    return threshold, influence


def _row(
    step: Step,
    ratio: float,
    good: NDArray[np.bool_],
    geometry: Geometry,
    black: float,
    top: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    halves = []
    for part in (slice(0, None, 2), slice(1, None, 2)):
        before, after = (stack[part].mean(axis=0, dtype=np.float64) for stack in (step.before, step.after))
        halves.append(np.log(np.maximum(after - black, 0.5)) - np.log(np.maximum(before - black, 0.5)))
    low = np.minimum(step.before.min(axis=0), step.after.min(axis=0))
    high = np.maximum(step.before.max(axis=0), step.after.max(axis=0))
    usable = good & (low > DARKEST * top) & (high < BRIGHTEST * top)
    on, off = step.events.counts(geometry)
    count = on - off / ratio
    return halves[0][usable], halves[1][usable], count[usable], _tiles(geometry)[usable]


def _centred(
    instrument: NDArray[np.float64], values: NDArray[np.float64], chosen: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return instrument and values of the chosen, each less its mean over changes of the same sign."""
    w, value = instrument[chosen], values[chosen].copy()
    centred = w.copy()
    for side in (w > 0.0, w <= 0.0):
        if side.any():
            centred[side] -= w[side].mean()
            value[side] -= value[side].mean()
    return centred, value


def _slope(
    instrument: NDArray[np.float64],
    change: NDArray[np.float64],
    count: NDArray[np.float64],
    chosen: NDArray[np.bool_],
) -> float | None:
    if int(chosen.sum()) < FEWEST_FRAME_PIXELS:
        return None
    w, y = _centred(instrument, change, chosen)
    _, n = _centred(instrument, count, chosen)
    below = float(w @ n)
    return float(w @ y) / below if below > 0.0 else None
