"""Whole cycles through the unmodified neuromorphic-drivers: a simulated scene's words over the emulated USB."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner
from elpd_drivers.cameras.words import STEP_BACK_US
from elpd_drivers.sim.boards import avr
from elpd_drivers.sim.camera import LATENCY_US, SimulatedCamera
from elpd_drivers.sim.controllers import Wanted, controller
from elpd_drivers.sim.rig import SimSettings, SimulatedTruth
from engines import Daemon
from hardware_emulation import plugged, usbfs
from hardware_emulation.evk4 import BIAS_DIFF_ON, Evk4
from hardware_emulation.lockstep import PtyPort, UsbCamera
from hardware_emulation.plugged import PATIENT, Plugged, on_a_bus
from marks import ADAPTER_NS, CRUISE_SPS, worst_at_speed
from scenarios import SMALL

from elpd import rig
from elpd.cli import replay as replay_command
from elpd.config import load
from elpd.focus.settings import FocusRequest
from elpd.record.session import focus_on
from elpd.records import Outcome, Roi
from elpd.units import after_ms

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from elpd.config import Config
    from elpd.ports import RigParts

pytest.importorskip("neuromorphic_drivers")
pytestmark = plugged.marks

UNMARKED_STEPS = ADAPTER_NS / 1e9 * CRUISE_SPS
"""What the driver is wrong by at speed when no mark comes."""

REGION = Roi(80, 60, 160, 120)
CAMERA = {
    "serial": "00050567",
    **PATIENT,
    "min_latency_us": LATENCY_US + STEP_BACK_US,
    "biases": {"expose": {"diff_on": 7}, "focus": {"diff_on": 3}},
}


class Usb(Plugged):
    """An emulated EVK4, plugged in and open, and what was sent through it."""

    def __init__(self, bus: usbfs.Bus) -> None:
        self.evk4 = Evk4()
        super().__init__(bus, self.evk4, CAMERA)
        self.stream: UsbCamera | None = None
        self.line: PtyPort | None = None

    def rig(self, config: Config) -> RigParts:
        """Build a simulated rig whose camera this is."""
        parts = rig.build(config)
        assert isinstance(parts.camera, SimulatedCamera)
        self.stream = UsbCamera(parts.camera, self.evk4, self.camera)
        return replace(parts, camera=self.stream)

    def rig_behind_a_pty(self, config: Config) -> RigParts:
        """Build one whose Tic, too, is reached by its driver's own port."""
        parts = self.rig(config)
        truth = truth_of(parts)
        self.line = PtyPort(truth.port.wire, truth.world)
        known = SimSettings()
        wanted = Wanted(known.um_per_step, known.travel_um, 3 * known.speed_um_s, known.acceleration_um_s2)
        tic = controller("tic")
        truth._lens = tic.open_lens(tic.table(wanted), truth.world, self.line)
        return replace(parts, lens=truth._lens)


@pytest.fixture
def usb() -> Iterator[Usb]:
    with on_a_bus(Usb) as made:
        yield made


def truth_of(parts: RigParts) -> SimulatedTruth:
    assert isinstance(parts.truth, SimulatedTruth)
    return parts.truth


def replays(run: Path) -> bool:
    answer = CliRunner().invoke(replay_command.command, [str(run), "--json"], standalone_mode=False)
    assert answer.exception is None, answer.exception
    told = json.loads(answer.stdout)
    assert told["first_difference"] is None
    return bool(told["identical"])


def test_the_daemons_engine_focuses_over_usb_and_pty_and_the_run_replays(usb: Usb, tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, "sim.board=tic", "sim.seed=21", build=usb.rig_behind_a_pty).begin()
    answer = daemon.do("focus", roi=asdict(REGION))
    assert answer.outcome == "FOCUSED"
    assert abs(daemon.truth.carriage_error_um()) < 3.0
    assert answer.lost == 0
    assert usb.stream is not None
    assert usb.line is not None
    assert usb.stream.sent_bytes > 100_000
    assert min(usb.line.written, usb.line.read) > 200
    assert usb.evk4.registers[BIAS_DIFF_ON] & 0xFF == 3, "the sweep's biases, after the opening's"
    daemon.end()
    assert replays(tmp_path / "runs" / answer.run)


@pytest.mark.skipif(avr.hindrance() is not None, reason=str(avr.hindrance()))
def test_trigger_words_in_the_stream_reach_the_lens_as_position_marks(usb: Usb, tmp_path: Path) -> None:
    """Edges are encoded between the events, cross the USB undecoded, and tell the driver where its lens is."""
    journal = ("journal.enabled=true", f"journal.directory={tmp_path}")
    config = load(None, [*SMALL, *journal, "sim.board=avr", "sim.seed=11", "sim.sync_steps=64"])
    parts = usb.rig(config)
    truth_of(parts).port.wire._latency_ns = ADAPTER_NS
    session = focus_on(parts, config, FocusRequest(roi=REGION))
    assert session.result.outcome is Outcome.FOCUSED
    assert not any("trigger input" in warning for warning in session.result.warnings)
    assert worst_at_speed(parts, session.result) < UNMARKED_STEPS / 10
    assert usb.evk4.listening
    assert session.run is not None
    marks = [line for line in (session.run / "tape.jsonl").read_text().splitlines() if '"call":"lens.mark"' in line]
    believed = sum('"answer":true' in line for line in marks)
    assert believed > 0.9 * len(marks) > 10
    assert replays(session.run)


def test_unplugged_in_the_sweep_the_lens_stops_and_the_request_ends_with_the_reason(usb: Usb, tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, "sim.board=tic", "sim.seed=21", build=usb.rig_behind_a_pty).begin()
    truth = daemon.truth
    daemon.at_phase("sweep", 10.0, usb.bus.unplug)
    asked = daemon.until_answered(daemon.ask("focus", roi=asdict(REGION)))
    assert asked.kind == "CameraError"
    assert daemon.status.fault is not None
    assert "unplugged (no device)" in daemon.status.fault.message
    answered_ns = truth.world.now_ns()
    truth.world.sleep_until(after_ms(answered_ns, 10.0))
    assert truth.mechanism.velocity_at(after_ms(answered_ns, 5.0)) == 0.0
    daemon.end()
