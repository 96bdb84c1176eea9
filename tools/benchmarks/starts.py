"""Pictures that a sweep begins with: an opening aperture's, and in its place what the first events let one guess."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.sets import APERTURE_US, MAP, REBUILT
from elpd.baselines import e2vid, reconstruction
from elpd.units import SensorUs
from elpd.vision.first_events import FirstEventMap
from elpd.vision.pictures import display
from elpd.vision.reference import reference_from_frame, reference_from_temporal_image
from elpd.vision.temporal_map import read_transmittance, temporal_image

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from benchmarks.cases import SweepRecording
    from elpd.records import TemporalImage
    from elpd.vision.reference import Reference

REBUILT_SHARE = 0.1
"""How much of the sweep goes by before a picture made from its own events is used."""


def aperture_picture(recording: SweepRecording) -> TemporalImage:
    """Return the picture that the events of the opening aperture give."""
    first = FirstEventMap(recording.geometry, 0, APERTURE_US)
    stop = int(np.searchsorted(recording.t_us, APERTURE_US))
    first.add(recording.t_us[:stop], recording.x[:stop], recording.y[:stop], recording.on[:stop])
    return temporal_image(first.believed(), read_transmittance("linear"), SensorUs(0))


@dataclass(frozen=True, slots=True)
class Start:
    """A picture that is there before the search begins: for our detector, as grey for the others, and from when on."""

    reference: Reference
    grey: NDArray[np.uint8]
    begin_us: int


def start(rate: str, recording: SweepRecording, weights: Path | None) -> Start | None:
    """Return the picture named by *rate*; ``None`` where no event came to make one of."""
    begin_us, end_us = recording.case.of_set.sweep_begin_us, recording.case.of_set.end_us
    if rate == MAP:
        made = aperture_picture(recording)
        grey = display(made.log_intensity, made.valid)
        return Start(reference_from_temporal_image(made, recording.roi), grey, begin_us)
    # In place of the aperture's: what the first tenth of the sweep itself lets one guess.
    until_us = begin_us + round(REBUILT_SHARE * (end_us - begin_us))
    first, stop = (int(place) for place in np.searchsorted(recording.t_us, (begin_us, until_us)))
    if stop == first:
        return None
    part = slice(first, stop)
    events = recording.t_us[part], recording.x[part], recording.y[part], recording.on[part]
    if rate == REBUILT:
        log = reconstruction.reconstruct(*events, recording.geometry, until_us)
        return Start(reference_from_frame(np.exp(log), recording.roi), display(log), until_us)
    if weights is None:
        raise ValueError("E2VID needs a file of weights")
    seen = e2vid.reconstruct(e2vid.E2vid(weights), *events, recording.geometry)
    if seen is None:
        return None
    return Start(reference_from_frame(seen, recording.roi), display(seen), until_us)
