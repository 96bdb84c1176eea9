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
from typing import TYPE_CHECKING

import numpy as np

from elpd.records import FocusEstimate
from elpd.vision.drift import Drift
from elpd.vision.lag import Lag
from elpd.vision.planes import MIN_PAIRS
from elpd.vision.refractory import NOT_DEAF, Refractory
from elpd.vision.relief import halves_apart

if TYPE_CHECKING:
    from collections.abc import Sequence

    from elpd.vision.bands import BandFocus
    from elpd.vision.image_parts import ImageParts
    from elpd.vision.integral import Vertex
    from elpd.vision.pairs import Mode
    from elpd.vision.turns import Turns

WIDTHS_PER_DEPTH_OF_FOCUS = 5.0
"""Width of the log S parabola over the depth of focus, for a ray-traced F/2 lens and for Gaussian blur."""

SYSTEMATIC_IMAGE = 0.04
SYSTEMATIC_PAIRS = 0.025
"""Standard deviations of what scatter does not show, in widths of the curve (static sweeps, two thresholds)."""

LOPSIDED_PAIRS = 0.0075
"""How far, in widths, the middle of a pair that is a width long lies from focus, as a standard deviation: a lens that
is not symmetric about focus moves it, and with the square of the length, as the next term of a series does. Through the
axis of a traced F/2 lens pairs of two widths lie 0.03 behind focus, the six of a brick wall 0.3, there and back."""

IMAGE_IN_MOTION = 0.1
"""What scene motion adds to the error of the events' image, where it strays all pairs."""

HELD_BACK = 4.0
"""How much the errors of the image grow with the share of what pixels hold back in it."""

PAIRS_DEPART = 2.0
"""Pairs sit on the finest detail: what they depart from focus, in departures of the finest band."""

LAG_UNEXPLAINED = 1.0
"""How much of the lag that was corrected may be wrong: the picture that told bright from dark was blurred itself,
which hides most of the difference."""

LOSSES_UNEXPLAINED = 0.3
"""Share of what was put back of a deaf pixel's losses that may be wrong: the level does not go on evenly."""

SYSTEMATIC_UNDER_A_LAMP = 0.09
"""The systematic error of the curve of whole lamp periods, which is not rebuilt: late by 0.03 widths on the average."""

PERIOD_ERROR = 0.15
"""How far from the middle of a lamp's period its net events may lie in the mean, in periods."""

COARSE_FRAMES = 0.25
"""Frames further apart than this many widths draw the parabola's flanks, not its top; their error grows with it."""

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
    astray: float = 0.0
    """What pairs that turn elsewhere add to the error: a region with several depths would have them, or motion."""
    apart: float = 0.0
    """What it is in a region that is known to be flat: how far apart halves of it put their modes."""
    optics: float = 0.0
    """What a lens does to one side of focus and not to the other: the same in every pass, so no mean makes it less."""
    lost: float = 0.0
    """What is not known of what pixels lost while they were deaf, with its sign."""
    lost_per_us: float = 0.0
    """How far ``at`` would go if pixels were deaf for a microsecond longer, because more was lost."""
    dated_per_us: float = 0.0
    """The same because events would be dated later; what is not known of that is in ``shared``."""
    deaf_us: float = 0.0
    """How long pixels were taken to be deaf."""

    @property
    def total_sigma(self) -> float:
        """All errors together."""
        common = (self.shared, self.held, self.play, self.optics, self.lost)
        return float(np.linalg.norm([self.sigma, self.astray, *common]))

    def on_the_way_back(self, play: float, play_sigma: float) -> Witness:
        """Return what a pass in the opposite direction said, on the ruler of the sweep.

        What was late lies to the other side there, and the carriage is behind the motor by the *play*.
        """
        return replace(
            self,
            at=play - self.at,
            shared=-self.shared,
            held=-self.held,
            play=play_sigma,
            freed=-self.freed,
            lost=-self.lost,
            lost_per_us=-self.lost_per_us,
            dated_per_us=-self.dated_per_us,
        )

    def if_deaf_for(self, deaf: Refractory) -> Witness:
        """Return the same as if pixels had been taken to be deaf for as long as has been learnt since."""
        doubt_us = float(np.hypot(deaf.sigma_us, LOSSES_UNEXPLAINED * deaf.period_us))
        at = self.at + (self.lost_per_us + self.dated_per_us) * (deaf.period_us - self.deaf_us)
        return replace(self, at=at, deaf_us=deaf.period_us, lost=self.lost_per_us * doubt_us)

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
    deaf: Refractory = NOT_DEAF
    """How long pixels were taken to be deaf."""
    put_back: float = 0.0
    """How far the image's focus went because what they lost meanwhile was put back."""
    parts: ImageParts | None = None
    """Where parts of the image are sharpest, if all of it was asked."""
    turns: Turns | None = None
    """The pairs themselves, as they were asked."""
    in_focus: bool = False
    """Whether bright was told from dark by the picture as it is in focus, not by one that was blurred."""

    def witnesses(self, unexplained: float = LAG_UNEXPLAINED, width: float | None = None) -> list[Witness]:
        """Return those that are to be believed, with systematic errors included.

        *unexplained* is the share of the lag that may be wrong. *width* is the curve's own, where it is known
        beforehand; without it, pairs are believed only beside an image.
        """
        vertex = self.vertex(unexplained, width)
        found = [] if vertex is None else [vertex]
        if width is None and self.image is not None:
            width = self.image.finest.width
        if width is not None and self.pairs is not None and self.pairs.count >= MIN_PAIRS:
            # What the image's departure is beyond its own error.
            departure = 0.0 if self.image is None else max(0.0, abs(self.image.departure) - self.image.sigma)
            found.append(
                Witness(
                    "pairs",
                    self.pairs.at,
                    float(np.hypot(self.pairs.sigma, PAIRS_DEPART * departure)),
                    self._shared(unexplained),
                    freed=self.pairs_lag,
                    astray=stray_share(self.pairs) * width,
                    apart=0.0 if self.turns is None else halves_apart(self.turns),
                    optics=_optics_of_pairs(self.turns, width),
                    deaf_us=self.deaf.period_us,
                )
            )
        return found

    def vertex(self, unexplained: float = LAG_UNEXPLAINED, width: float | None = None) -> Witness | None:
        """Return the image's alone, on the same terms; ``None`` without an image."""
        if self.image is None:
            return None
        dull = (1.0 + HELD_BACK * self.held_back) * (self.image.finest.width if width is None else width)
        sigma = float(np.hypot(self.image.sigma, IMAGE_IN_MOTION * stray_share(self.pairs) * dull))
        shared, held = self._shared(unexplained), SYSTEMATIC_IMAGE * dull
        period_us = self.deaf.period_us
        per_us = self.put_back / period_us if period_us > 0.0 else 0.0
        found = Witness(
            "vertex", self.image.at, sigma, shared, held, freed=self.lag.at, lost_per_us=per_us, deaf_us=period_us
        )
        return found.if_deaf_for(self.deaf)

    def _shared(self, unexplained: float) -> float:
        share = 0.0 if self.in_focus else unexplained  # where it is in focus, the lag's own error holds it
        return float(np.hypot(share * self.lag.at, self.lag.sigma))


def _optics_of_pairs(turns: Turns | None, width: float) -> float:
    """Return the error of the pairs' mode by what the lens does, the worse the longer they are."""
    lopsided = 0.0 if turns is None else LOPSIDED_PAIRS * turns.mean_square_gap / width
    return float(np.hypot(SYSTEMATIC_PAIRS * width, lopsided))


def stray_share(pairs: Mode | None) -> float:
    """Return which share of pairs disagrees beyond what does in a still scene: how much of the rest is not focus."""
    return max(0.0, _STATIC_SHARE - pairs.share) if pairs is not None else 1.0


def frame_witness(vertex: BandFocus, spacing: float) -> Witness:
    """Return what frames say, taken every *spacing* along the sweep."""
    coarseness = max(1.0, spacing / (COARSE_FRAMES * vertex.finest.width))
    own = float(np.sqrt(max(0.0, vertex.sigma**2 - vertex.directed**2)))
    return Witness("frames", vertex.at, float(np.hypot(coarseness * own, vertex.directed)))


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
    common = np.array([(one.shared, one.held, one.play, one.optics, one.lost) for one in witnesses])
    covariance = np.diag([one.sigma**2 + one.astray**2 for one in witnesses]) + common @ common.T
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
    lasting = abs(float(share @ np.array([one.optics for one in witnesses])))
    return FocusEstimate(focus, sigma, "pairs" if main == "pairs" else "crossing", contributions, lasting)
