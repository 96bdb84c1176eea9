"""What a cycle looks at: where its picture comes from, and the region of it that is focused on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from elpd.errors import UsageError
from elpd.focus.ended import Ended
from elpd.focus.expose import AFTER_FACTOR, expose
from elpd.focus.picture import Picture
from elpd.records import Outcome, Phase, Roi
from elpd.vision.choose import propose_roi

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.focus.settings import CycleSettings, FocusRequest
    from elpd.focus.stage import Stage
    from elpd.ports import RunSink
    from elpd.records import Geometry, TemporalImage
    from elpd.vision.reference import Reference

FRAME_LIMIT_MS = 500.0
"""A camera with frames delivers one within this, or has none."""


class Scene:
    """Gets a picture and a region of it; *sink* hears of both, *enter* that a phase begins."""

    def __init__(
        self,
        stage: Stage,
        request: FocusRequest,
        settings: CycleSettings,
        sink: RunSink,
        enter: Callable[[Phase], None],
    ) -> None:
        self._stage = stage
        self._request = request
        self._settings = settings
        self._sink = sink
        self._enter = enter
        self.map: TemporalImage | None = None
        """The temporal map, once exposed, usable or not."""

    def picture(self) -> Picture:
        """Get a picture of the scene: a stored one, an opening aperture's, or the newest frame."""
        request, parts = self._request, self._stage.parts
        if request.reference is not None:
            picture = Picture.of_file(request.reference, parts.camera.geometry)
            if parts.aperture is not None:
                parts.aperture.open()
                self._stage.wait_ms(AFTER_FACTOR * parts.aperture.opening_ms)
            return picture
        if parts.aperture is None:
            frame = self._stage.newest_frame(FRAME_LIMIT_MS)
            if frame is None:
                raise UsageError(
                    "this camera delivers no frames and the rig has no aperture to expose with; "
                    "give --reference IMAGE, or configure an aperture"
                )
            return Picture.of_frame(frame.pixels)
        self._enter(Phase.EXPOSE)
        self.map, (good, reason) = expose(self._stage, self._settings.transmittance)
        if self.map is not None:
            self._sink.note(
                "map",
                fired_fraction=self.map.fired_fraction,
                hot_pixels=self.map.hot_pixels,
                open_us=int(self.map.open_us),
                dynamic_range_db=self.map.dynamic_range_db,
            )
        if self.map is None or not good:
            raise Ended(Outcome.NO_TEXTURE, reason)
        return Picture.of_map(self.map)

    def choose(self, picture: Picture, details: dict[str, Any]) -> tuple[Roi, Reference]:
        """Return the region, which *details* are told, and its weights. Raises ``Ended`` where there is no texture."""
        geometry = self._stage.parts.camera.geometry
        roi = self._request.roi
        if roi is None:
            side = round(self._settings.roi_fraction * min(geometry.width, geometry.height))
            roi = propose_roi(picture.log_image, picture.valid, (side, side))
        if roi is None:
            raise Ended(Outcome.NO_TEXTURE, "nothing in the picture has texture above its noise; aim at a subject")
        details["roi"] = [roi.x, roi.y, roi.width, roi.height]
        reference = picture.reference(roi)
        self._sink.note("roi", roi=details["roi"], texture=reference.texture, scale_px=reference.scale_px)
        if not reference.textured:
            raise Ended(
                Outcome.NO_TEXTURE,
                f"the picture shows no structure above its own noise in the ROI ({reference.texture:.1f} sigma, "
                "at least 6 are needed); choose another ROI or add light",
            )
        return roi, reference


def check_roi(roi: Roi, geometry: Geometry) -> None:
    """Raise ``UsageError`` for a region that does not lie inside the sensor or is too small."""
    if not roi.fits(geometry):
        raise UsageError(
            f"the ROI {roi.x},{roi.y},{roi.width},{roi.height} does not lie inside the sensor "
            f"({geometry.width}x{geometry.height}) or is empty; give X,Y,W,H inside it"
        )
    if min(roi.width, roi.height) < 8:
        raise UsageError(
            f"the ROI {roi.width}x{roi.height} is too small to hold texture (at least 8x8); draw a larger one"
        )


def widened(roi: Roi, margin_px: int, width: int, height: int) -> Roi:
    """Return *roi* grown by a margin on all sides, cut to the sensor."""
    left, top = max(0, roi.x - margin_px), max(0, roi.y - margin_px)
    right = min(width, roi.x + roi.width + margin_px)
    bottom = min(height, roi.y + roi.height + margin_px)
    return Roi(left, top, right - left, bottom - top)
