"""An adapter whose latency timer nobody has set: focus is found all the same, and the person is told."""

from __future__ import annotations

import pytest
from elpd_drivers.sim.rig import SimulatedTruth
from scenarios import SMALL

from elpd import rig
from elpd.config import load
from elpd.focus.settings import FocusRequest
from elpd.record.session import focus_on
from elpd.records import Outcome


@pytest.mark.parametrize("board", ["tic", "grbl", "tmcl", "zaber"])
def test_replies_that_are_kept_back_cost_no_focus_and_are_told(board: str) -> None:
    config = load(None, [*SMALL, f"sim.board={board}", "sim.seed=11"])
    parts = rig.build(config)
    assert isinstance(parts.truth, SimulatedTruth)
    parts.truth.port.faults.latency_timer_ns = 16_000_000
    session = focus_on(parts, config, FocusRequest())
    assert session.result.outcome is Outcome.FOCUSED
    assert any("latency timer" in warning for warning in session.result.warnings)
    assert session.truth is not None
    assert abs(session.truth["final_error_um"] or 0.0) < config.sim.depth_of_focus_um / 2
