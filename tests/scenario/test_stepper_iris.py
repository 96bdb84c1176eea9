"""An EVK4 behind a stepper iris that the lens's own controller turns: measured, then exposed and focused with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from command_line import Answer, caller
from elpd_drivers.sim.aperture import StepperIris

from elpd.calibrate.aperture import CalibratedAperture
from elpd.config import load
from elpd.rig import build

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

STEPS, SPEED_SPS, DEAD_SHARE = 4800, 12_800.0, 0.05
RIG = ("sim.board=zaber", f"sim.iris_steps={STEPS}", "sim.seed=5", "journal.enabled=false")
WAY_US = 1e6 * STEPS / SPEED_SPS


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    call = caller(capsys, monkeypatch, tmp_path)

    def configured(*words: str, more: tuple[str, ...] = ()) -> Answer:
        keys = (*RIG, *more, f"state.directory={tmp_path}")
        return call(*words, "--json", *(word for key in keys for word in ("--set", key)))

    return configured


def test_a_stepper_iris_is_measured_and_the_next_cycle_exposes_by_what_was_found(
    elpd: Callable[..., Answer], tmp_path: Path
) -> None:
    card = ("sim.scene=flat", "sim.brightness=4.0", "sim.width=48", "sim.height=48")
    found = elpd("calibrate", "aperture", "--threshold", "0.18,0.01", "--openings", "2", more=card)
    assert found.code == 0, found.err
    parts = build(load(overrides=[*RIG, f"state.directory={tmp_path}", "sim.width=48", "sim.height=48"]))
    assert isinstance(parts.aperture, CalibratedAperture)
    opening, delay = parts.aperture.profile.opening_us, parts.aperture.profile.delay_us
    assert opening.value is not None
    assert delay.value is not None
    open_us = delay.value + opening.value
    assert open_us == pytest.approx((1 - DEAD_SHARE) * WAY_US, rel=0.03), "fully open before its motor is there"
    assert delay.value > DEAD_SHARE * WAY_US, "and nothing comes through the dead band"
    truth, measured = StepperIris(STEPS), parts.aperture.transmittance
    truth.turn(0, STEPS, SPEED_SPS)
    at_us = np.array([0.4, 0.6, 0.8]) * open_us
    light = truth.transmittance_at((at_us * 1e3).astype(np.int64))
    assert measured(at_us - delay.value) == pytest.approx(light, abs=0.05)
    scene = ("sim.scene=camera", "sim.width=320", "sim.height=240", "focus.roi_fraction=0.5")
    focused = elpd("focus", "--foreground", more=scene)
    assert focused.json["outcome"] == "FOCUSED", focused.json["reason"]
    assert abs(focused.json["truth"]["final_error_um"]) < 6.0
