"""One cycle, whoever asks for it: record the run, focus, tell the truth where a simulator knows it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import structlog

from elpd import rig
from elpd.calibrate.in_use import as_measured
from elpd.calibrate.sensor import sensor_in_use
from elpd.focus import stored_map
from elpd.focus.cycle import FocusCycle, Observer
from elpd.focus.fields import result_fields
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.ports import Remarks
from elpd.record.journal import RunWriter
from elpd.records import Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from elpd.config import Config
    from elpd.ports import RigParts
    from elpd.records import FocusResult, TemporalImage
    from elpd.vision.sharpest import Sharpest


@dataclass(frozen=True, slots=True)
class Session:
    """What a cycle left behind."""

    result: FocusResult
    truth: dict[str, float | None] | None
    run: Path | None
    map: TemporalImage | None
    sharpest: Sharpest | None = None
    """The picture in focus, as a ruler for its loss, where the sweep has seen it."""
    delays: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """How old packets were, us, by stage."""

    @property
    def focused(self) -> bool:
        """Whether the lens rests in focus."""
        return self.result.outcome is Outcome.FOCUSED

    def fields(self) -> dict[str, Any]:
        """Return the JSON of `elpd focus`."""
        fields = result_fields(self.result)
        if self.truth is not None:
            fields["truth"] = self.truth
        fields["run"] = None if self.run is None else str(self.run)
        return fields


def focus_once(
    config: Config,
    request: FocusRequest,
    observer: Observer | None = None,
    cancelled: Callable[[], int] = lambda: False,
) -> Session:
    """Run one whole cycle on the rig that *config* describes, and give the rig back.

    Raises ``UsageError`` before anything moves, ``DeviceError`` after the lens has been told to stop.
    """
    parts = rig.build(config)
    try:
        return focus_on(parts, config, request, observer, cancelled)
    finally:
        rig.release(parts)


def focus_on(
    parts: RigParts,
    config: Config,
    request: FocusRequest,
    observer: Observer | None = None,
    cancelled: Callable[[], int] = lambda: False,
) -> Session:
    """Run one whole cycle on a rig that stays the caller's; raises what ``focus_once`` raises."""
    config = as_measured(config)  # what is recorded with the run is what was in force
    if request.reference is not None and request.reference.suffix == ".npz":
        here_um = parts.scale.to_um(parts.lens.position_at(parts.clock.now_ns()).steps)
        depth_of_focus_um = CycleSettings.from_config(config).depth_of_focus_um
        stored_map.load(request.reference).check(parts.camera.geometry, here_um, depth_of_focus_um, time.time())
    if request.sensor is None:
        request = replace(request, sensor=sensor_in_use(config, parts.camera))
    with RunWriter.begin(config, request, parts) as run:
        settings = CycleSettings.from_config(config)
        cycle = FocusCycle(run.parts, settings, request, run, observer, run.watch(cancelled))
        result = cycle.run()
        truth = None if parts.truth is None else parts.truth.errors(result)
        run.finish(result_fields(result), truth=truth)
    if isinstance(parts.lens, Remarks):  # about the line, not the cycle: a replay has none
        result = replace(result, warnings=(*result.warnings, *parts.lens.remarks))
    structlog.get_logger().info("focus cycle", **result_fields(result), truth=truth, run=run.path)
    ruler = cycle.sharpest(config.modes.defocus_dof) if result.outcome is Outcome.FOCUSED else None
    return Session(result, truth, run.path, cycle.map, ruler, cycle.delays)
