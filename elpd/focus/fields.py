"""A result as its stable JSON fields."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from elpd.records import FocusResult


def result_fields(result: FocusResult) -> dict[str, Any]:
    """Return the stable JSON fields of a result (tools/docs/json.md), with its details beside them."""
    return {
        "outcome": result.outcome.value,
        "reason": result.reason,
        "reversals": result.reversals,
        "focus_um": result.focus_um,
        "sigma_um": result.sigma_um,
        "stop_um": result.stop_um,
        "final_um": result.final_um,
        "stop_latency_us": result.stop_latency_us,
        "duration_ms": result.duration_ms,
        "phases": [{"name": phase.name, "ms": phase.ms} for phase in result.phases],
        "events": result.events,
        "lost": result.lost,
        "warnings": list(result.warnings),
        "depths_um": list(result.depths_um),
        "details": result.details,
    }
