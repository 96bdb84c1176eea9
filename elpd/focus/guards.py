"""Misfortunes that the events themselves betray: what to tell the person, what to do differently, what to refuse.

Each guard takes what ``vision`` measured and returns sentences, a number to go on with, or ends the cycle. A sentence
names what was measured and what to change; results carry them as ``warnings``, whatever the outcome.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.focus.ended import Ended
from elpd.records import Outcome

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.focus.settings import CycleSettings
    from elpd.vision.flicker import Flicker
    from elpd.vision.resting import Resting

MOST_RESIDUE = 2.0
"""Mean square of what whole lamp periods may leave in a pixel, in thresholds²: what a comparator holds back makes up
one; beyond two the pixels do not follow the lamp down as they followed it up."""

TRAVEL_PER_PERIOD_DOF = 1.0
"""Travel in one period of a lamp: the curve of sharpness is ten depths of focus wide."""

MOST_CLIPPED = 0.05
"""Share of saturated pixels that a well exposed frame may have."""

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


def of_depths(depths_um: tuple[float, ...]) -> list[str]:
    """Return what there is to tell of several planes in the region."""
    if len(depths_um) < 2:
        return []
    first, *others = (f"{at:.0f}" for at in depths_um)
    told = (
        f"the ROI holds several depths: in focus is what the sweep met first, at {first} um; others are at "
        f"{', '.join(others)} um. Draw a smaller ROI on the subject to choose"
    )
    return [told]


def of_late_lamp(flicker: Flicker | None) -> list[str]:
    """Return what there is to tell of a lamp that only the sweep has shown."""
    if flicker is None:
        return []
    return [
        f"{flicker.share:.0%} of the sweep's events swing at {flicker.frequency_hz:.0f} Hz: does the light flicker?"
    ]


def of_marks(marks: int | None) -> list[str]:
    """Say that no position mark came where some are wired (*marks* is how many were believed, ``None``: not wired)."""
    if marks != 0:
        return []
    seen = "the lens marks its positions on a line to the camera's trigger input, and the camera saw no edge that fits"
    told = "check that wire, lens.sync_channel, and that the camera's driver listens to its input"
    return [f"{seen}: {told}; positions are those of the clocks alone"]


def of_loss(lost_events: int) -> list[str]:
    """Return what there is to tell of events that never came."""
    if lost_events == 0:
        return []
    return [f"{lost_events} events were lost; choose a smaller ROI, a slower sweep or higher contrast thresholds"]


def of_shedding(shed_us: int) -> list[str]:
    """Return what there is to tell of slices of a sweep that this computer had no time for."""
    if shed_us == 0:
        return []
    told = (
        f"{shed_us / 1000:.1f} ms of the sweep were not looked at, because events came faster than this computer takes "
        "them; choose a smaller ROI, a slower sweep or higher contrast thresholds, or give it more of the processor"
    )
    return [told]


def of_rate(plateau_mev_s: float | None) -> list[str]:
    """Return what there is to tell of a read-out that is full."""
    if plateau_mev_s is None:
        return []
    told = (
        f"the event rate stands still at {plateau_mev_s:.2f} million a second: the read-out is saturated, and drops or "
        "delays events without saying so; choose a smaller ROI, a slower sweep or higher contrast thresholds"
    )
    return [told]


def of_frame(pixels: NDArray[Any] | None) -> list[str]:
    """Return what there is to tell of the region in a frame."""
    if pixels is None or pixels.size == 0:
        return []
    clipped = float((pixels >= np.iinfo(pixels.dtype).max).mean())
    if clipped <= MOST_CLIPPED:
        return []
    return [f"{clipped:.0%} of the ROI is saturated in the frames; expose them for a shorter time"]


def of_lamp(lamp: Flicker, speed_um_s: float) -> str:
    """Return what there is to tell of a lamp that flickers and was swept under."""
    return (
        f"the light flickers at {lamp.frequency_hz:.0f} Hz: the sweep was slowed down to {speed_um_s:.0f} um/s and "
        "judged in whole periods of it; a lamp without flicker lets it be faster"
    )


def speed_under(lamp: Flicker, residue: float, settings: CycleSettings) -> float:
    """Return how fast to sweep so that whole periods of a lamp are short against focus. Ends the cycle if they lie."""
    if residue > MOST_RESIDUE:
        raise Ended(
            Outcome.LOW_CONFIDENCE,
            f"the light flickers at {lamp.frequency_hz:.0f} Hz, too strongly for the pixels to follow (whole periods "
            f"leave {residue:.1f} thresholds² behind, limit {MOST_RESIDUE:.0f}); use a lamp without flicker",
        )
    return min(settings.speed_um_s, TRAVEL_PER_PERIOD_DOF * settings.depth_of_focus_um * lamp.frequency_hz)
