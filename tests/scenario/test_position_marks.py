"""Position marks on the camera's trigger input: the events' own clock says where the lens was."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from elpd_drivers.sim.boards import avr
from elpd_drivers.sim.camera import SimulatedCamera
from elpd_drivers.sim.rig import SimulatedTruth
from marks import ADAPTER_NS, worst_at_speed
from scenarios import SMALL
from through_backends import through_davis, through_metavision

from elpd import rig
from elpd.config import load
from elpd.errors import ConfigError
from elpd.focus.cycle import FocusCycle
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.records import FocusResult, Outcome

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.ports import RigParts

pytestmark = pytest.mark.skipif(avr.hindrance() is not None, reason=str(avr.hindrance()))


class Listener:
    def note(self, event: str, /, **fields: Any) -> None:
        pass


def focus(*overrides: str, through: Callable[[SimulatedCamera], Any] | None = None) -> tuple[RigParts, FocusResult]:
    config = load(None, [*SMALL, "sim.board=avr", "sim.seed=11", *overrides])
    parts = rig.build(config)
    assert isinstance(parts.truth, SimulatedTruth)
    if through is not None:
        assert isinstance(parts.camera, SimulatedCamera)
        parts = replace(parts, camera=through(parts.camera))
    parts.truth.port.wire._latency_ns = ADAPTER_NS
    return parts, FocusCycle(parts, CycleSettings.from_config(config), FocusRequest(), Listener()).run()


@pytest.mark.parametrize("camera", ["evk4", "davis346"])
def test_with_marks_an_unknown_latency_does_not_matter(camera: str) -> None:
    plain, first = focus(f"sim.camera={camera}")
    marked, second = focus(f"sim.camera={camera}", "sim.sync_steps=64")
    assert first.outcome is second.outcome is Outcome.FOCUSED
    assert not any("trigger input" in warning for warning in second.warnings)
    assert worst_at_speed(plain, first) > 1.0
    assert worst_at_speed(marked, second) < 0.2


@pytest.mark.parametrize(
    ("camera", "through"), [("evk4", through_metavision), ("davis346", through_davis)], ids=["metavision", "davis"]
)
def test_edges_of_a_live_backend_reach_the_lens_as_marks(
    camera: str, through: Callable[[SimulatedCamera], Any]
) -> None:
    marked, result = focus(f"sim.camera={camera}", "sim.sync_steps=64", through=through)
    assert result.outcome is Outcome.FOCUSED
    assert not any("trigger input" in warning for warning in result.warnings)
    assert worst_at_speed(marked, result) < 0.2


def test_a_wire_that_is_off_is_told_and_does_no_harm() -> None:
    parts, result = focus("sim.sync_steps=64", "sim.sync_cut=true")
    assert result.outcome is Outcome.FOCUSED
    assert any("check that wire" in warning for warning in result.warnings)
    assert parts.truth is not None
    assert abs(parts.truth.errors(result)["final_error_um"] or 0.0) < 3.0


def test_a_board_without_the_line_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no sync line; sim\.board=avr has"):
        rig.build(load(None, ["sim.board=tic", "sim.sync_steps=64"]))
