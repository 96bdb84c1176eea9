"""An aperture's transmittance over time, from the ON events of a still scene while it opened.

A photoreceptor answers to ``log(I·T(t) + I_d)``, and a pixel fires whenever that has risen by its threshold C since it
was released from its last event. So between a release at t and the next event at t'

    ``T(t') - e^C·T(t) = (e^C - 1)·I_d / I``,

which is linear in the unknown curve; the right side is one number for pixels of equal brightness. Thousands of pixels
with some twenty events each are one least-squares problem for the curve at a few knots. It is homogeneous: the curve
comes out up to a factor, which no map needs, and is scaled to 1 fully open.

What it refuses to pretend: within one threshold the relation says nothing (any ripple that repeats with each threshold
fulfils it), so knots are about one threshold apart and the curve between them is a power of time, as shutters and
irises are. The scale of log T is the threshold's: an error of C of 5 % stretches log T by 5 %, and is part of the error
that is told. Nothing is read off the events about the first part of a threshold but when it began: there too the curve
is a power law. A photoreceptor lags; where its time constant is known the curve is corrected, where not it is the
curve that the pixels see.

A grey card is best (all pixels alike, bright and without detail that blurs as the aperture grows), but any scene that
stands still will do. The sensor must be biased to send many ON events per pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elpd.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.calibrate.evidence import Columns
    from elpd.records import Geometry

BIN_US = 250
NOISE_SIGMA = 5.0
MOST_PIXELS = 3_000
"""Enough: what is left of the error is the threshold's."""

BLOCKS = 16
"""Parts of the pixels, each of which is left out once to see how much the curve depends on it."""

CLASSES = 6
"""Of brightness; pixels of a class share one right side."""

LEAST_EVENTS = 3.0
"""Mean ON events per pixel below which there is no curve to speak of."""

LEAST_PIXELS = 200
ROUNDS = 6
OUTLIER = 4.0
LEAST_KNOTS = 4
MOST_NOISE = 0.1
"""Of the burst's peak: with more than that before it, it is not seen to begin."""

LAST_PART = 10
"""A tenth of the record, at its end, shows what comes once everything is open."""

LEAST = 1e-6
LAG_DOUBT = 0.25
"""Relative error of a lag's correction: a photoreceptor is of first order only in the first place."""

NEARLY_SETTLED, SETTLED = 0.99, 0.998
"""The opening is over when so much of all its events has come."""


@dataclass(frozen=True, slots=True)
class Pixels:
    """What the threshold and its fellows are taken to be: natural log, us; each with one standard error.

    ``lag_us`` is the photoreceptors' time constant behind the fully open aperture, ``None`` where nobody knows.
    """

    threshold: float
    threshold_sigma: float = 0.0
    refractory_us: float = 0.0
    lag_us: float | None = None
    lag_sigma_us: float = 0.0


@dataclass(frozen=True)
class OpeningCurve:
    """A measured opening.

    ``since_us`` counts from ``begin_us`` (sensor time), the instant at which light began to come; ``transmittance``
    is 0 there and 1 fully open. ``begin_sigma_us`` and ``opening_sigma_us`` are standard errors of the beginning and of
    the whole time. ``sigma`` is one relative standard error from row to row, ``scale_sigma`` that of the slope of
    log T, which all rows share. ``exponent`` is that of the power law of the beginning, ``events`` and ``pixels`` what
    was used.
    """

    begin_us: float
    begin_sigma_us: float
    opening_sigma_us: float
    since_us: NDArray[np.float64]
    transmittance: NDArray[np.float64]
    sigma: NDArray[np.float64]
    scale_sigma: float
    exponent: float
    events: int
    pixels: int

    @property
    def opening_us(self) -> float:
        """How long it took, from the first light to the last change."""
        return float(self.since_us[-1])


def measure_opening(events: Columns, geometry: Geometry, begin_us: int, end_us: int, pixels: Pixels) -> OpeningCurve:
    """Measure one opening between two sensor times, which must enclose it with some darkness before.

    Raises ``UsageError`` where there is no opening, too few events per pixel, or too few pixels.
    """
    if not 0.01 <= pixels.threshold <= 1.0:
        raise UsageError(f"a contrast threshold of {pixels.threshold:g} (natural log); they lie in 0.01 to 1")
    rising = events.between(begin_us, end_us)
    t_us, pixel = _of_good_pixels(rising, geometry)
    times = _find_times(t_us, begin_us, end_us, np.unique(pixel).size, phase=0.0)
    chains = _chains(t_us, pixel, times, pixels.refractory_us)
    curve, others = _fit(chains, times, pixels.threshold)
    spread = np.log(np.maximum([one.values for one in others], LEAST)) - np.log(curve.values)
    variance = (BLOCKS - 1) / BLOCKS * np.square(spread).sum(axis=0)
    shifted, _ = _fit(chains, _find_times(t_us, begin_us, end_us, np.unique(pixel).size, phase=0.5), pixels.threshold)
    apart = np.log(np.maximum(shifted.at(curve.knots_us), LEAST)) - np.log(curve.values)
    variance = variance + np.square(apart - np.median(apart))
    values = curve.values
    if pixels.lag_us:
        values = _without_lag(curve, pixels.lag_us)
        moved = np.log(values) - np.log(curve.values)
        doubt = np.hypot(LAG_DOUBT, pixels.lag_sigma_us / pixels.lag_us)
        variance = variance + np.square(doubt * (moved - np.median(moved)))
    begins = np.array([one.begin_us for one in others])
    begin_variance = (BLOCKS - 1) / BLOCKS * float(np.square(begins - curve.begin_us).sum())
    begin_variance += (shifted.begin_us - curve.begin_us) ** 2 + BIN_US**2 / 12
    # lag steepens the power law, which then dates the first light too early: half the exponent is one standard error
    other_us = _first_light(chains.first_us, times, curve.exponent / 2, curve.begin_us)
    begin_variance += (other_us - curve.begin_us) ** 2
    since, transmittance, sigma = _table(curve, values, np.sqrt(variance))
    return OpeningCurve(
        begin_us=curve.begin_us,
        begin_sigma_us=float(np.sqrt(begin_variance)),
        opening_sigma_us=float(np.sqrt(begin_variance + times.end_sigma_us**2)),
        since_us=since,
        transmittance=transmittance,
        sigma=sigma,
        scale_sigma=pixels.threshold_sigma / pixels.threshold,
        exponent=curve.exponent,
        events=int(chains.later_us.size),
        pixels=int(np.unique(chains.pixel).size),
    )


# --- which events ------------------------------------------------------------------------------------------------


def _of_good_pixels(rising: Columns, geometry: Geometry) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return ON times and pixels, by pixel and time, of pixels that did as most did."""
    count = geometry.width * geometry.height
    place = rising.y.astype(np.int64) * geometry.width + rising.x
    on = np.asarray(rising.on, np.bool_)
    per_pixel = np.bincount(place[on], minlength=count)
    falls = np.bincount(place[~on], minlength=count)
    fired = per_pixel > 0
    if fired.sum() < LEAST_PIXELS:
        raise UsageError(
            f"{int(fired.sum())} pixels saw it brighten (at least {LEAST_PIXELS} are needed); does the aperture open, "
            "is the lens cap off, is the interval the right one?"
        )
    typical = float(np.median(per_pixel[fired]))
    if typical < LEAST_EVENTS:
        raise UsageError(
            f"{typical:.0f} ON events per pixel while it opened (at least {LEAST_EVENTS:.0f} are needed): the sensor's "
            "biases allow only a first event, or there is too little light; use the biases for focusing, and more light"
        )
    good = (per_pixel >= LEAST_EVENTS) & (per_pixel <= typical + 8 * np.sqrt(typical)) & (falls <= 0.2 * per_pixel)
    usable = np.flatnonzero(good)
    if usable.size < LEAST_PIXELS:
        raise UsageError(
            f"{usable.size} pixels only grew brighter and sent {LEAST_EVENTS:.0f} ON events or more (at least "
            f"{LEAST_PIXELS} are needed); keep scene, light and lens still, and use more light"
        )
    if usable.size > MOST_PIXELS:
        usable = usable[:: usable.size // MOST_PIXELS + 1]
    wanted = np.zeros(count, np.bool_)
    wanted[usable] = True
    keep = on & wanted[place]
    t_us, pixel = rising.t_us[keep].astype(np.float64) + 0.5, place[keep]
    order = np.lexsort((t_us, pixel))
    return t_us[order], pixel[order]


@dataclass(frozen=True, slots=True)
class _Times:
    """When it began (to a bin), the knots after that, the last of which is its end; all in sensor time."""

    begin_us: float
    knots_us: NDArray[np.float64]
    end_sigma_us: float


def _find_times(t_us: NDArray[np.float64], begin_us: int, end_us: int, pixels: int, *, phase: float) -> _Times:
    """Find the burst of ON events, and cut it where another event per pixel has come (*phase*: or between)."""
    edges = np.arange(begin_us, end_us + BIN_US, BIN_US, dtype=np.float64)
    counts = np.histogram(t_us, edges)[0].astype(np.float64)
    total = np.cumsum(counts)
    tenth = int(np.searchsorted(total, 0.1 * total[-1]))
    before = counts[:tenth]
    noise = float(np.median(before)) if before.size else 0.0
    loud = counts > noise + NOISE_SIGMA * np.sqrt(noise + 1.0)
    start = tenth
    while start > 0 and loud[start - 1]:
        start -= 1
    if start == 0 or noise > MOST_NOISE * counts.max():
        raise UsageError(
            f"ON events come from the interval's very beginning ({begin_us} us): it must hold some darkness before the "
            "opening; begin earlier"
        )
    clear = total - total[start - 1] - _noise_in_light(counts, noise) * np.arange(1 - start, counts.size - start + 1)
    clear = np.maximum.accumulate(np.maximum(clear, 0.0))
    ends = edges[1:]
    final = float(np.interp(SETTLED * clear[-1], clear, ends))
    mean = clear / pixels
    whole = np.arange(1.0 + phase, mean[-1])
    knots = np.array([ends[min(int(np.searchsorted(mean, level)), ends.size - 1)] for level in whole])
    knots = np.unique(np.append(knots[knots < final - BIN_US], final))
    if knots.size < LEAST_KNOTS:
        raise UsageError(
            f"{mean[-1]:.1f} ON events per pixel from {edges[start]:.0f} us on (limit {LEAST_KNOTS}): too "
            "little light, or biases that allow only a first event"
        )
    nearly = float(np.interp(NEARLY_SETTLED * clear[-1], clear, ends))
    return _Times(float(edges[start]), knots, 0.5 * (final - nearly))


def _noise_in_light(counts: NDArray[np.float64], noise: float) -> float:
    """Return the events per bin that come behind the open aperture, *noise* being those in the dark.

    Pixels in the light leak and fire by themselves. After a slow opening they do so for as long as it took, and would
    pass for its end. A record that ends while the aperture opens tells nothing of that.
    """
    after = float(counts[-max(1, counts.size // LAST_PART) :].mean())
    return noise if after > MOST_NOISE * counts.max() else max(noise, after)


@dataclass(frozen=True, slots=True)
class _Chains:
    """Steps of one threshold: released at ``earlier_us``, fired at ``later_us``; and when each pixel fired first."""

    earlier_us: NDArray[np.float64]
    later_us: NDArray[np.float64]
    pixel: NDArray[np.int64]
    brightness: NDArray[np.int64]
    first_us: NDArray[np.float64]
    first_pixel: NDArray[np.int64]


def _chains(t_us: NDArray[np.float64], pixel: NDArray[np.int64], times: _Times, refractory_us: float) -> _Chains:
    late = t_us >= times.begin_us
    t_us, pixel = t_us[late], pixel[late]
    starts = np.flatnonzero(np.diff(pixel, prepend=-1))
    lengths = np.diff(np.append(starts, pixel.size))
    # brighter pixels reach the same level earlier: when was each half way up?
    half = max(1, int(np.median(lengths)) // 2)
    reached = np.where(lengths > half, t_us[np.minimum(starts + half, t_us.size - 1)], np.inf)
    bounds = np.quantile(reached[np.isfinite(reached)], np.arange(1, CLASSES) / CLASSES)
    of_pixel = np.searchsorted(bounds, reached)
    follows = pixel[1:] == pixel[:-1]
    brightness = np.repeat(of_pixel, lengths)
    return _Chains(
        t_us[:-1][follows] + refractory_us,
        t_us[1:][follows],
        pixel[1:][follows],
        brightness[1:][follows],
        t_us[starts],
        pixel[starts],
    )


# --- the curve ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Curve:
    begin_us: float
    knots_us: NDArray[np.float64]
    values: NDArray[np.float64]
    exponent: float
    dark: float
    """The dark current in units of the photocurrent behind the open aperture, mean over pixels."""

    def weights(self, t_us: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the knot after each time, and its weight; the knot before it has the rest, and before 0 there is 0."""
        grown = np.maximum(np.append(self.begin_us, self.knots_us) - self.begin_us, 0.0) ** self.exponent
        x = np.clip(t_us - self.begin_us, 0.0, self.knots_us[-1] - self.begin_us) ** self.exponent
        after = np.clip(np.searchsorted(grown, x), 1, grown.size - 1)
        return after - 1, (x - grown[after - 1]) / (grown[after] - grown[after - 1])

    def at(self, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the transmittance."""
        knot, weight = self.weights(t_us)
        padded = np.append(0.0, self.values)
        return np.asarray((1 - weight) * padded[knot] + weight * padded[knot + 1])


def _fit(chains: _Chains, times: _Times, threshold: float) -> tuple[_Curve, list[_Curve]]:
    """Solve for the curve at the knots; also with each block of pixels left out."""
    seen = chains.earlier_us < chains.later_us  # deafness that is too long by its error would turn time round
    earlier, later, kind = chains.earlier_us[seen], chains.later_us[seen], chains.brightness[seen]
    block, first_block = chains.pixel[seen] % BLOCKS, chains.first_pixel % BLOCKS
    of_block = [np.flatnonzero(block == one) for one in range(BLOCKS)]
    rows, n = np.arange(earlier.size), times.knots_us.size
    free = np.delete(np.arange(n + CLASSES), n - 1)  # fully open is 1
    guess = ((times.knots_us - times.begin_us) / (times.knots_us[-1] - times.begin_us)) ** 2.0
    curve = _Curve(times.begin_us, times.knots_us, guess, 2.0, 0.05)
    step = float(np.exp(threshold))
    dark_of, trust = np.full(CLASSES, 0.05), np.ones(earlier.size)
    for _ in range(ROUNDS):
        matrix = np.zeros((earlier.size, n + 1 + CLASSES))
        for when, factor in ((later, 1.0), (earlier, -step)):
            knot, weight = curve.weights(when)
            matrix[rows, knot] += factor * (1 - weight)
            matrix[rows, knot + 1] += factor * weight
        matrix[rows, n + 1 + kind] = 1.0 - step
        matrix = matrix[:, 1:]  # closed, nothing passes
        matrix *= (np.sqrt(trust) / (curve.at(later) + dark_of[kind]))[:, None]
        parts = np.array([matrix[of].T @ matrix[of] for of in of_block])
        whole = parts.sum(axis=0)
        values, dark_of, answer = _solve(whole, free, n)
        left = np.abs(matrix[:, free] @ answer + matrix[:, n - 1]) / np.sqrt(trust)
        spread = 1.4826 * float(np.median(left))
        trust = np.minimum(1.0, OUTLIER * spread / np.maximum(left, LEAST * spread))
        before = curve
        curve = _grown(chains.first_us, times, values, dark_of, before)
    others = []
    for one, part in enumerate(parts):
        values, darks, _ = _solve(whole - part, free, n)
        others.append(_grown(chains.first_us[first_block != one], times, values, darks, before))
    return curve, others


def _solve(
    normal: NDArray[np.float64], free: NDArray[np.int64], n: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the curve at the knots, the dark current of each class of brightness, and both as they were solved."""
    answer = np.linalg.lstsq(normal[np.ix_(free, free)], -normal[free, n - 1], rcond=None)[0]
    values = np.maximum.accumulate(np.maximum(np.append(answer[: n - 1], 1.0), LEAST))
    return values / values[-1], np.maximum(answer[n - 1 :], LEAST), answer


def _grown(
    first_us: NDArray[np.float64],
    times: _Times,
    values: NDArray[np.float64],
    dark_of: NDArray[np.float64],
    before: _Curve,
) -> _Curve:
    exponent, begin_us = _beginning(first_us, times, values, before)
    return _Curve(begin_us, times.knots_us, values, exponent, float(dark_of.mean()))


def _beginning(
    first_us: NDArray[np.float64], times: _Times, values: NDArray[np.float64], before: _Curve
) -> tuple[float, float]:
    """Return the power law of the beginning and when it began: the share of pixels that fired grows as the light."""
    lead = min(4, values.size)
    grown = np.log(times.knots_us[:lead] - before.begin_us)
    exponent = float(np.clip(np.polyfit(grown, np.log(values[:lead]), 1)[0], 0.5, 6.0))
    return exponent, _first_light(first_us, times, exponent, before.begin_us)


def _first_light(first_us: NDArray[np.float64], times: _Times, exponent: float, otherwise_us: float) -> float:
    """Return when the share of pixels that fired, which grows as light to the power *exponent*, was zero."""
    fired = np.sort(first_us)
    share = np.arange(1, fired.size + 1) / fired.size
    early = (share > 0.02) & (share < 0.3)
    if early.sum() < 10:
        return otherwise_us
    slope, offset = np.polyfit(fired[early] - times.begin_us, share[early] ** (1 / exponent), 1)
    begin = times.begin_us - offset / slope if slope > 0 else otherwise_us
    return float(np.clip(begin, times.begin_us - 4 * BIN_US, float(fired[early][0])))


def _without_lag(curve: _Curve, lag_us: float) -> NDArray[np.float64]:
    """Return the light at the knots, from what photoreceptors of bandwidth proportional to photocurrent made of it.

    ``L - V = tau(L)·dV/dt`` with V the level that fired and ``tau = lag_us`` behind the open aperture.
    """
    level = curve.values + curve.dark
    slope = (curve.at(curve.knots_us + BIN_US / 2) - curve.at(curve.knots_us - BIN_US / 2)) / BIN_US
    pull = slope / level * lag_us * (1.0 + curve.dark)
    light = level.copy()
    for _ in range(60):
        light = 0.5 * light + 0.5 * level * np.exp(pull / light)
    found = np.maximum.accumulate(np.maximum(light - curve.dark, 1e-9))
    return np.asarray(found / found[-1])


def _table(
    curve: _Curve, values: NDArray[np.float64], sigma: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return rows from the first light to the last change; a few more where the power law stands for the curve."""
    since = curve.knots_us - curve.begin_us
    fractions = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8])
    early = values[0] * fractions**curve.exponent
    return (
        np.concatenate([since[0] * fractions, since]),
        np.concatenate([early, values]),
        np.concatenate([np.full(fractions.size, sigma[0]), sigma]),
    )
