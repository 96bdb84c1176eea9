"""Whole cycles through the unmodified neuromorphic-drivers: a simulated scene's words over the emulated USB."""

from __future__ import annotations

import json
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner
from elpd_drivers.cameras import neuromorphic
from elpd_drivers.cameras.words import STEP_BACK_US
from elpd_drivers.sim.boards import avr
from elpd_drivers.sim.camera import LATENCY_US, SimulatedCamera
from elpd_drivers.sim.controllers import Wanted, controller
from elpd_drivers.sim.rig import SimSettings, SimulatedTruth
from hardware_emulation import usbfs
from hardware_emulation.evk4 import BIAS_DIFF_ON, Evk4
from hardware_emulation.lockstep import PtyPort, UsbCamera
from marks import ADAPTER_NS, CRUISE_SPS, worst_at_speed
from scenarios import SMALL

from elpd import rig
from elpd.cli import replay as replay_command
from elpd.config import load
from elpd.focus.settings import FocusRequest
from elpd.record.session import Session, focus_on
from elpd.records import Outcome, Roi
from elpd.timebase import MonotonicClock

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from elpd.config import Config
    from elpd.ports import RigParts

pytest.importorskip("neuromorphic_drivers")
pytestmark = [
    pytest.mark.xdist_group("usb"),
    pytest.mark.skipif(usbfs.missing() is not None, reason=str(usbfs.missing())),
]

PATIENCE_S = 120.0
UNMARKED_STEPS = ADAPTER_NS / 1e9 * CRUISE_SPS
"""What the driver is wrong by at speed when no mark comes."""

REGION = Roi(80, 60, 160, 120)
CAMERA = {
    "serial": "00050567",
    "max_delay_ms": 0,
    "open_timeout_s": PATIENCE_S,
    "hang_ms": 1e3 * PATIENCE_S,
    "min_latency_us": LATENCY_US + STEP_BACK_US,
    "biases": {"expose": {"diff_on": 7}, "focus": {"diff_on": 3}},
}


@dataclass(frozen=True)
class Lockstep:
    """A rig, and what its words and bytes go through."""

    parts: RigParts
    config: Config
    camera: UsbCamera
    evk4: Evk4


@contextmanager
def lockstep(folder: Path, *overrides: str) -> Iterator[Lockstep]:
    """Build a simulated rig whose camera is the emulated EVK4."""
    config = load(None, [*SMALL, "journal.enabled=true", f"journal.directory={folder}", *overrides])
    with usbfs.Bus() as bus, pytest.MonkeyPatch.context() as patch:
        for name, value in bus.environment.items():
            patch.setenv(name, value)
        evk4 = Evk4()
        bus.plug(evk4)
        captured = neuromorphic.open_camera(CAMERA, MonotonicClock())
        try:
            parts = rig.build(config)
            assert isinstance(parts.camera, SimulatedCamera)
            camera = UsbCamera(parts.camera, evk4, captured)
            yield Lockstep(replace(parts, camera=camera), config, camera, evk4)
        finally:
            captured.close()


def truth_of(parts: RigParts) -> SimulatedTruth:
    assert isinstance(parts.truth, SimulatedTruth)
    return parts.truth


def focused(made: Lockstep) -> Session:
    return focus_on(made.parts, made.config, FocusRequest(roi=REGION))


def replays(session: Session) -> bool:
    answer = CliRunner().invoke(replay_command.command, [str(session.run), "--json"], standalone_mode=False)
    assert answer.exception is None, answer.exception
    told = json.loads(answer.stdout)
    assert told["first_difference"] is None
    return bool(told["identical"])


def test_a_cycle_over_usb_and_pty_ends_in_focus_and_replays(tmp_path: Path) -> None:
    with lockstep(tmp_path, "sim.board=tic", "sim.seed=21") as made:
        truth = truth_of(made.parts)
        line = PtyPort(truth.port.wire, truth.world)
        known = SimSettings()
        wanted = Wanted(known.um_per_step, known.travel_um, 3 * known.speed_um_s, known.acceleration_um_s2)
        tic = controller("tic")
        lens = tic.open_lens(tic.table(wanted), truth.world, line)
        truth._lens = lens
        try:
            session = focused(replace(made, parts=replace(made.parts, lens=lens)))
        finally:
            lens.close()
        assert session.result.outcome is Outcome.FOCUSED
        assert abs(truth.carriage_error_um()) < 3.0
        assert made.camera.sent_bytes > 100_000
        assert line.written > 200
        assert line.read > 200
        assert made.evk4.registers[BIAS_DIFF_ON] & 0xFF == 3
    assert replays(session)


@pytest.mark.skipif(avr.hindrance() is not None, reason=str(avr.hindrance()))
def test_trigger_words_in_the_stream_reach_the_lens_as_position_marks(tmp_path: Path) -> None:
    """Edges are encoded between the events, cross the USB undecoded, and tell the driver where its lens is."""
    with lockstep(tmp_path, "sim.board=avr", "sim.seed=11", "sim.sync_steps=64") as made:
        truth_of(made.parts).port.wire._latency_ns = ADAPTER_NS
        session = focused(made)
        assert session.result.outcome is Outcome.FOCUSED
        assert not any("trigger input" in warning for warning in session.result.warnings)
        assert worst_at_speed(made.parts) < UNMARKED_STEPS / 10
        assert made.evk4.listening
    assert session.run is not None
    marks = [line for line in (session.run / "tape.jsonl").read_text().splitlines() if '"call":"lens.mark"' in line]
    believed = sum('"answer":true' in line for line in marks)
    assert believed > 0.9 * len(marks) > 10
    assert replays(session)
