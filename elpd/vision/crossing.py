"""Several witnesses, one focus position, one standard error.

Mirror pairs, the vertex of the events' own image and the vertex of frames each say where focus was. They fail for
different reasons: pairs under scene motion, the events' vertex by pixels that have not answered yet, frames by
exposure. So they are fused by their standard errors, which hold, beside scatter, what is known to be systematic.
(The zero crossing of ELP is no witness: it is late by the sensor's hysteresis, differently in every scene.) Widths and
errors are in units of the curve's own width (``Vertex.width``), a fifth of which is a depth of focus, so that nothing
here depends on scene, optics or speed. Witnesses that disagree beyond their errors widen the answer's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.records import FocusEstimate
from elpd.vision.depths import find_depths, shares_of_planes
from elpd.vision.integral import (
    BANDS_PX,
    MISMATCH,
    Vertex,
    band_energy,
    band_gain,
    fit_vertex,
    group_by_pixel,
    rebuild_levels,
)
from elpd.vision.pairs import Mode, find_pairs, weighted_mode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.vision.pairs import Pairs

WIDTHS_PER_DEPTH_OF_FOCUS = 5.0
"""Width of the log S parabola over the depth of focus, for a ray-traced F/2 lens and for Gaussian blur."""

SYSTEMATIC_FRAMES = 0.012
SYSTEMATIC_VERTEX = 0.08
SYSTEMATIC_PAIRS = 0.025
"""Standard deviations of what scatter does not show, in widths of the curve (static sweeps, two thresholds)."""

SYSTEMATIC_UNDER_A_LAMP = 0.09
"""The same for the curve of whole lamp periods, which is not rebuilt: late by 0.03 widths on the average."""

VERTEX_IN_MOTION = 0.12
"""What scene motion adds to the vertex' error, where it strays all pairs."""

LAG_UNEXPLAINED = 0.5
"""How much of the lag that was corrected may be wrong: the picture that told bright from dark was blurred itself."""

ASTRAY = 0.3
"""Share of stray pairs at which nothing that was measured on pairs is believed any more."""

UNMEASURED_LAG_US = 1_500.0
"""What a photoreceptor's lag may be when nothing tells: tens of microseconds in sunlight, milliseconds in the dark."""

COARSE_FRAMES = 0.25
"""Frames further apart than this many widths draw the parabola's flanks, not its top; their error grows with it."""

PERIOD_ERROR = 0.15
"""How far from the middle of a lamp's period its net events may lie in the mean, in periods."""

UNANSWERED = 0.23
"""The last part of a record, in widths, whose pixels have turned but not yet answered."""

TICKS = 64
FEWEST_TICKS = 24
LEVELS_AT_ONCE = 3 << 18
"""Pixels times ticks of a rebuilt curve: of a large region fewer ticks are rebuilt, because a lens waits for them."""

STILL_SHARE = 0.9
SAMPLE_PX = 1 << 15
"""Where so many pairs agree, the scene is still and the pairs, ten times better known, have the say: the vertex then
only has to confirm them, and so many pixels are enough for that."""

FLANK = 0.6
ROI_MARGIN_PX = 14

PLANE_KERNEL = 0.1
"""Standard deviation, in widths, of the kernel that finds the mode of one plane's pairs among several planes."""

PLANES_AGREE = 0.5
"""How far from its pairs the sharpest place of a plane's own part of the picture may be, in shares of the least gap
of planes: edges that move make clusters of pairs, but sharpen nothing."""

NARROWEST = 0.4
"""Width of a vertex over that of the hill it stands on, below which it is a ripple."""

DARK = 0.04
"""Dark current, relative to the brightest parts: below it a photoreceptor gets no slower (ten of 255 grey levels)."""

_STATIC_SHARE = 0.97
_MIN_PAIRS = 30


@dataclass(frozen=True, slots=True)
class Witness:
    """One estimator's answer, on the caller's ruler.

    ``sigma`` is its own standard error; ``shared`` one that all witnesses of its kind have in common, with one sign:
    what is not known of the photoreceptors' lag makes every event late.
    """

    name: str
    at: float
    sigma: float
    shared: float = 0.0

    @property
    def total_sigma(self) -> float:
        """Both errors together."""
        return float(np.hypot(self.sigma, self.shared))


@dataclass(frozen=True, slots=True)
class EventStretch:
    """Events of a region and its margin, in coordinates of that cut-out, with rising lens positions.

    ``base``, (height, width), is the image in thresholds that earlier events had built; ``None`` for nothing.
    """

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]
    position: NDArray[np.float64]
    height: int
    width: int
    margin: int
    base: NDArray[np.float32] | None = None


Groups = tuple["NDArray[np.int64]", "NDArray[np.int64]"]
"""Events by pixel: ``integral.group_by_pixel``."""


@dataclass(frozen=True, slots=True)
class Lag:
    """How far the lens went while the brightest photoreceptors answered, and one standard error.

    A pixel ``s`` times slower than the brightest is late by ``s`` times this.
    ``typical`` is the mean slowness of the pixels that had a say.
    """

    at: float = 0.0
    sigma: float = 0.0
    typical: float = 0.0


@dataclass(frozen=True, slots=True)
class EventWitnesses:
    """What the events say: the vertex of their image's log S, the mode of their mirror pairs."""

    vertex: Vertex | None
    pairs: Mode | None
    lag: Lag
    depths: tuple[float, ...] = ()
    """Where planes of the region are in focus, nearest first along the sweep, if there are several. Then ``pairs`` are
    those of the first, and there is no vertex: sharpness shows none of them."""
    plane_width: float = 0.0
    """Width of one plane's curve, as far as its rising flank tells, where there are several."""

    def witnesses(
        self, unmeasured_lag: float = 0.0, unexplained: float = LAG_UNEXPLAINED, width: float | None = None
    ) -> list[Witness]:
        """Return those that are to be believed, with systematic errors included.

        *unmeasured_lag* is what a photoreceptor's lag may amount to where it could not be measured, *unexplained* the
        share of a measured one that may be wrong. *width* is the curve's own, where it is known beforehand; without
        it, pairs are believed only beside a vertex.
        """
        found: list[Witness] = []
        if self.vertex is None and width is None:
            return found
        width = width if width is not None or self.vertex is None else self.vertex.width
        assert width is not None
        shared = unmeasured_lag
        if self.lag.sigma > 0.0:
            shared = self.lag.typical * float(np.hypot(unexplained * self.lag.at, self.lag.sigma))
        # In a still scene nearly all pairs agree. What disagrees measures how much of the rest is not focus.
        stray = max(0.0, _STATIC_SHARE - self.pairs.share) if self.pairs is not None else 1.0
        # The lag was measured on the pairs: as far as they are astray, it was not.
        shared = float(np.hypot(shared, min(1.0, stray / ASTRAY) * unmeasured_lag))
        if self.vertex is not None:
            sigma = float(np.hypot(self.vertex.sigma, (SYSTEMATIC_VERTEX + VERTEX_IN_MOTION * stray) * width))
            found.append(Witness("vertex", self.vertex.at, sigma, shared))
        if self.pairs is not None and self.pairs.count >= _MIN_PAIRS:
            sigma = float(np.hypot(self.pairs.sigma, (SYSTEMATIC_PAIRS + stray) * width))
            found.append(Witness("pairs", self.pairs.at, sigma, shared))
        return found


def ask_events(
    events: EventStretch, begin: float, peak: float, end: float, brightness: NDArray[np.float32] | None = None
) -> EventWitnesses:
    """Rebuild the image over positions *begin* .. *end* and find the vertex near *peak*, and the mirror pairs.

    *brightness*, (height, width) of the cut-out, relative to the brightest parts, tells how slow each pixel's
    photoreceptor is; with it, the pairs themselves measure the lag, and both witnesses are freed of it.
    """
    weight, slowness = _by_brightness(brightness, events)
    groups = _by_pixel(events)
    at_peak, _ = _rebuilt(events, groups, np.array([peak]))
    found = find_pairs(events.t_us, events.x, events.y, events.on, events.position, (events.height, events.width))
    pairs, lag = _pair_mode(found, at_peak[0], peak, end, slowness)
    planes = _planes(found, events, at_peak[0], (begin, peak, end), lag.at * slowness)
    if planes:
        return EventWitnesses(None, planes[0], lag, tuple(plane.at for plane in planes), _flank_width(begin, peak))
    if pairs is not None and pairs.share > STILL_SHARE and events.height * events.width > SAMPLE_PX:
        rows = _busiest_rows(events)
        events, weight, slowness = _rows_of(events, rows), weight[rows], slowness[rows]
        groups = _by_pixel(events)
    pixels = max(1, events.height * events.width)
    ticks = np.linspace(begin, end, int(np.clip(LEVELS_AT_ONCE // pixels, FEWEST_TICKS, TICKS)))
    vertex = None
    if lag.at > 0.0:
        quick = replace(events, position=events.position - lag.at * slowness[events.y, events.x])
        vertex = _vertex(quick, groups, ticks, weight, peak)
    if vertex is None:
        vertex = _vertex(events, groups, ticks, weight, peak)
    return EventWitnesses(vertex, pairs, lag)


def _by_pixel(events: EventStretch) -> Groups:
    return group_by_pixel(events.y.astype(np.int64) * events.width + events.x, max(1, events.height * events.width))


def _busiest_rows(events: EventStretch) -> slice:
    """Return a stretch of rows of at most ``SAMPLE_PX`` pixels, that with the most events."""
    count = min(events.height, max(SAMPLE_PX // events.width, 4 * events.margin))
    below = np.concatenate([[0], np.cumsum(np.bincount(events.y, minlength=events.height))])
    first = int(np.argmax(below[count:] - below[:-count]))
    return slice(first, first + count)


def _rows_of(events: EventStretch, rows: slice) -> EventStretch:
    inside = (events.y >= rows.start) & (events.y < rows.stop)
    return EventStretch(
        events.t_us[inside],
        events.x[inside],
        (events.y[inside] - rows.start).astype(np.uint16),
        events.on[inside],
        events.position[inside],
        rows.stop - rows.start,
        events.width,
        events.margin,
        None if events.base is None else events.base[rows],
    )


def _by_brightness(
    brightness: NDArray[np.float32] | None, events: EventStretch
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return each pixel's say in S, and its slowness: how many times slower than the brightest its receptor is."""
    if brightness is None:
        shape = (events.height, events.width)
        return np.ones(shape, dtype=np.float32), np.zeros(shape)
    smooth = cv2.GaussianBlur(brightness, (0, 0), 4.0) + np.float32(DARK)
    weight = np.asarray(smooth / np.float32(smooth.mean()), dtype=np.float32)
    return weight, (1.0 + DARK) / (np.maximum(brightness, 0.0).astype(np.float64) + DARK)


def _vertex(
    events: EventStretch, groups: Groups, ticks: NDArray[np.float64], weight: NDArray[np.float32], peak: float
) -> Vertex | None:
    curve = _rebuilt_curve(events, groups, ticks, weight)
    end = float(ticks[-1])
    wide = fit_vertex(ticks, curve, end - float(ticks[0]))
    vertex = None
    if wide is not None:
        use = ticks <= end - UNANSWERED * wide.width
        if int(use.sum()) >= 5:
            vertex = fit_vertex(ticks[use], curve[use], 0.7 * wide.width)
    if vertex is not None and vertex.at > end - (UNANSWERED + 0.2) * vertex.width:
        vertex = None
    # The flank that led up to the peak is as wide as the curve; a dent in it is not the curve.
    if vertex is not None and vertex.width < NARROWEST * (peak - float(ticks[0])) / float(np.sqrt(2.0 * FLANK)):
        vertex = None
    return vertex


def frame_witness(vertex: Vertex, spacing: float) -> Witness:
    """Return what frames say, taken every *spacing* along the sweep."""
    coarseness = max(1.0, spacing / (COARSE_FRAMES * vertex.width))
    return Witness("frames", vertex.at, float(np.hypot(vertex.sigma, SYSTEMATIC_FRAMES * coarseness * vertex.width)))


def lamp_witness(vertex: Vertex, width: float, spacing: float) -> Witness:
    """Return what the curve of whole lamp periods says, one point every *spacing*, dated to the periods' middle.

    A lamp that is seen at all dithers the comparators: there is no dead zone to correct for.
    """
    sigma = float(np.hypot(vertex.sigma, SYSTEMATIC_UNDER_A_LAMP * width))
    return Witness("vertex", vertex.at, sigma, PERIOD_ERROR * spacing)


def fuse(witnesses: Sequence[Witness]) -> FocusEstimate | None:
    """Return the least-squares mean under the witnesses' joint covariance.

    Its error grows where they disagree beyond theirs (Birge's ratio).
    """
    if not witnesses:
        return None
    at = np.array([one.at for one in witnesses])
    shared = np.array([one.shared for one in witnesses])
    covariance = np.diag([one.sigma**2 for one in witnesses]) + np.outer(shared, shared)
    precision = np.linalg.inv(covariance)
    share = precision.sum(axis=0) / precision.sum()
    focus = float(share @ at)
    sigma = float(1.0 / np.sqrt(precision.sum()))
    if at.size > 1:
        chi_square = float((at - focus) @ precision @ (at - focus)) / (at.size - 1)
        sigma *= float(np.sqrt(max(1.0, chi_square)))
    main = witnesses[int(np.argmax(share))].name
    contributions = tuple(
        (one.name, one.at, one.total_sigma, float(part)) for one, part in zip(witnesses, share, strict=True)
    )
    return FocusEstimate(focus, sigma, "pairs" if main == "pairs" else "crossing", contributions)


def _rebuilt_curve(
    events: EventStretch, groups: Groups, ticks: NDArray[np.float64], weight: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return log S of the rebuilt image at each tick, the mean of the bands."""
    images, mismatch = _rebuilt(events, groups, ticks)
    curve = np.zeros(ticks.size)
    for band in BANDS_PX:
        energy = np.array([band_energy(image, band, weight, events.margin) for image in images])
        energy = np.maximum(energy - band_gain(band) * mismatch, 1e-3 * energy)
        curve += np.log(energy + 1e-12) / len(BANDS_PX)
    return curve


def _rebuilt(
    events: EventStretch, groups: Groups, ticks: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the image at each tick, in thresholds, and the variance that unequal thresholds add to it."""
    pixels = events.height * events.width
    level = np.empty((ticks.size, pixels), dtype=np.float32)
    squares = np.zeros((ticks.size, 2))
    starts, order = groups
    rebuild_levels(starts, events.position[order], events.on[order], ticks, level, squares)
    images = level.reshape(ticks.size, events.height, events.width)
    if events.base is not None:
        images += events.base
    return images, MISMATCH**2 * squares.sum(axis=1) / pixels


def _pair_mode(
    pairs: Pairs, level: NDArray[np.float32], peak: float, end: float, slowness: NDArray[np.float64]
) -> tuple[Mode | None, Lag]:
    if pairs.on.size == 0:
        return None, Lag()
    curvature = cv2.Laplacian(cv2.GaussianBlur(level, (0, 0), 1.0), cv2.CV_32F)[pairs.y, pairs.x].astype(np.float64)
    sign = 2.0 * pairs.on - 1.0
    past = end - peak
    believed = (sign * curvature > 0.0) & (pairs.after >= peak - 0.5 * past)
    gap = np.maximum(pairs.after - pairs.before, 1e-3 * past)
    weights = (np.abs(curvature) / gap)[believed]
    middle = pairs.middle[believed]
    mode = weighted_mode(middle, weights, 0.15 * past)
    if mode is None or not slowness.any():
        return mode, Lag()
    return without_lag(middle, weights, slowness[pairs.y, pairs.x][believed], mode, 0.15 * past)


def _flank_width(begin: float, peak: float) -> float:
    """Return the width of a curve that rose by ``FLANK`` from *begin* to *peak*."""
    return (peak - begin) / float(np.sqrt(2.0 * FLANK))


def _planes(
    pairs: Pairs,
    events: EventStretch,
    level: NDArray[np.float32],
    stretch: tuple[float, float, float],
    late: NDArray[np.float64],
) -> list[Mode]:
    """Return where planes of the region are in focus, if there are several.

    *stretch* is where the curve's rising flank, its peak and the record's end lie, *late* each pixel's lag. The planes'
    own parts of the picture must be sharpest where their pairs say.
    """
    begin, peak, end = stretch
    width = _flank_width(begin, peak)
    curvature = cv2.Laplacian(cv2.GaussianBlur(level, (0, 0), 1.0), cv2.CV_32F)[pairs.y, pairs.x].astype(np.float64)
    middle = pairs.middle - late[pairs.y, pairs.x]
    believed = ((2.0 * pairs.on - 1.0) * curvature > 0.0) & (middle >= begin - width)
    weights = (np.abs(curvature) / np.maximum(pairs.after - pairs.before, 1e-3 * width))[believed]
    middle = middle[believed]
    clusters = find_depths(middle, weights, pairs.x[believed], pairs.y[believed], width)
    held = sum(float(weights[one].sum()) for one in clusters) / max(float(weights.sum()), 1e-300)
    modes = [weighted_mode(middle[one], weights[one], PLANE_KERNEL * width) for one in clusters]
    known = [replace(mode, share=held) for mode in modes if mode is not None and mode.count >= _MIN_PAIRS]
    if len(known) < 2 or len(known) < len(modes):
        return []
    shares = shares_of_planes(clusters, pairs.x[believed], pairs.y[believed], level.shape)
    ticks, groups = np.linspace(begin - width, end, TICKS), _by_pixel(events)
    tops = [float(ticks[int(np.argmax(_rebuilt_curve(events, groups, ticks, share)))]) for share in shares]
    places = np.array([mode.at for mode in known])
    allowed = PLANES_AGREE * float(np.diff(places).min())
    # Each part must be sharpest where its pairs say, and the parts as far apart as the pairs.
    astray = np.concatenate([np.abs(tops - places), np.abs(np.diff(tops) - np.diff(places))])
    return known if bool((astray <= allowed).all()) else []


def without_lag(
    middle: NDArray[np.float64],
    weights: NDArray[np.float64],
    slowness: NDArray[np.float64],
    mode: Mode,
    width: float,
) -> tuple[Mode, Lag]:
    """Fit ``middle = focus + lag·slowness`` robustly (Tukey's biweight around the mode); the lag is not negative.

    A lag that is not significant is shrunk by its own error, so that a scene without bright and dark pixels keeps its
    mode and gains nothing but an honest error.
    """
    focus, lag = mode.at, 0.0
    design = np.stack([np.ones_like(slowness), slowness], axis=1)
    covariance = np.zeros((2, 2))
    for _ in range(25):
        residual = middle - focus - lag * slowness
        biweight = weights * np.square(np.maximum(0.0, 1.0 - np.square(residual / (3.0 * width))))
        normal = design.T @ (design * biweight[:, None])
        if biweight.sum() <= 0.0 or np.linalg.cond(normal) > 1e12:
            return mode, Lag()
        inverse = np.linalg.inv(normal)
        before = focus, lag
        focus, lag = (float(one) for one in inverse @ (design.T @ (biweight * middle)))
        residual = middle - focus - lag * slowness
        scores = design * (biweight * residual)[:, None]
        covariance = inverse @ (scores.T @ scores) @ inverse
        if abs(focus - before[0]) + abs(lag - before[1]) < 1e-6 * width:
            break
    sigma_lag = float(np.sqrt(covariance[1, 1]))
    typical = float(np.average(slowness, weights=biweight))
    kept = lag**2 / (lag**2 + sigma_lag**2) if lag > 0.0 else 0.0
    centre = focus + lag * typical
    answer = centre - kept * lag * typical
    sigma = float(np.hypot(np.sqrt(max(covariance[0, 0], 0.0)), (1.0 - kept) * max(lag, 0.0) * typical))
    return Mode(answer, sigma, mode.count, mode.share), Lag(kept * lag, sigma_lag, typical)
