"""Position marks on the camera's trigger input: the events' own clock says where the lens was."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from elpd_drivers.sim.boards import avr
from elpd_drivers.sim.rig import SimulatedTruth
from scenarios import SMALL

from elpd import rig
from elpd.config import load
from elpd.errors import ConfigError
from elpd.focus.cycle import FocusCycle
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.records import FocusResult, Outcome
from elpd.units import NS_PER_MS, HostNs

if TYPE_CHECKING:
    from elpd.ports import RigParts

pytestmark = pytest.mark.skipif(avr.hindrance() is not None, reason=str(avr.hindrance()))
CRUISE_SPS = 12_000.0
ADAPTER_NS = 400_000
"""How long the adapter takes to pass a command on, which nobody has told the driver."""


class Listener:
    def note(self, event: str, /, **fields: Any) -> None:
        pass


def focus(*overrides: str) -> tuple[RigParts, FocusResult]:
    config = load(None, [*SMALL, "sim.board=avr", "sim.seed=11", *overrides])
    parts = rig.build(config)
    assert isinstance(parts.truth, SimulatedTruth)
    parts.truth.port.wire._latency_ns = ADAPTER_NS
    return parts, FocusCycle(parts, CycleSettings.from_config(config), FocusRequest(), Listener()).run()


def worst_at_speed(parts: RigParts) -> float:
    """Return the largest error of the lens's own position, in steps, while it swept at its full speed."""
    assert isinstance(parts.truth, SimulatedTruth)
    motor, now = parts.truth.mechanism, parts.clock.now_ns()
    worst = 0.0
    for ms in range(30, 215):
        when = HostNs(now - ms * NS_PER_MS)
        around = np.array([when - NS_PER_MS, when, when + NS_PER_MS])
        true = motor.motor_steps(around)
        if abs(true[2] - true[1]) > CRUISE_SPS / 1000 and abs(true[1] - true[0]) > CRUISE_SPS / 1000:
            worst = max(worst, abs(parts.lens.position_at(when).steps - float(true[1])))
    return worst


@pytest.mark.parametrize("camera", ["evk4", "davis346"])
def test_with_marks_an_unknown_latency_does_not_matter(camera: str) -> None:
    plain, first = focus(f"sim.camera={camera}")
    marked, second = focus(f"sim.camera={camera}", "sim.sync_steps=64")
    assert first.outcome is second.outcome is Outcome.FOCUSED
    assert not any("trigger input" in warning for warning in second.warnings)
    assert worst_at_speed(plain) > 1.0
    assert worst_at_speed(marked) < 0.2


def test_a_wire_that_is_off_is_told_and_does_no_harm() -> None:
    parts, result = focus("sim.sync_steps=64", "sim.sync_cut=true")
    assert result.outcome is Outcome.FOCUSED
    assert any("check that wire" in warning for warning in result.warnings)
    assert parts.truth is not None
    assert abs(parts.truth.errors(result)["final_error_um"] or 0.0) < 3.0


def test_a_board_without_the_line_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no sync line; sim\.board=avr has"):
        rig.build(load(None, ["sim.board=tic", "sim.sync_steps=64"]))
