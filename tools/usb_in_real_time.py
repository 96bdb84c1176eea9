"""A focus cycle in real time over an emulated USB: ``tools/usb_in_real_time.py [--speed-um-s 1000] [--json]``.

This process is the world: a simulated scene and lens that live by the wall's clock, and a simulated Tic behind a pty
that moves the lens. A second is an EVK4 on an emulated bus (Debian's umockdev, ``tests/hardware_emulation``), which
sends what the sensor says, as much at a time as has gathered since the host last asked. The other side is an ordinary
``elpd focus --foreground`` in a third, with the unmodified neuromorphic-drivers and its capture process. Nothing waits
for anything: what comes late is late.

Each of the emulation's ioctls goes through a socket to Python, so first it is measured what the bus carries at all,
in packets of 128 KiB. Then the cycle runs, and what is told is how far the world fell behind the wall clock, what was
sent, how much waited at the most, and how far from true focus the lens came to rest. Prints; asserts nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import pty
import subprocess
import sys
import tempfile
import time
import tty
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from elpd_drivers.sim.camera import SimulatedCamera
from elpd_drivers.sim.controllers import Wanted, controller
from elpd_drivers.sim.rig import SimSettings, SimulatedTruth

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hardware_emulation import usbfs
from hardware_emulation.evk4 import EVENTS_IN, Evk4
from hardware_emulation.plugged import PATIENT, Plugged, on_a_bus

from elpd import rig
from elpd.config import load
from elpd.units import after_ms

if TYPE_CHECKING:
    from elpd.ports import RigParts

SERIAL = "00050567"
WIDTH, HEIGHT = 320, 240
SENSOR = (720, 1280)
REGION = (80, 60, 160, 120)
STEP_S = 0.001
PIECE = 1 << 17
LIMIT_S = 120.0


def main() -> int:
    """Measure the bus, run the cycle, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speed-um-s", type=float, default=1000.0, help="of the sweep")
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--bus", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.bus:
        return be_the_bus()
    missing = usbfs.missing()
    if missing is not None:
        parser.error(missing)
    answer = {"bus_mb_s": carried_mb_s(), **cycle(chosen.seed, chosen.speed_um_s)}
    if chosen.json:
        print(json.dumps(answer))
    else:
        for name, value in answer.items():
            print(f"{name:<18}{value}")
    return 0


class Gathering(Evk4):
    """An EVK4 that sends as much at a time as has gathered."""

    def __init__(self) -> None:
        super().__init__(SERIAL)
        self.gathered = bytearray()
        self.sent = self.most = 0

    def gather(self, words: bytes) -> None:
        """Take what the sensor says; it is heard while it is on."""
        if self.streaming:
            self.gathered += words
            self.most = max(self.most, len(self.gathered))

    def next_packet(self, endpoint: int, length: int) -> bytes | None:
        """Return a reply, or what there is of events."""
        if endpoint != EVENTS_IN or not self.gathered:
            return super().next_packet(endpoint, length)
        packet = bytes(self.gathered[:length])
        del self.gathered[: len(packet)]
        self.sent += len(packet)
        return packet


def be_the_bus() -> int:
    """Plug a camera in, say where on stdout, send what comes on stdin until it ends, say how that went."""
    evk4 = Gathering()
    with usbfs.Bus() as bus:
        bus.plug(evk4)
        print(json.dumps(bus.environment), flush=True)
        while words := os.read(0, PIECE):
            evk4.gather(words)
        print(json.dumps({"sent_mb": round(evk4.sent / 1e6, 2), "most_waiting_kb": round(evk4.most / 1e3, 1)}))
    return 0


def carried_mb_s(megabytes: int = 8) -> float:
    """Return what the emulated bus carries, with this process reading as well: a lower bound of what it can."""
    words = np.tile(np.array([0x8001, 0x6005, 0x0009, *range(0x2803, 0x2803 + 61)], "<u2"), PIECE // 128).tobytes()

    evk4 = Evk4(SERIAL)
    with on_a_bus(lambda bus: Plugged(bus, evk4, {"serial": SERIAL, **PATIENT})) as plugged:
        camera = plugged.camera
        camera.start()
        plugged.wait_for(lambda: evk4.streaming)
        begun_s, missing = time.monotonic(), megabytes * 1_000_000 // PIECE * PIECE
        sent = missing
        for _ in range(missing // PIECE):
            evk4.send(words)
        while missing > 0 and time.monotonic() - begun_s < LIMIT_S:
            packet = camera.read(0.02)
            missing -= 0 if packet is None else packet.data.nbytes
        return round((sent - missing) / 1e6 / (time.monotonic() - begun_s), 2)


def cycle(seed: int, speed_um_s: float) -> dict[str, Any]:
    """Run one cycle against a world that keeps the wall's pace; return what became of it."""
    keys = ("rig=sim", f"sim.width={WIDTH}", f"sim.height={HEIGHT}", "sim.scene=camera", "sim.board=tic", "sim.pace=1")
    parts = rig.build(load(overrides=[*keys, f"sim.seed={seed}", f"sim.speed_um_s={speed_um_s}"]))
    with ExitStack() as stack, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = os.pathsep.join(filter(None, sys.path))
        environment = {**os.environ, "PYTHONPATH": path}
        bus = stack.enter_context(
            subprocess.Popen(  # noqa: S603  (our own)
                [sys.executable, __file__, "--bus"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
            )
        )
        assert bus.stdin is not None
        assert bus.stdout is not None
        environment |= json.loads(bus.stdout.readline())
        board_end, host_end = pty.openpty()
        for end in (board_end, host_end):
            stack.callback(os.close, end)
        tty.setraw(host_end)
        os.set_blocking(board_end, False)
        settings = write_settings(folder, parts, os.ttyname(host_end), speed_um_s)
        x, y, width, height = REGION
        command = [sys.executable, "-m", "elpd", "focus", "--foreground", "--config", str(settings), "--json"]
        command += ["--roi", f"{x},{y},{width},{height}", "--reference", str(folder / "scene.png")]
        child = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)  # noqa: S603  (our own)
        world = live(parts, bus.stdin.fileno(), board_end, child)
        output, _ = child.communicate()
        bus.stdin.close()
        world |= json.loads(bus.stdout.read())
    assert isinstance(parts.truth, SimulatedTruth)
    told = json.loads(output) if output.strip() else {}
    kept = ("outcome", "reason", "focus_um", "sigma_um", "duration_ms", "events", "lost", "error")
    return {
        **{name: told[name] for name in kept if told.get(name) is not None},
        "final_error_um": round(parts.truth.carriage_error_um(), 2),
        "speed_um_s": speed_um_s,
        **world,
    }


def write_settings(folder: Path, parts: RigParts, port: str, speed_um_s: float) -> Path:
    """Write the configuration of the other side, and the picture that it focuses on."""
    assert isinstance(parts.truth, SimulatedTruth)
    assert parts.aperture is not None
    parts.aperture.open()  # before the wall's clock counts
    parts.clock.sleep_until(after_ms(parts.clock.now_ns(), 100.0))
    picture = np.zeros(SENSOR, np.uint8)
    light = parts.truth.picture()
    picture[:HEIGHT, :WIDTH] = cv2.normalize(light, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)  # type: ignore[call-overload]
    cv2.imwrite(str(folder / "scene.png"), picture)
    known = SimSettings()
    table = controller("tic").table(
        Wanted(known.um_per_step, known.travel_um, 3 * speed_um_s, known.acceleration_um_s2)
    )
    lens = {"driver": "tic", "port": port, "speed_um_s": speed_um_s, **table}
    camera = {"driver": "neuromorphic", "serial": SERIAL, **PATIENT}
    sections = {"camera": camera, "lens": lens, "aperture": {"driver": "none"}, "journal": {"enabled": False}}
    sections["state"] = {"profiles": False}
    sections["focus"] = {"deadline_ms": 20_000.0, "depth_of_focus_um": known.depth_of_focus_um}
    lines = ['rig = "hardware"']
    for section, keys in sections.items():
        lines += [f"[{section}]", *(f"{key} = {json.dumps(value)}" for key, value in keys.items())]
    (folder / "elpd.toml").write_text("\n".join(lines), encoding="utf-8")
    return folder / "elpd.toml"


def live(parts: RigParts, usb: int, board_end: int, child: subprocess.Popen[str]) -> dict[str, Any]:
    """Let the world live by the wall's clock until the other side ends; return how far it fell behind.

    What the sensor says is written to *usb*; the board is asked what it heard and says.
    """
    sensor, truth = parts.camera, parts.truth
    assert isinstance(sensor, SimulatedCamera)
    assert isinstance(truth, SimulatedTruth)
    wire, world = truth.port.wire, truth.world
    most_s = 0.0
    with suppress(PermissionError):  # the world does not wait for other programs; what else there is here may have to
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    sensor.start()
    until_s = time.monotonic() + LIMIT_S
    while child.poll() is None and time.monotonic() < until_s:
        begun_s = time.monotonic()
        spoken = sensor.read(STEP_S)
        with suppress(BlockingIOError, OSError):  # nobody has opened the other end, or said anything
            wire.send(os.read(board_end, 4096), world.now_ns())
        wire.advance_to(world.now_ns())
        answer = wire.arrived(world.now_ns())
        if answer:
            os.write(board_end, answer)
        if spoken is not None:
            os.write(usb, spoken.data.tobytes())
        most_s = max(most_s, time.monotonic() - begun_s)
    child.kill()
    return {"longest_step_ms": round(1e3 * most_s, 1)}


if __name__ == "__main__":
    raise SystemExit(main())
