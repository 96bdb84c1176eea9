"""Misfortunes that the events themselves betray: what to tell the person, what to do differently, what to refuse.

Each guard takes what ``vision`` measured and returns sentences, a number to go on with, or ends the cycle. A sentence
names what was measured and what to change; results carry them as ``warnings``, whatever the outcome.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.focus.ended import Ended
from elpd.records import Outcome

if TYPE_CHECKING:
    from elpd.focus.settings import CycleSettings
    from elpd.vision.flicker import Flicker
    from elpd.vision.resting import Resting

MOST_RESIDUE = 2.0
"""Mean square of what whole lamp periods may leave in a pixel, in thresholds²: what a comparator holds back makes up one;
beyond two the pixels do not follow the lamp down as they followed it up."""

TRAVEL_PER_PERIOD_DOF = 1.0
"""Travel in one period of a lamp: the curve of sharpness is ten depths of focus wide."""

NOISY_HZ = 10.0
"""Noise per pixel above which a sensor in the light is worth a word: usual are one to five."""


def of_rest(resting: Resting) -> list[str]:
    """Return what there is to tell of a sensor at rest."""
    told = []
    hot = int(resting.hot.sum())
    if hot:
        told.append(f"{hot} hot pixel{'s' if hot > 1 else ''} in the ROI left out; mask them in the camera if it can")
    if resting.flicker is None and resting.noise_hz > NOISY_HZ:
        told.append(
            f"at rest each pixel fires {resting.noise_hz:.0f} times a second (usual: below {NOISY_HZ:.0f}); add light, "
            "raise the contrast thresholds, or hold scene and camera still"
        )
    return told


def of_lamp(lamp: Flicker, speed_um_s: float) -> str:
    """Return what there is to tell of a lamp that flickers and was swept under."""
    return (
        f"the light flickers at {lamp.frequency_hz:.0f} Hz: the sweep was slowed down to {speed_um_s:.0f} um/s and judged "
        "in whole periods of it; a lamp without flicker lets it be faster"
    )


def speed_under(lamp: Flicker, residue: float, settings: CycleSettings) -> float:
    """Return how fast to sweep so that whole periods of a lamp are short against focus. Ends the cycle if they lie."""
    if residue > MOST_RESIDUE:
        raise Ended(
            Outcome.LOW_CONFIDENCE,
            f"the light flickers at {lamp.frequency_hz:.0f} Hz, too strongly for the pixels to follow (whole periods leave "
            f"{residue:.1f} thresholds² behind, limit {MOST_RESIDUE:.0f}); use daylight or a lamp without flicker",
        )
    return min(settings.speed_um_s, TRAVEL_PER_PERIOD_DOF * settings.depth_of_focus_um * lamp.frequency_hz)
