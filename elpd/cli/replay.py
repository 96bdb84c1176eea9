"""`elpd replay`: run a recorded cycle again, to the same decision."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from elpd.cli.common import config_options, json_option, print_json, run_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from elpd.focus.settings import FocusRequest
    from elpd.ports import RigParts, RunSink
    from elpd.record.replay import RecordedRun, ReplayReport


@click.command("replay")
@click.argument("run", type=click.Path(path_type=Path))
@config_options
@json_option
def command(*, run: Path, config_path: Path | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Run the recorded cycle RUN again: exit 0 if it is identical byte for byte, 1 if not.

    RUN is a folder that a cycle wrote, or a name that `elpd runs` lists, of the folder journal.directory. No device is
    touched and nothing is written.
    """
    from elpd.config import load  # noqa: PLC0415
    from elpd.record.replay import load_run, replay_run  # noqa: PLC0415  (numpy and numba only now)

    config = load(config_path, overrides)  # says where runs lie; the cycle runs by the one it was recorded with
    recorded = load_run(run_folder(run, config))
    report = replay_run(recorded, run_cycle)
    if as_json:
        print_json(_fields(recorded, report))
    else:
        _tell(recorded, report)
    return 0 if report.identical else 1


def run_cycle(parts: RigParts, run: RecordedRun, sink: RunSink, cancelled: Callable[[], int]) -> Mapping[str, Any]:
    """Build the cycle that *run* recorded from what is in its folder, and run it on *parts*."""
    from elpd.config import Config  # noqa: PLC0415
    from elpd.focus.cycle import FocusCycle  # noqa: PLC0415
    from elpd.focus.fields import result_fields  # noqa: PLC0415
    from elpd.focus.settings import CycleSettings  # noqa: PLC0415

    settings = CycleSettings.from_config(Config.model_validate(run.config))
    cycle = FocusCycle(parts, settings, _request(run), sink, None, cancelled)
    return result_fields(cycle.run())


def _request(run: RecordedRun) -> FocusRequest:
    from elpd.focus.settings import FocusRequest  # noqa: PLC0415
    from elpd.records import Roi, SensorProfile  # noqa: PLC0415

    asked = FocusRequest(**run.request)
    sensor = None
    if asked.sensor is not None:
        known = dict(run.request["sensor"])
        known["hot_pixels"] = tuple((x, y) for x, y in known["hot_pixels"])
        # Older runs noted more of the calibration than a cycle ever read.
        sensor = SensorProfile(**{one.name: known[one.name] for one in fields(SensorProfile) if one.name in known})
    roi = Roi(**run.request["roi"]) if asked.roi else None
    return replace(asked, roi=roi, reference=run.attachment("reference"), sensor=sensor)


def _fields(run: RecordedRun, report: ReplayReport) -> dict[str, Any]:
    """Return the fields of `elpd focus` as replayed, then how they compare."""
    fields: dict[str, Any] = dict(report.result) if report.result is not None else {"outcome": None}
    if report.error is not None:
        fields["error"] = report.error
    if report.identical and run.truth is not None:
        fields["truth"] = run.truth
    return fields | {
        "run": str(run.path),
        "identical": report.identical,
        "first_difference": report.first_difference,
        "calls": report.calls,
    }


def _tell(run: RecordedRun, report: ReplayReport) -> None:
    ending = report.error["kind"] if report.error else (report.result or {}).get("outcome")
    reason = report.error["message"] if report.error else (report.result or {}).get("reason")
    print(f"{ending}: {reason}")
    if report.identical:
        print(f"identical: every decision and {report.calls} device calls, byte for byte")
    else:
        print(f"not identical; first difference: {report.first_difference}")
        print(f"recorded by elpd {run.elpd} in {run.path}")
