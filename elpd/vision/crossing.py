"""Several witnesses, one focus position, one standard error.

Mirror pairs, the vertex of the events' own image and the vertex of frames each say where focus was. They fail for
different reasons: pairs under scene motion, the events' vertex by pixels that have not answered yet, frames by
exposure. So they are fused by their standard errors, which hold, beside scatter, what is known to be systematic.
(The zero crossing of ELP is no witness: it is late by the sensor's hysteresis, differently in every scene.) Widths and
errors are in units of the curve's own width (``Vertex.width``), a fifth of which is a depth of focus, so that nothing
here depends on scene, optics or speed. Witnesses that disagree beyond their errors widen the answer's.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import cycle
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.records import FocusEstimate
from elpd.vision.bands import BandFocus, average_focus, band_products, focus_of_bands, freed_of_noise
from elpd.vision.drift import LOOKS, Drift, find_drift
from elpd.vision.integral import BANDS_PX, Vertex, band_gain, band_image, fit_vertex, inside_margin
from elpd.vision.lag import Lag, average_lag, expected_lag, weights_of_lines
from elpd.vision.light import in_focus, worth_of_an_event
from elpd.vision.pairs import Mode, Pairs, find_pairs, weighted_mode
from elpd.vision.planes import FLANK, MIN_PAIRS, find_planes, flank_width
from elpd.vision.rebuilt import EventStretch, busiest_rows, by_pixel, hush, rebuilt, rows_of
from elpd.vision.turns import Slowness, Turns, blocks_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.vision.lag import LagPrior
    from elpd.vision.turns import Line

WIDTHS_PER_DEPTH_OF_FOCUS = 5.0
"""Width of the log S parabola over the depth of focus, for a ray-traced F/2 lens and for Gaussian blur."""

SYSTEMATIC_IMAGE = 0.04
SYSTEMATIC_PAIRS = 0.025
"""Standard deviations of what scatter does not show, in widths of the curve (static sweeps, two thresholds)."""

SMOOTH_PAIRS = 0.01
"""How far, in widths of the curve, midpoints of bright pixels' pairs lie from those of dark ones for other reasons than
lag, as a standard deviation over a picture's brightness: 27 still sweeps through four lenses have 0.007, and 0.010
where the lens is aberrated most. Surfaces have their own brightness, and lenses their own focus for each size."""

SMOOTH_IN_FOCUS = 0.015
"""The same where the picture in focus was made of the events whose pairs are asked (8 still sweeps: 0.015)."""

STILL = 0.1
"""Share of stray pairs up to which a scene counts as still: a pixel's silence then says that it has not come back. In
one that moves it may say so or not, and both are tried."""

ASTRAY = 0.3
"""Share of stray pairs at which nothing that was measured on pairs is believed any more."""

DOUBT = 3.0
"""Error of a lag that was measured on nothing but stray pairs, in lags that one may guess."""

IMAGE_IN_MOTION = 0.1
"""What scene motion adds to the error of the events' image, where it strays all pairs."""

HELD_BACK = 4.0
"""How much the errors of the image grow with the share of what pixels hold back in it."""

LEAST_LEVEL = 1.0 / 3.0
"""Variance, in thresholds², of what pixels hold back: evenly between minus one and one threshold since their last
event. An image that does not stand above it at its sharpest shows the sensor, not the scene."""

PAIRS_DEPART = 2.0
"""Pairs sit on the finest detail: what they depart from focus, in departures of the finest band."""

PAIRS_REACH = 0.8
"""How far, in widths of the curve, a pair may lie from the mode to have a say about the lag: dark pixels have lags of
half a width in a dim room."""

PAIRS_KERNEL = 0.15
"""Width of the kernel that finds the pairs' mode, over the way that the lens went past the peak."""

LAG_UNEXPLAINED = 1.0
"""How much of the lag that was corrected may be wrong: the picture that told bright from dark was blurred itself,
which hides most of the difference."""

WORTH_UNKNOWN = 0.25
"""Standard deviation, in shares, of what an event is worth by the light that a lens conserves: some crosses a region's
border, and thresholds differ from pixel to pixel (seven dim scenes: 0.17 to 0.26 for a true 0.2)."""

DARK_UNKNOWN = 0.25
"""The same of the dark current: it is relative to the brightest parts of a region, which need not be bright."""

SYSTEMATIC_UNDER_A_LAMP = 0.09
"""The systematic error of the curve of whole lamp periods, which is not rebuilt: late by 0.03 widths on the average."""

PERIOD_ERROR = 0.15
"""How far from the middle of a lamp's period its net events may lie in the mean, in periods."""

COARSE_FRAMES = 0.25
"""Frames further apart than this many widths draw the parabola's flanks, not its top; their error grows with it."""

UNANSWERED = 0.23
"""The last part of a record, in widths, whose pixels have turned but not yet answered."""

WORTHS = (2.5, 5.0, 10.0, 20.0, 40.0)
"""Thresholds per unit of log intensity that are tried where nothing tells: sensors have 3 to 20, and below the dark
current a unit of log intensity is more light than it seems."""

GHOSTLESS_BANDS = 1
"""Of a scene that moves, the image that events built from nothing holds the negative of what they began from, which
stays behind: blurred as that was, it is in the coarse bands, and only the finer ones show the scene alone."""

NEAR_WORTHS = (0.5, 0.71, 1.0, 1.41, 2.0)
"""What is tried of the worth that the light's conservation tells: from one frame it is right to a factor of two."""

TICKS = 64
FEWEST_TICKS = 24
LEVELS_AT_ONCE = 3 << 18
"""Pixels times ticks of a rebuilt curve: of a large region fewer ticks are rebuilt where a lens waits for them."""

STILL_SHARE = 0.9
SAMPLE_PX = 1 << 15
"""Where so many pairs agree, the scene is still and the pairs, ten times better known, have the say: the image then
only has to confirm them, and so many pixels are enough for that."""

ROI_MARGIN_PX = 14

NARROWEST = 0.4
"""Width of a vertex over that of the hill it stands on, below which it is a ripple."""

DARK_OF_MAP = 0.01
"""The same for a temporal map: it is made of the photocurrents themselves, the dark current is in it already."""

DARK = 0.08
"""Dark current, relative to the brightest parts: below it a photoreceptor gets no slower (v2e's 20 of 255 levels)."""

_STATIC_SHARE = 0.97


@dataclass(frozen=True, slots=True)
class Witness:
    """One estimator's answer, on the caller's ruler.

    ``sigma`` is its own standard error. The others it has in common with its kind, each with its sign: ``shared`` is
    what is not known of the photoreceptors' lag, which makes every event late; ``held`` what is not known of how late
    the image is because pixels hold back; ``play`` what is not known of the play between motor and carriage.
    """

    name: str
    at: float
    sigma: float
    shared: float = 0.0
    held: float = 0.0
    play: float = 0.0
    freed: float = 0.0
    """How much lag was taken off ``at``."""

    @property
    def total_sigma(self) -> float:
        """All errors together."""
        return float(np.linalg.norm([self.sigma, self.shared, self.held, self.play]))

    def on_the_way_back(self, play: float, play_sigma: float) -> Witness:
        """Return what a pass in the opposite direction said, on the ruler of the sweep.

        What was late lies to the other side there, and the carriage is behind the motor by the *play*.
        """
        return replace(
            self, at=play - self.at, shared=-self.shared, held=-self.held, play=play_sigma, freed=-self.freed
        )

    def with_lag(self, freed: float, shared: float) -> Witness:
        """Return the same as if another lag had been taken off, which is known to *shared*."""
        return replace(self, at=self.at + self.freed - freed, freed=freed, shared=shared)


@dataclass(frozen=True, slots=True)
class EventWitnesses:
    """What the events say: the focus of their image, the mode of their mirror pairs, freed of the typical ``lag``.

    ``held_back`` is the variance of what pixels keep to themselves, for less than a threshold, over the image's.
    """

    image: BandFocus | None
    pairs: Mode | None
    lag: Lag
    held_back: float = 0.0
    depths: tuple[float, ...] = ()
    """Where planes of the region are in focus, nearest first along the sweep, if there are several. Then ``pairs`` are
    those of the first, and there is no image: sharpness shows none of them."""
    plane_width: float = 0.0
    """Width of one plane's curve, as far as its rising flank tells, where there are several."""
    drift: Drift = field(default_factory=Drift)
    """How far the scene went across the sensor meanwhile."""
    expected_lag: Lag = field(default_factory=Lag)
    """What the image would have been freed of if no pair had been asked."""
    pairs_lag: float = 0.0
    """What the pairs were freed of: they need not be of the pixels that the image shows."""
    in_focus: bool = False
    """Whether bright was told from dark by the picture as it is in focus, not by one that was blurred."""

    def witnesses(self, unexplained: float = LAG_UNEXPLAINED, width: float | None = None) -> list[Witness]:
        """Return those that are to be believed, with systematic errors included.

        *unexplained* is the share of the lag that may be wrong. *width* is the curve's own, where it is known
        beforehand; without it, pairs are believed only beside an image.
        """
        found: list[Witness] = []
        if self.image is None and width is None:
            return found
        width = width if width is not None or self.image is None else self.image.finest.width
        assert width is not None
        if self.in_focus:  # the lag's own error holds it
            unexplained = 0.0
        shared = float(np.hypot(unexplained * self.lag.at, self.lag.sigma))
        stray = _stray(self.pairs)
        departure = 0.0
        if self.image is not None:
            departure = max(0.0, abs(self.image.departure) - self.image.sigma)  # what is beyond its own error
            dull = (1.0 + HELD_BACK * self.held_back) * width
            sigma = float(np.hypot(self.image.sigma, IMAGE_IN_MOTION * stray * dull))
            held = SYSTEMATIC_IMAGE * dull
            found.append(Witness("vertex", self.image.at, sigma, shared, held, freed=self.lag.at))
        if self.pairs is not None and self.pairs.count >= MIN_PAIRS:
            systematic = np.hypot((SYSTEMATIC_PAIRS + stray) * width, PAIRS_DEPART * departure)
            sigma = float(np.hypot(self.pairs.sigma, systematic))
            found.append(Witness("pairs", self.pairs.at, sigma, shared, freed=self.pairs_lag))
        return found


def _stray(pairs: Mode | None) -> float:
    """Return which share of pairs disagrees beyond what does in a still scene: how much of the rest is not focus."""
    return max(0.0, _STATIC_SHARE - pairs.share) if pairs is not None else 1.0


def ask_events(
    events: EventStretch,
    begin: float,
    peak: float,
    end: float,
    brightness: NDArray[np.float32] | None = None,
    unmeasured_lag: float = 0.0,
    start: NDArray[np.float32] | None = None,
    calibrated: LagPrior | None = None,
    dark: float = DARK,
    *,
    hurried: bool = True,
) -> EventWitnesses:
    """Rebuild the image over positions *begin* .. *end* and find its focus near *peak*, and the mirror pairs.

    *brightness*, (height, width) of the cut-out, relative to the brightest parts, tells how slow each pixel's
    photoreceptor is; with it, the pairs themselves measure the lag. *unmeasured_lag* is how far the lens goes while a
    typical photoreceptor answers, as far as one may guess. Both witnesses are freed of the lag.
    *start*, as *brightness*, is what was seen when the first of the events came: the picture that they changed.
    *hurried* says that a lens waits.
    *calibrated* is what a calibration says of the lag, instead of *unmeasured_lag*. *dark* is the dark current that
    *brightness* does not show, relative to the brightest parts.
    """
    weight, slowness = _by_brightness(brightness, events, dark)
    if brightness is None and calibrated is not None:
        calibrated = calibrated.unseen()
    groups = by_pixel(events)
    before, at_peak, after = rebuilt(events, groups, np.array([begin, peak, end]))
    bend = at_peak - 0.5 * (before + after)
    soft = None if start is None else cv2.GaussianBlur(start, (0, 0), 1.0)
    worth = None if soft is None else worth_of_an_event(soft, at_peak, events.margin)
    worths = WORTHS if worth is None else tuple(one / worth for one in NEAR_WORTHS)
    if soft is not None and worth is not None:
        slownesses = _slownesses_in_focus(soft, at_peak, worth, events.margin)
    else:
        slownesses = [Slowness.of(one) for one in _slownesses(start, at_peak, slowness)]
    found = find_pairs(events.t_us, events.x, events.y, events.on, events.position, (events.height, events.width))
    smooth = (SMOOTH_PAIRS if worth is None else SMOOTH_IN_FOCUS) * flank_width(begin, peak)
    focused = worth is not None
    reach = PAIRS_REACH * flank_width(begin, peak)
    pairs, late = _pair_mode(
        found, at_peak, (peak, end, reach), slownesses, unmeasured_lag, calibrated, smooth, focused=focused
    )
    planes = find_planes(found, events, groups, at_peak, (begin, peak, end), late.candidates[0].at * slowness)
    # Edges that move make clusters of pairs too.
    if planes and not find_drift(rebuilt(events, groups, np.linspace(begin, end, LOOKS))).seen:
        depths = tuple(plane.at for plane in planes)
        width = flank_width(begin, peak)
        return EventWitnesses(None, planes[0], late.typical, 0.0, depths, width, pairs_lag=late.typical.at)
    if pairs is not None and pairs.share > STILL_SHARE and events.height * events.width > SAMPLE_PX:
        rows = busiest_rows(events, SAMPLE_PX)
        events, weight = rows_of(events, rows), weight[rows]
        at_peak, bend = at_peak[rows], bend[rows]
        slownesses = [Slowness(one.times[rows], one.beyond[rows]) for one in slownesses]
        start = None if start is None else start[rows]
        groups = by_pixel(events)
    pixels = max(1, events.height * events.width)
    count = int(np.clip(LEVELS_AT_ONCE // pixels, FEWEST_TICKS, TICKS)) if hurried else TICKS
    ticks = np.linspace(begin, end, count)
    images = rebuilt(events, groups, ticks)
    drift = find_drift(images)
    still = _stray(pairs) < STILL
    loud = _curves(images, None if still else start, worths, weight, events.margin)
    first = _image_focus(loud[0], ticks, peak)
    hush(images, ticks, events, peak if first is None else first.finest.at)
    quiet = _curves(images, start, worths, weight, events.margin)
    # Where the whole scene is seen to move, a pixel's silence tells nothing, what is laid below does not lie where the
    # ghost does to the last bit, and two pictures that lie aside show a peak that no blur has made.
    below = GHOSTLESS_BANDS if drift.seen else len(BANDS_PX)
    bands = [len(BANDS_PX) if still and not drift.seen else GHOSTLESS_BANDS, *len(worths) * [below]]
    curves = quiet if still else loud if drift.seen else loud + quiet
    candidates = [
        one
        for curve, count in zip(curves, cycle(bands[: len(quiet)]), strict=False)
        if (one := _image_focus(curve, ticks, peak, count)) is not None and (one.as_blur or not drift.seen)
    ]
    image = average_focus(candidates) if candidates else None
    energy, turning = _who_turns(at_peak, bend, weight)
    turning = turning if focused else energy
    lags, expected = late.candidates, late.typical
    if energy.any():
        typical = [_typical(slow.times, turning, energy) for slow in slownesses]
        unasked = _lag_of(None, unmeasured_lag / typical[0], calibrated)
        expected = Lag(typical[0] * unasked.at, typical[0] * unasked.sigma)
        lags = [Lag(at * one.at, at * one.sigma) for at, one in zip(typical, late.candidates, strict=True)]
    lag = _as_known(lags) if focused else average_lag(lags, late.weights)
    pairs_lag = late.typical
    if drift.seen:
        # Edges that move make mirrors wherever they go, those of bright pixels at other times than those of dark ones.
        lag, pairs_lag = expected, late.unasked
        pairs = None if pairs is None else replace(pairs, at=pairs.at + late.typical.at - pairs_lag.at)
    if image is not None:
        image = replace(image, at=image.at - lag.at)
    seen = float((energy[inside_margin(energy.shape, events.margin)]).mean())
    held_back = LEAST_LEVEL * band_gain(BANDS_PX[0]) / max(seen, 1e-12)
    return EventWitnesses(
        image,
        pairs,
        lag,
        held_back,
        drift=drift,
        expected_lag=expected,
        in_focus=focused,
        pairs_lag=pairs_lag.at,
    )


def _who_turns(
    level: NDArray[np.float32], bend: NDArray[np.float32], weight: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where S is at its peak, and which pixels make it fall again; both (height, width).

    S has its energy on both sides of an edge, but it turns where the level of a pixel does, which is the dark side:
    ``S" = 2·sum of L"·B(A·B·L)``. *bend* stands for L".
    """
    band = band_image(level, BANDS_PX[0])
    weighted = np.asarray(band * weight, dtype=np.float32)
    return weighted * band, np.asarray(bend * band_image(weighted, BANDS_PX[0]), dtype=np.float32)


def _typical(slowness: NDArray[np.float64], turning: NDArray[np.float32], energy: NDArray[np.float32]) -> float:
    """Return how slow the image is: the mean over what turns, or over its energy where it does not turn as a whole."""
    by_energy = float(np.average(slowness, weights=energy))
    total = float(turning.sum())
    if total <= 0.0:
        return by_energy
    return float(np.clip((slowness * turning).sum() / total, slowness.min(), slowness.max()))


def _by_brightness(
    brightness: NDArray[np.float32] | None, events: EventStretch, dark: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return each pixel's say in S, and its slowness: how many times slower than the brightest its receptor is."""
    if brightness is None:
        shape = (events.height, events.width)
        return np.ones(shape, dtype=np.float32), np.ones(shape)
    smooth = cv2.GaussianBlur(brightness, (0, 0), 4.0) + np.float32(dark)
    weight = np.asarray(smooth / np.float32(smooth.mean()), dtype=np.float32)
    return weight, (1.0 + dark) / (np.maximum(brightness, 0.0).astype(np.float64) + dark)


def _slownesses_in_focus(
    start: NDArray[np.float32], level: NDArray[np.float32], worth: float, margin: int
) -> list[Slowness]:
    """Return how slow each pixel is in the picture in focus; then with worth and dark current an error off."""
    found = []
    for share, dark in (
        (1.0, DARK),
        (1.0 - WORTH_UNKNOWN, DARK),
        (1.0 + WORTH_UNKNOWN, DARK),
        (1.0, DARK * (1.0 - DARK_UNKNOWN)),
        (1.0, DARK * (1.0 + DARK_UNKNOWN)),
    ):
        found.append(Slowness.of((1.0 + dark) / (in_focus(start, level, share * worth, margin) + dark)))
    return found


def _slownesses(
    start: NDArray[np.float32] | None, level: NDArray[np.float32], slowness: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Return candidates of how slow each pixel is, where it is not known what an event is worth in log intensity.

    A pixel is as slow as the light that it has when it turns, and the start picture was blurred. So several worths are
    tried, and the picture as it was.
    """
    if start is None:
        return [slowness]
    found = [slowness]
    bright = np.maximum(start.astype(np.float64), 0.0) + DARK
    for worth in WORTHS:
        lit = bright * np.exp(np.clip(level.astype(np.float64) / worth, -5.0, 5.0))
        found.append((1.0 + DARK) / np.clip(lit, DARK, 1.0 + DARK))
    return found


def _curves(
    images: NDArray[np.float32],
    start: NDArray[np.float32] | None,
    worths: tuple[float, ...],
    weight: NDArray[np.float32],
    margin: int,
) -> list[NDArray[np.float64]]:
    """Return candidates of log S, (ticks, bands): of the images as they are, and with the start picture below them.

    Events count changes since their first; what was there before, the blurred start picture, is missing. In a still
    scene that is as symmetric in defocus as the picture itself. In one that moves, the picture wanders over what is
    missing, and S wavers. What it is worth in events is known roughly at best, so several *worths* are tried.
    """
    own = np.array([band_products(image, image, weight, margin) for image in images])
    curves = [own]
    if start is not None:
        below = np.log(np.maximum(start, 0.0) + np.float32(DARK)).astype(np.float32)
        mixed = np.array([band_products(image, below, weight, margin) for image in images])
        under = band_products(below, below, weight, margin)
        curves += [own + 2.0 * worth * mixed + worth**2 * under for worth in worths]
    return [np.log(freed_of_noise(one) + 1e-12) for one in curves]


def _image_focus(
    curve: NDArray[np.float64], ticks: NDArray[np.float64], peak: float, bands: int = len(BANDS_PX)
) -> BandFocus | None:
    """Find the focus of a curve of log S, (ticks, bands), but for what lies too near the end of the record."""
    end = float(ticks[-1])
    wide = fit_vertex(ticks, curve[:, 0], end - float(ticks[0]))
    if wide is None:
        return None
    use = ticks <= end - UNANSWERED * wide.width
    if int(use.sum()) < 5:
        return None
    found = focus_of_bands(ticks[use], curve[use], 0.7 * wide.width, bands)
    if found is None or found.finest.at > end - (UNANSWERED + 0.2) * found.finest.width:
        return None
    # The flank that led up to the peak is as wide as the curve; a dent in it is not the curve.
    if found.finest.width < NARROWEST * (peak - float(ticks[0])) / float(np.sqrt(2.0 * FLANK)):
        return None
    return found


def frame_witness(vertex: BandFocus, spacing: float) -> Witness:
    """Return what frames say, taken every *spacing* along the sweep."""
    coarseness = max(1.0, spacing / (COARSE_FRAMES * vertex.finest.width))
    return Witness("frames", vertex.at, coarseness * vertex.sigma)


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
    common = np.array([(one.shared, one.held, one.play) for one in witnesses])
    covariance = np.diag([one.sigma**2 for one in witnesses]) + common @ common.T
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


@dataclass(frozen=True, slots=True)
class _Lateness:
    """The lag of the brightest under each candidate for slowness, and how well each explains the pairs."""

    candidates: list[Lag]
    weights: NDArray[np.float64]
    typical: Lag
    """What it makes of the pixels that turned, on the average."""
    unasked: Lag
    """The same if no pair had been asked."""


def _pair_mode(
    pairs: Pairs,
    level: NDArray[np.float32],
    stretch: tuple[float, float, float],
    slownesses: list[Slowness],
    unmeasured_lag: float,
    calibrated: LagPrior | None,
    smooth: float,
    *,
    focused: bool,
) -> tuple[Mode | None, _Lateness]:
    """Return the mode of the mirror pairs, freed of lag, and the lag under each candidate for slowness.

    *stretch* is where the raw peak and the end lie, and how far from the mode pairs tell of the lag.
    """
    peak, end, reach = stretch
    curvature = cv2.Laplacian(cv2.GaussianBlur(level, (0, 0), 1.0), cv2.CV_32F)[pairs.y, pairs.x].astype(np.float64)
    past = end - peak
    # Only dark sides of edges, where slowness is known: in log intensity they turn sharply, in focus, where bright
    # sides turn far and wide, and what a lens does to one side of focus and not to the other shows most. Elsewhere the
    # line wants both, which differ more in brightness.
    sided = (pairs.on > 0) & (curvature > 0.0) if focused else (2.0 * pairs.on - 1.0) * curvature > 0.0
    believed = sided & (pairs.after >= peak - 0.5 * past)
    gap = np.maximum(pairs.after - pairs.before, 1e-3 * past)[believed]
    weights = np.abs(curvature)[believed] / gap
    middle = pairs.middle[believed]
    mode = weighted_mode(middle, weights, PAIRS_KERNEL * past)
    if mode is None:
        unknown = [_lag_of(None, unmeasured_lag / float(one.times.mean()), calibrated) for one in slownesses]
        return None, _Lateness(unknown, np.ones(len(unknown)), unknown[0], unknown[0])
    x, y = pairs.x[believed], pairs.y[believed]
    turns = Turns(middle, gap, weights, blocks_of(x, y, level.shape), mode.at, PAIRS_KERNEL * past, reach, smooth)
    slow = [one.at(y, x) for one in slownesses]
    usual = [float(np.average(one.times, weights=turns.near)) for one in slow]
    drawn = [turns.line(one) for one in slow]
    lines = [line for line, _ in drawn]
    typical = [float(np.average(one, weights=turns.near)) for _, one in drawn]
    # A lag that differs from pixel to pixel spreads their midpoints, which is not to go astray.
    mode = replace(mode, share=max(mode.share, *(turns.share(line, one) for line, one in drawn)))
    # Pairs that motion made turn at any time, and what they say of the lag is worth less than the expectation. That is
    # of a receptor's own lag: pairs that came too soon to be late themselves do not make the receptors slower.
    doubt = min(1.0, _stray(mode) / ASTRAY) * DOUBT * unmeasured_lag
    late = [
        _lag_of(
            None if line is None else replace(line, sigma=float(np.hypot(line.sigma, doubt / one))),
            unmeasured_lag / one,
            calibrated,
        )
        for line, one in zip(lines, usual, strict=True)
    ]
    fit = weights_of_lines(lines)
    lags = [Lag(one.at * at, one.sigma * at) for one, at in zip(late, typical, strict=True)]
    lag = _as_known(lags) if focused else average_lag(lags, fit)
    nothing = _lag_of(None, unmeasured_lag / usual[0], calibrated)
    unasked = Lag(usual[0] * nothing.at, usual[0] * nothing.sigma)
    return replace(mode, at=mode.at - lag.at), _Lateness(late, fit, lag, unasked)


def _as_known(lags: list[Lag]) -> Lag:
    """Return the first of ``_slownesses_in_focus``'s lags, with what the others differ by in its error."""
    first, *others = lags
    apart = [0.5 * (high.at - low.at) for low, high in zip(others[::2], others[1::2], strict=True)]
    return Lag(first.at, float(np.linalg.norm([first.sigma, *apart])))


def _lag_of(line: Line | None, expected: float, calibrated: LagPrior | None) -> Lag:
    """Return the lag by the pairs and what is known beforehand: a calibration, or photoreceptors at large."""
    return expected_lag(line, expected) if calibrated is None else calibrated.with_line(line)
