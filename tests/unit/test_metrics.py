"""Metrics as Prometheus itself parses them: its own parser reads what a status becomes."""

from __future__ import annotations

from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from elpd.service.messages import StateName, Status
from elpd.service.metrics import exposition

AT_REST: dict[str, Any] = {
    "state": "READY",
    "mode": "one-shot",
    "phase": None,
    "fault": None,
    "lens": {"driver": "tic", "connected": True, "position_um": 1500.0, "sigma_um": 0.25, "referenced": False},
    "camera": {"driver": "davis", "connected": False, "events": 10**9 + 1},
    "aperture": None,
    "roi": None,
    "lease": {"holder": None, "until_s": 0.0},
    "last": None,
    "warnings": [{"code": "no-realtime", "text": "..."}],
    "counters": {"requests": 7, "focused": 3, "not_focused": {"NO_CROSSING": 2, "DEADLINE": 1}},
    "latency": {"read": {"p50_us": 20.0, "p99_us": 116.0, "max_us": 5500.0}},
    "ticks": {"engine": 0.01, "api": 0.02},
    "uptime_s": 12.5,
    "rss_mb": 123.0,
    "version": "0.1.0",
    "rig": "hardware",
}
LAST = {
    "outcome": "FOCUSED", "reason": "-", "reversals": 0, "focus_um": 951.5, "sigma_um": 1.25, "stop_um": 1000.0,
    "final_um": 951.6, "stop_latency_us": 170, "duration_ms": 228.0, "phases": [], "events": 5, "lost": 0,
}  # fmt: skip


def parsed(**changes: Any) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    text = exposition(Status.model_validate(AT_REST | changes))
    found = {}
    for family in text_string_to_metric_families(text):
        assert family.documentation, family.name
        assert family.type in {"gauge", "counter"}, family.name
        for sample in family.samples:
            key = (sample.name, tuple(sorted(sample.labels.items())))
            assert key not in found, key
            found[key] = sample.value
    return found


def value(found: dict[Any, float], name: str, **labels: str) -> float | None:
    return found.get((f"elpd_{name}", tuple(sorted(labels.items()))))


def test_numbers_arrive_in_base_units() -> None:
    found = parsed(last=LAST)
    assert value(found, "lens_position_metres") == pytest.approx(1.5e-3)
    assert value(found, "camera_events_total") == 10**9 + 1
    assert value(found, "resident_memory_bytes") == 123e6
    assert value(found, "stage_latency_seconds", stage="read", quantile="0.99") == pytest.approx(116e-6)
    assert value(found, "last_cycle_focus_metres") == pytest.approx(951.5e-6)
    assert value(found, "last_cycle_focused") == 1
    assert value(found, "info", version="0.1.0", rig="hardware", lens="tic", camera="davis", aperture="") == 1


def test_what_is_unknown_is_left_out() -> None:
    found = parsed()
    names = {name for name, _ in found}
    assert "elpd_camera_temperature_celsius" not in names
    assert "elpd_lens_moving" not in names
    assert value(found, "lens_referenced") == 0
    assert not any(name.startswith("elpd_last_cycle") for name in names)


def test_cycles_are_counted_by_outcome() -> None:
    found = parsed()
    assert value(found, "cycles_total", outcome="FOCUSED") == 3
    assert value(found, "cycles_total", outcome="NO_CROSSING") == 2
    assert value(found, "cycles_total", outcome="DEADLINE") == 1


@pytest.mark.parametrize("state", get_args(StateName))
def test_one_state_is_set(state: str) -> None:
    found = parsed(state=state)
    assert {name: value(found, "state", state=name) for name in get_args(StateName)} == {
        name: float(name == state) for name in get_args(StateName)
    }


def test_a_fault_has_a_name() -> None:
    found = parsed(fault={"kind": "LensError", "message": "-", "at_s": 0.0})
    assert value(found, "fault", kind="LensError") == 1
    assert value(parsed(), "fault", kind="") == 0


@given(st.text(st.characters(exclude_categories=["Cs"]), max_size=20), st.floats(allow_nan=True, allow_infinity=True))
def test_no_name_and_no_number_breaks_the_format(name: str, number: float) -> None:
    name = " ".join(name.split())  # Prometheus' own parser splits lines at every Unicode line break
    found = parsed(rig=name, ticks={name: number})
    told = value(found, "loop_age_seconds", loop=name)
    assert told == pytest.approx(number, nan_ok=True)
