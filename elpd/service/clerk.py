"""Small changes that need no device: regions, presets, the mode, a temperature, the lease. Answered on the spot."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from elpd.errors import UsageError
from elpd.service.messages import Preset, PresetAnswer, RoiAnswer, RoiBox

if TYPE_CHECKING:
    from elpd.service.autopilot import Autopilot
    from elpd.service.engine_port import Request
    from elpd.service.kept import Kept
    from elpd.service.lease import Lease
    from elpd.service.messages import PresetParams, Result, RoiParams
    from elpd.service.situation import Situation

SMALLEST_PX = 8
"""A region needs this many pixels each way to hold texture; a cycle refuses smaller ones."""

MOST_NAMES = 256
"""Presets or regions; a client in a loop must not fill the state file."""


class Clerk:
    """Keeps the books. Raises ``UsageError`` for what makes no sense."""

    def __init__(self, situation: Situation, kept: Kept, lease: Lease, autopilot: Autopilot) -> None:
        self._situation = situation
        self._kept = kept
        self._lease = lease
        self._autopilot = autopilot

    def answer(self, request: Request) -> Result:
        """Do what a request of one of these methods asks."""
        params: Any = request.params
        match request.method:
            case "roi":
                return self._roi(params)
            case "preset":
                return self._preset(params)
            case "mode":
                if params.model_fields_set:
                    self._autopilot.set_mode(params.mode, params.period_s)
                return self._autopilot.mode_answer()
            case "temperature":
                return self._autopilot.reading(params.celsius)
            case "lease":
                return self._lease.ask(params, request.caller)
        raise UsageError(f"there is no method {request.method!r}")

    def _roi(self, params: RoiParams) -> RoiAnswer:
        if params.delete:
            assert params.name is not None, "delete takes a name"
            self._kept.delete_roi(params.name)
        elif "set" in params.model_fields_set:
            box = None if params.set is None else self._clamped(params.set)
            if box is None and params.name is not None:
                raise UsageError("a region with a name has an area; to forget one, delete it")
            if len(self._kept.content.named) >= MOST_NAMES:
                raise UsageError(f"there are {MOST_NAMES} regions already; delete some")
            self._kept.set_roi(box, params.name)
            self._situation.set_roi(self._kept.roi)
        elif params.name is not None:
            named = self._kept.content.named.get(params.name)
            if named is None:
                raise UsageError(f"there is no region {params.name!r}; `roi` without parameters lists them")
            return RoiAnswer(roi=named, named=self._kept.content.named)
        return RoiAnswer(roi=self._kept.roi, named=self._kept.content.named)

    def _clamped(self, box: RoiBox) -> RoiBox:
        """Cut a region to the sensor, once the sensor is known."""
        camera = self._situation.camera
        if camera.width is None or camera.height is None:
            raise UsageError("no camera has told its size yet; set the region once it is connected")
        left, top = max(0, box.x), max(0, box.y)
        right, bottom = min(camera.width, box.x + box.width), min(camera.height, box.y + box.height)
        if right - left < SMALLEST_PX or bottom - top < SMALLEST_PX:
            raise UsageError(
                f"the region {box.x},{box.y},{box.width},{box.height} has less than {SMALLEST_PX}x{SMALLEST_PX} pixels "
                f"on the sensor ({camera.width}x{camera.height}); draw a larger one"
            )
        return RoiBox(x=left, y=top, width=right - left, height=bottom - top)

    def _preset(self, params: PresetParams) -> PresetAnswer:
        if params.action == "delete" and params.name is not None:
            self._kept.delete_preset(params.name)
        if params.action == "save" and params.name is not None:
            self._kept.save_preset(self._here(params.name))
        return PresetAnswer(presets=self._kept.presets())

    def _here(self, name: str) -> Preset:
        lens = self._situation.lens
        if lens.position_um is None or not lens.referenced or lens.moving:
            raise UsageError(f"preset {name!r}: the lens is not at rest at a place that it knows; home it, then save")
        if len(self._kept.content.presets) >= MOST_NAMES:
            raise UsageError(f"there are {MOST_NAMES} presets already; delete some")
        return Preset(
            name=name,
            position_um=lens.position_um,
            roi=self._kept.roi,
            approach=self._autopilot.arrived_from(lens.position_um),
            saved_at=datetime.now(UTC).isoformat(timespec="seconds"),
        )
