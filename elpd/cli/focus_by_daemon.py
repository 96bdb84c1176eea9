"""`elpd focus` by the daemon: the same request, the same view, the same answer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from elpd.cli.daemon import ask
from elpd.records import ElpSample, FocusResult, Outcome, PhaseTime

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.cli.view import View
    from elpd.client import Client
    from elpd.records import Roi

RATE_HZ = 200.0
"""Samples a second: what a curve in a terminal can show."""


def focus_by(
    client: Client, *, roi: Roi | None, reference: str | None, preset: str | None, dry_run: bool, view: View | None
) -> dict[str, Any]:
    """Run one cycle by the daemon, shown in *view*; return the fields of `elpd focus --json`."""
    params: dict[str, Any] = {"dry_run": dry_run}
    if roi is not None:
        params["roi"] = {"x": roi.x, "y": roi.y, "width": roi.width, "height": roi.height}
    if reference is not None:
        params["reference"] = reference if reference == "last" else str(Path(reference).resolve())
    if preset is not None:
        params["preset"] = preset
    if view is not None:
        asked = {"events": ["phase", "sample"], "rate_hz": RATE_HZ}
        client.begin("subscribe", asked, _shown_in(view)).result(client.timeout_s)
    fields: dict[str, Any] = ask(client, "focus", params)
    if view is not None:
        view.result(_result(fields))
    if fields.get("truth") is None:
        fields.pop("truth", None)
    return fields


def _shown_in(view: View) -> Callable[[dict[str, Any]], None]:
    def show(event: dict[str, Any]) -> None:
        if event["event"] == "phase":
            progress = event["progress"]
            view.phase(event["phase"], **({} if progress is None else {"progress": progress}))
        elif event["event"] == "sample":
            at_um = event["position_um"]
            position_um = float("nan") if at_um is None else at_um
            window = ElpSample(event["t_us"], event["t_us"], event["elp"], 0, event["events"], 0, 0, position_um)
            view.sample(window, event["score"] or 0.0)

    return show


def _result(fields: dict[str, Any]) -> FocusResult:
    names = (
        "reason", "reversals", "focus_um", "sigma_um", "stop_um", "final_um", "stop_latency_us", "duration_ms",
        "events", "lost",
    )  # fmt: skip
    return FocusResult(
        outcome=Outcome(fields["outcome"]),
        phases=tuple(PhaseTime(phase["name"], phase["ms"]) for phase in fields["phases"]),
        **{name: fields[name] for name in names},
    )
