"""The status as Prometheus reads it: text exposition format 0.0.4, made from one snapshot.

Names end in their unit, in Prometheus' base units (metres, seconds, bytes); what is unknown is left out, because a zero
would be a claim. Counters count since the daemon began.
(https://prometheus.io/docs/instrumenting/exposition_formats)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

from elpd.service.messages import StateName

if TYPE_CHECKING:
    from collections.abc import Iterator

    from elpd.service.messages import Status

_UM, _US, _MS, _MB = 1e-6, 1e-6, 1e-3, 1e6

Kind = Literal["gauge", "counter"]
Sample = tuple[dict[str, str], float | None]


def exposition(status: Status) -> str:
    """Return the whole text, ending in a newline."""
    lines: list[str] = []
    for name, kind, help_text, samples in _families(status):
        known = [(labels, value) for labels, value in samples if value is not None]
        if known:
            lines += [f"# HELP elpd_{name} {help_text}", f"# TYPE elpd_{name} {kind}"]
            lines += [f"elpd_{name}{_labels(labels)} {float(value)!r}" for labels, value in known]
    return "\n".join(lines) + "\n"


def _families(status: Status) -> Iterator[tuple[str, Kind, str, list[Sample]]]:
    yield "info", "gauge", "What runs here.", [({"version": status.version, "rig": status.rig, **_drivers(status)}, 1)]
    states: list[Sample] = [({"state": name}, name == status.state) for name in get_args(StateName)]
    yield "state", "gauge", "1 for the state that the controller is in.", states
    fault: list[Sample] = [({"kind": status.fault.kind if status.fault else ""}, status.fault is not None)]
    yield "fault", "gauge", "1 while a fault is latched.", fault
    yield "uptime_seconds", "gauge", "Since the controller began.", _one(status.uptime_s)
    yield "resident_memory_bytes", "gauge", "Resident memory.", _one(status.rss_mb * _MB)
    ticks: list[Sample] = [({"loop": loop}, age_s) for loop, age_s in status.ticks.items()]
    yield "loop_age_seconds", "gauge", "Since each loop last showed that it lives.", ticks
    warnings: list[Sample] = [({"code": warned.code}, 1) for warned in status.warnings]
    yield "warning", "gauge", "1 for each warning that stands.", warnings
    yield from _devices(status)
    yield from _counters(status)
    yield from _last(status)
    latencies: list[Sample] = []
    for stage, found in status.latency.items():
        values = (("0.5", found.p50_us), ("0.99", found.p99_us), ("1", found.max_us))
        latencies += [({"stage": stage, "quantile": quantile}, value * _US) for quantile, value in values]
    yield "stage_latency_seconds", "gauge", "How long the stages of the loop take.", latencies


def _devices(status: Status) -> Iterator[tuple[str, Kind, str, list[Sample]]]:
    lens, camera = status.lens, status.camera
    connected: list[Sample] = [({"device": "lens"}, lens.connected), ({"device": "camera"}, camera.connected)]
    yield "connected", "gauge", "1 for a device that answers.", connected
    yield "lens_position_metres", "gauge", "Where the lens is, on its own ruler.", _one(_times(lens.position_um, _UM))
    yield "lens_position_sigma_metres", "gauge", "Standard error of that.", _one(_times(lens.sigma_um, _UM))
    yield "lens_moving", "gauge", "1 while the lens moves.", _one(lens.moving)
    yield "lens_referenced", "gauge", "1 where absolute positions mean something.", _one(lens.referenced)
    yield "camera_events_total", "counter", "Events received.", _one(camera.events)
    yield "camera_lost_events_total", "counter", "Events known to be lost.", _one(camera.lost)
    yield "camera_event_rate_hertz", "gauge", "Events per second now.", _one(camera.events_per_s)
    yield "camera_backlog_packets", "gauge", "Packets that wait to be read.", _one(camera.backlog)
    yield "camera_temperature_celsius", "gauge", "The sensor's own thermometer.", _one(camera.temperature_c)


def _counters(status: Status) -> Iterator[tuple[str, Kind, str, list[Sample]]]:
    counted = status.counters
    yield "requests_total", "counter", "Requests that were accepted.", _one(counted.requests)
    cycles: list[Sample] = [({"outcome": "FOCUSED"}, counted.focused)]
    cycles += [({"outcome": outcome}, count) for outcome, count in counted.not_focused.items()]
    yield "cycles_total", "counter", "Focus cycles by outcome.", cycles
    yield "faults_total", "counter", "Faults that were latched.", _one(counted.faults)
    yield "cancelled_total", "counter", "Requests that somebody cancelled.", _one(counted.cancelled)
    yield "refused_total", "counter", "Requests that were refused.", _one(counted.refused)
    yield "clients", "gauge", "Clients of the socket.", _one(counted.clients)
    yield "dropped_clients_total", "counter", "Clients that did not read.", _one(counted.dropped_clients)
    yield (
        "dropped_client_events_total",
        "counter",
        "Events that clients were too slow for.",
        _one(counted.dropped_events),
    )


def _last(status: Status) -> Iterator[tuple[str, Kind, str, list[Sample]]]:
    last = status.last
    if last is None:
        return
    yield "last_cycle_focused", "gauge", "1 where the last cycle ended in focus.", _one(last.outcome == "FOCUSED")
    yield "last_cycle_duration_seconds", "gauge", "Of the last cycle.", _one(last.duration_ms * _MS)
    yield "last_cycle_focus_metres", "gauge", "Where the last cycle found focus.", _one(_times(last.focus_um, _UM))
    yield "last_cycle_sigma_metres", "gauge", "Standard error of that.", _one(_times(last.sigma_um, _UM))
    latency_s = _times(last.stop_latency_us, _US)
    yield "last_cycle_stop_latency_seconds", "gauge", "From decision to standstill.", _one(latency_s)


def _drivers(status: Status) -> dict[str, str]:
    aperture = "" if status.aperture is None else status.aperture.driver
    return {"lens": status.lens.driver, "camera": status.camera.driver, "aperture": aperture}


def _one(value: float | None) -> list[Sample]:
    return [({}, value)]


def _times(value: float | None, unit: float) -> float | None:
    return None if value is None else value * unit


def _labels(labels: dict[str, str]) -> str:
    if not labels:
        return ""
    return "{" + ",".join(f'{name}="{_escaped(value)}"' for name, value in labels.items()) + "}"


def _escaped(value: str) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
