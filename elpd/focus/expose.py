"""Stage 1: open the aperture over the sensor, and turn first-event times into a picture.

The command to open is stamped, but the mechanics answer some milliseconds later and nobody knows how many; so the
opening is searched for in the events, from the command onwards. The sensor is biased for this (one ON event a pixel,
no OFF), listens for a moment to the dark before, and is left in that setting: the cycle switches it afterwards.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from elpd.errors import UsageError
from elpd.focus.safety import CAMERA_SILENCE_MS
from elpd.ports import Biases, HardwareRoi
from elpd.records import BiasSet
from elpd.units import after_ms
from elpd.vision.first_events import FirstEventMap
from elpd.vision.temporal_map import iris, linear, quality, temporal_image

if TYPE_CHECKING:
    from elpd.focus.stage import Stage
    from elpd.records import TemporalImage

DARK_MS = 15.0
"""Biases settle and noise shows itself before the light comes."""

LATE_LIMIT = 0.05
"""Once the aperture is open the light stays as it is, and only noise makes first events."""

AFTER_FACTOR = 1.5
"""Wait half as long again as the aperture says: dark pixels answer late."""


def expose(
    stage: Stage, transmittance: Literal["profile", "linear", "iris"]
) -> tuple[TemporalImage | None, tuple[bool, str]]:
    """Close the aperture, open it, and return the picture with the word on its quality.

    The picture is ``None`` where no pixel saw light. Raises ``UsageError`` without an aperture, ``CameraError`` and
    ``LensError`` from the rig.
    """
    camera, aperture = stage.parts.camera, stage.parts.aperture
    if aperture is None:
        raise UsageError("this rig has no aperture to expose with; give --reference IMAGE or use a camera with frames")
    if isinstance(camera, HardwareRoi):
        camera.set_window(None)
    aperture.close()
    stage.wait_ms(aperture.opening_ms)
    if isinstance(camera, Biases):
        camera.apply_biases(BiasSet.EXPOSE)
    stage.wait_ms(DARK_MS)
    stage.learn_time()

    stamp = aperture.open()
    first = FirstEventMap(camera.geometry, begin_us=stage.sensor_clock.to_sensor(stamp.begun_ns))
    until = after_ms(stamp.begun_ns, AFTER_FACTOR * aperture.opening_ms + DARK_MS)

    stage.listener = first.add_packet
    try:
        while stage.now_ns() < until:
            stage.read()
        stage.hear(CAMERA_SILENCE_MS)
    finally:
        stage.listener = None
    if first.n_on == 0:
        return None, (False, "no pixel saw light while the aperture opened; is the lens cap on, the aperture stuck?")
    profile = {"profile": aperture.transmittance, "linear": linear, "iris": iris}[transmittance]
    times = first.believed()
    try:
        picture = temporal_image(times, profile)
    except UsageError as error:
        return None, (False, str(error))
    first_us = times.times_us[~(times.hot | times.unfired)]
    open_until_us = picture.open_us - times.begin_us + 1000.0 * aperture.opening_ms
    late = float((first_us > open_until_us).mean()) if first_us.size else 0.0
    if late > LATE_LIMIT:
        reason = (
            f"{late:.0%} of the pixels first saw light later than the {aperture.opening_ms:.0f} ms that the aperture "
            f"takes to open (limit {LATE_LIMIT:.0%}); is it slow or sticking? tell how long it takes"
        )
        return picture, (False, reason)
    return picture, quality(picture)
