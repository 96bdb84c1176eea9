"""A sensor's calibration on a rig: focus, expose, then take the evidence around focus.

Whatever goes wrong on the way, the lens does not keep moving. Not finding focus is no error: noise can be measured
without it, and what cannot says why.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from elpd.calibrate.capture import Capture
from elpd.calibrate.evidence import Evidence
from elpd.focus.cycle import FocusCycle
from elpd.focus.expose import AFTER_FACTOR, expose
from elpd.focus.picture import Picture
from elpd.focus.settings import FocusRequest
from elpd.focus.stage import REST_LIMIT_MS, Stage
from elpd.ports import HardwareRoi
from elpd.records import Outcome, Roi, StopMode

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from elpd.focus.settings import CycleSettings
    from elpd.ports import RigParts

FRAME_LIMIT_MS = 500.0

NEAR_ENOUGH_DOF = 4.0
"""Standard error of the focus around which the lens then goes to and fro: it must be on the way, not in its middle."""

DOUBT_OF_FRAME = 0.3
"""Relative error of the slowness that a frame gives: its black level and its clipping are not known."""

DOUBT_OF_MAP = 0.5
"""The same of a temporal map: it has bright and dark in order, but stretched."""


class _Nowhere:
    """A calibration's focus cycle is not journalled."""

    def note(self, event: str, /, **fields: Any) -> None:
        """Forget it."""


def take_evidence(
    parts: RigParts,
    settings: CycleSettings,
    *,
    rest_s: float,
    reach_um: float,
    here: bool,
    black: float | None = None,
    sweeps_alone: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> Evidence:
    """Focus, and collect everything that a sensor's calibration looks at.

    Parameters
    ----------
    rest_s:
        How long noise is watched.
    reach_um:
        How far the lens goes to either side.
    here:
        Do not focus first: the lens stands in focus already.
    black:
        Grey level of darkness in this camera's frames, where it is known.
    sweeps_alone:
        Neither rest nor pictures: what the lens's play takes. Without focus there is nothing to take then.

    Raises
    ------
    UsageError
        Where the lens has no room around focus.
    DeviceError
        Broken machinery; the strongest stop has been sent.

    """
    try:
        why = None
        if not here:
            progress("focus")
            near = replace(settings, max_sigma_dof=NEAR_ENOUGH_DOF)
            found = FocusCycle(parts, near, FocusRequest(), _Nowhere()).run()
            why = None if found.outcome is Outcome.FOCUSED else f"focus was not found first: {found.reason}"
        parts.camera.start()
        try:
            if isinstance(parts.camera, HardwareRoi):
                parts.camera.set_window(None)
            stage = Stage(parts)
            stage.rest(REST_LIMIT_MS)
            capture = Capture(
                stage,
                speed_um_s=settings.speed_um_s,
                depth_of_focus_um=settings.depth_of_focus_um,
                reach_um=reach_um,
                progress=progress,
            )
            if sweeps_alone:
                if why is not None:
                    return Evidence(parts.camera.geometry, missing={"sweeps": why})
                if here and parts.aperture is not None:
                    parts.aperture.open()
                    stage.wait_ms(AFTER_FACTOR * parts.aperture.opening_ms)
                return capture.sweeps_alone()
            if why is not None:
                return capture.rest_alone(rest_s, {"sweeps": why, "steps": why})
            doubt = DOUBT_OF_FRAME if parts.aperture is None else DOUBT_OF_MAP
            return capture.take(rest_s, _brightness(stage, settings), doubt, black)
        finally:
            parts.camera.stop()
    except BaseException:  # whatever it was, no lens is left running
        parts.lens.stop(StopMode.ABRUPT)
        raise


def _brightness(stage: Stage, settings: CycleSettings) -> NDArray[np.float32] | None:
    """Return how bright each pixel is, by an opening aperture or by a frame; ``None`` where neither shows anything."""
    geometry = stage.parts.camera.geometry
    whole = Roi(0, 0, geometry.width, geometry.height)
    if stage.parts.aperture is not None:
        image, _ = expose(stage, settings.transmittance)
        return None if image is None else Picture.of_map(image).reference(whole).brightness
    stage.newest_frame(FRAME_LIMIT_MS)  # the first may have been exposed while the window was another
    frame = stage.newest_frame(FRAME_LIMIT_MS)
    return None if frame is None else Picture.of_frame(frame.pixels).reference(whole).brightness
