"""The events of a pass over focus, asked: where was their image sharpest, and where do their mirror pairs turn.

Both are freed of the photoreceptors' lag, as far as pairs or expectation tell it. What they say is weighed in
``elpd.vision.witness``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import cycle
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.astigmatism import edges_of_each
from elpd.vision.bands import BandFocus, average_focus
from elpd.vision.drift import LOOKS, Drift, find_drift
from elpd.vision.image_focus import (
    UNANSWERED,
    band_energy_image,
    image_focus,
    sharpness_curves,
    typical_slowness,
    who_turns,
)
from elpd.vision.image_parts import ImageParts
from elpd.vision.integral import BANDS_PX, band_gain, inside_margin
from elpd.vision.lag import Lag, average_lag
from elpd.vision.light import worth_of_an_event
from elpd.vision.pair_focus import PAIRS_REACH, Lateness, as_known, lag_of, pair_mode
from elpd.vision.pairs import find_pairs
from elpd.vision.planes import find_planes, flank_width
from elpd.vision.rebuilt import EventStretch, busiest_rows, by_pixel, hush, rebuilt, rows_of
from elpd.vision.slowness import DARK, WORTHS, by_brightness, slownesses, slownesses_in_focus
from elpd.vision.turns import Slowness
from elpd.vision.witness import EventWitnesses, stray_share

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.vision.lag import LagPrior
    from elpd.vision.rebuilt import Groups

STILL = 0.1
"""Share of stray pairs up to which a scene counts as still: a pixel's silence then says that it has not come back. In
one that moves it may say so or not, and both are tried."""

LEAST_LEVEL = 1.0 / 3.0
"""Variance, in thresholds², of what pixels hold back: evenly between minus one and one threshold since their last
event. An image that does not stand above it at its sharpest shows the sensor, not the scene."""

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

NO_FOCUS_HEARD = 0.2
"""How far, in widths, losses that were put back may have moved a focus that is not there without them."""


@dataclass(frozen=True, slots=True)
class _Light:
    """How bright the pixels of a region are, (height, width) each.

    ``weight`` is their say in S, ``plain`` how slow they are by the picture that was given, ``slow`` candidates of how
    slow they are in focus. ``start`` is the picture that the first events changed, which is worth one of ``worths``
    in thresholds; ``focused`` says that the events themselves have told.
    """

    weight: NDArray[np.float32]
    plain: NDArray[np.float64]
    slow: list[Slowness]
    start: NDArray[np.float32] | None
    worths: tuple[float, ...]
    focused: bool

    @classmethod
    def of(
        cls,
        events: EventStretch,
        level: NDArray[np.float32],
        brightness: NDArray[np.float32] | None,
        start: NDArray[np.float32] | None,
        dark: float,
    ) -> _Light:
        """Return what is known where the events' image in focus is *level*."""
        weight, plain = by_brightness(brightness, events, dark)
        soft = None if start is None else cv2.GaussianBlur(start, (0, 0), 1.0)
        worth = None if soft is None else worth_of_an_event(soft, level, events.margin)
        if soft is None or worth is None:
            slow = [Slowness.of(one) for one in slownesses(start, level, plain)]
            return cls(weight, plain, slow, start, WORTHS, focused=False)
        worths = tuple(one / worth for one in NEAR_WORTHS)
        slow = slownesses_in_focus(soft, level, worth, events.margin)
        return cls(weight, plain, slow, start, worths, focused=True)

    def of_rows(self, rows: slice) -> _Light:
        """Return that of some rows."""
        slow = [Slowness(one.times[rows], one.beyond[rows]) for one in self.slow]
        start = None if self.start is None else self.start[rows]
        return _Light(self.weight[rows], self.plain[rows], slow, start, self.worths, self.focused)


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
    if brightness is None and calibrated is not None:
        calibrated = calibrated.unseen()
    groups = by_pixel(events)
    at_peak = rebuilt(events, groups, np.array([peak]))[0]
    light = _Light.of(events, at_peak, brightness, start, dark)
    width = flank_width(begin, peak)
    found = find_pairs(events.t_us, events.x, events.y, events.on, events.position, (events.height, events.width))
    pairs, late = pair_mode(
        found,
        at_peak,
        (peak, end, PAIRS_REACH * width),
        light.slow,
        unmeasured_lag,
        calibrated,
        focused=light.focused,
    )
    planes = find_planes(found, events, groups, at_peak, (begin, peak, end), late.candidates[0].at * light.plain)
    # Edges that move make clusters of pairs too.
    if planes and not find_drift(rebuilt(events, groups, np.linspace(begin, end, LOOKS))).seen:
        depths = tuple(plane.at for plane in planes)
        return EventWitnesses(None, planes[0], late.typical, 0.0, depths, width, pairs_lag=late.typical.at)
    sampled = pairs is not None and pairs.share > STILL_SHARE and events.height * events.width > SAMPLE_PX
    if sampled:
        rows = busiest_rows(events, SAMPLE_PX)
        events, light, at_peak = rows_of(events, rows), light.of_rows(rows), at_peak[rows]
        groups = by_pixel(events)
    pixels = max(1, events.height * events.width)
    ticks = np.linspace(begin, end, int(np.clip(LEVELS_AT_ONCE // pixels, FEWEST_TICKS, TICKS)) if hurried else TICKS)
    images = rebuilt(events, groups, ticks)
    energy = band_energy_image(at_peak, light.weight)
    turning = energy
    if light.focused:
        turning = who_turns(at_peak, at_peak - 0.5 * (images[0] + images[-1]), light.weight)
    lag, expected = _lag_of_image(light, energy, turning, late, unmeasured_lag, calibrated)
    image, drift = _sharpest(images, ticks, peak, events, light, still=stray_share(pairs) < STILL)
    put_back = 0.0
    if drift.seen and image is not None:
        put_back = _put_back(image, events, groups, ticks, peak, light)
    parts = None
    if image is not None and not sampled:
        until = float(ticks[-1]) - UNANSWERED * image.finest.width
        parts = ImageParts.of(images[::2], ticks[::2], light.weight, events.margin, image, until)
    seen = float((energy[inside_margin(energy.shape, events.margin)]).mean())
    pairs_lag = late.typical
    if drift.seen:
        # Edges that move make mirrors wherever they go, those of bright pixels at other times than those of dark ones.
        lag, pairs_lag = expected, late.unasked
        pairs = None if pairs is None else replace(pairs, at=pairs.at + late.typical.at - pairs_lag.at)
    if pairs is not None and image is not None and image.astigmatism is not None:
        shift, sigma = image.astigmatism.shift(late.towards)
        pairs = replace(pairs, at=pairs.at - shift, sigma=float(np.hypot(pairs.sigma, sigma)))
    return EventWitnesses(
        None if image is None else replace(image, at=image.at - lag.at),
        pairs,
        lag,
        LEAST_LEVEL * band_gain(BANDS_PX[0]) / max(seen, 1e-12),
        drift=drift,
        expected_lag=expected,
        turns=late.turns,
        in_focus=light.focused,
        pairs_lag=pairs_lag.at,
        deaf=events.deaf,
        put_back=put_back,
        parts=parts,
    )


def _put_back(
    image: BandFocus,
    events: EventStretch,
    groups: Groups,
    ticks: NDArray[np.float64],
    peak: float,
    light: _Light,
) -> float:
    """Return how far focus went because what pixels lost while deaf was put back into the image of a moving scene."""
    if events.deaf.period_us <= 0.0:
        return 0.0
    heard = rebuilt(events.as_heard(), groups, ticks)
    as_heard, _ = _sharpest(heard, ticks, peak, events, light, still=False)
    return NO_FOCUS_HEARD * image.finest.width if as_heard is None else image.at - as_heard.at


def _sharpest(
    images: NDArray[np.float32],
    ticks: NDArray[np.float64],
    peak: float,
    events: EventStretch,
    light: _Light,
    *,
    still: bool,
) -> tuple[BandFocus | None, Drift]:
    """Return where the images are sharpest, and how far the scene went meanwhile. The images are hushed in place."""
    drift = find_drift(images)
    loud = sharpness_curves(images, None if still else light.start, light.worths, light.weight, events.margin)
    first = image_focus(loud[0], ticks, peak)
    hush(images, ticks, events, peak if first is None else first.finest.at)
    moves = drift.seen and not still
    quiet = loud if moves else sharpness_curves(images, light.start, light.worths, light.weight, events.margin)
    # Where the whole scene is seen to move, a pixel's silence tells nothing, what is laid below does not lie where the
    # ghost does to the last bit, and two pictures that lie aside show a peak that no blur has made.
    below = GHOSTLESS_BANDS if drift.seen else len(BANDS_PX)
    edges = edges_of_each(images, light.weight, events.margin)
    bands = [len(BANDS_PX) if still and not drift.seen else GHOSTLESS_BANDS, *len(light.worths) * [below]]
    curves = quiet if still or moves else loud + quiet
    candidates = [
        one
        for curve, count in zip(curves, cycle(bands[: len(quiet)]), strict=False)
        if (one := image_focus(curve, ticks, peak, count, edges)) is not None and (one.as_blur or not drift.seen)
    ]
    return average_focus(candidates) if candidates else None, drift


def _lag_of_image(
    light: _Light,
    energy: NDArray[np.float32],
    turning: NDArray[np.float32],
    late: Lateness,
    unmeasured_lag: float,
    calibrated: LagPrior | None,
) -> tuple[Lag, Lag]:
    """Return the lag of the pixels that make the image sharp: by what the pairs said, and if none had been asked."""
    if not energy.any():
        return late.typical, late.typical
    slow = [typical_slowness(one.times, turning, energy) for one in light.slow]
    unasked = lag_of(None, unmeasured_lag / slow[0], calibrated)
    lags = [Lag(at * one.at, at * one.sigma) for at, one in zip(slow, late.candidates, strict=True)]
    lag = as_known(lags) if light.focused else average_lag(lags, late.weights)
    return lag, Lag(slow[0] * unasked.at, slow[0] * unasked.sigma)
