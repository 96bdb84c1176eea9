"""`elpd status`: how the daemon and its rig are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import daemon_options, reach

if TYPE_CHECKING:
    from collections.abc import Iterator

    from elpd.client.shapes import CameraStatus, FocusAnswer, LensStatus, RoiBox, Status

EXIT_CODES = {"READY": 0, "FOCUSING": 0, "FAULT": 3, "STARTING": 4, "STOPPING": 4}


@click.command("status")
@daemon_options
def command(*, as_json: bool, **where: Any) -> int:
    """Tell how the rig is: exit 0 ready or focusing, 3 a fault is latched, 4 no daemon, or one coming or going."""
    status = reach(**where).status()
    if as_json:
        print_json(dict(status))
    else:
        for name, text in told(status):
            print(f"{name:10s}{text}".rstrip())
    return EXIT_CODES.get(status["state"], 4)


def told(status: Status) -> Iterator[tuple[str, str]]:
    """Yield (what, how it is), for people."""
    phase = f", {status['phase']}" if status["phase"] and status["state"] == "FOCUSING" else ""
    yield "elpd", f"{status['state']}{phase}   {status['mode']}   {status['rig']}   up {_span(status['uptime_s'])}"
    if status["fault"] is not None:
        yield "fault", f"{status['fault']['kind']}: {status['fault']['message']}; `elpd clear` once that is mended"
    yield "lens", _lens(status["lens"])
    yield "camera", _camera(status["camera"])
    if status["aperture"] is not None:
        yield "aperture", status["aperture"]["driver"]
    yield "region", _region(status["roi"])
    yield "last", "none yet" if status["last"] is None else _last(status["last"])
    holder = status["lease"]["holder"]
    if holder is not None:
        until_s = status["lease"]["until_s"]
        yield "lease", f"{holder['name']} (process {holder['pid']}, user {holder['uid']}) for {until_s:.0f} s more"
    for warning in status["warnings"]:
        yield "warning", warning["text"]
    counts = status["counters"]
    missed = sum(counts["not_focused"].values())
    yield "cycles", f"{counts['focused']} focused, {missed} not, {counts['cancelled']} cancelled"
    yield "", f"{counts['faults']} faults, {counts['refused']} requests refused"
    yield "clients", f"{counts['clients']} ({counts['dropped_clients']} dropped, {counts['dropped_events']} events)"
    for stage, latency in status["latency"].items():
        p50, p99, most = (_time(us) for us in (latency["p50_us"], latency["p99_us"], latency["max_us"]))
        yield "latency", f"{stage:16s}p50 {p50}   p99 {p99}   max {most}"
    late = {loop: age_s for loop, age_s in status["ticks"].items() if age_s > 1.0}
    for loop, age_s in late.items():
        yield "late", f"the {loop} loop last moved {age_s:.1f} s ago"
    yield "process", f"version {status['version']}, {status['rss_mb']:.0f} MB"


def _lens(lens: LensStatus) -> str:
    if not lens["connected"]:
        return f"{lens['driver']}, not connected"
    at = "position unknown" if lens["position_um"] is None else f"at {lens['position_um']:.2f} um"
    sigma = "" if lens["sigma_um"] is None else f" (sigma {lens['sigma_um']:.2f})"
    moving = {True: ", moving", False: ", at rest", None: ""}[lens["moving"]]
    known = "" if lens["referenced"] else ", unreferenced: `elpd home` first"
    limits = lens["limits_um"]
    travel = "" if limits is None else f", travel {limits[0]:.0f} to {limits[1]:.0f} um"
    return f"{lens['driver']} {at}{sigma}{moving}{travel}{known}"


def _camera(camera: CameraStatus) -> str:
    if not camera["connected"]:
        return f"{camera['driver']}, not connected"
    size = "" if camera["width"] is None else f" {camera['width']}x{camera['height']}"
    frames = " with frames" if camera["has_frames"] else ""
    rate = "" if camera["events_per_s"] is None else f", {camera['events_per_s'] / 1e6:.2f} Mev/s"
    warm = "" if camera["temperature_c"] is None else f", {camera['temperature_c']:.0f} degrees"
    behind = f", {camera['backlog']} packets behind" if camera["backlog"] else ""
    return f"{camera['driver']}{size}{frames}{rate}, {camera['events']} events, {camera['lost']} lost{behind}{warm}"


def _region(roi: RoiBox | None) -> str:
    return "proposed for each cycle" if roi is None else f"{roi['x']},{roi['y']},{roi['width']},{roi['height']}"


def _last(last: FocusAnswer) -> str:
    at = "" if last["final_um"] is None else f", lens at {last['final_um']:.2f} um"
    sigma = "" if last["sigma_um"] is None else f" (sigma {last['sigma_um']:.2f})"
    run = "" if last["run"] is None else f", run {last['run']}"
    return f"{last['outcome']} in {last['duration_ms']:.0f} ms{at}{sigma}{run}"


def _time(us: float) -> str:
    return f"{us / 1e3:.2f} ms" if us >= 1e3 else f"{us:.0f} us"


def _span(seconds: float) -> str:
    minutes, hours, days = seconds // 60, seconds // 3600, seconds // 86400
    if days:
        return f"{days:.0f} d {hours % 24:.0f} h"
    if hours:
        return f"{hours:.0f} h {minutes % 60:.0f} min"
    return f"{minutes:.0f} min {seconds % 60:.0f} s" if minutes else f"{seconds:.0f} s"
