"""A simulated lens behind each board, opened by its driver: in virtual time, or over a pty in real time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from elpd_drivers.lenses import avr as avr_driver
from elpd_drivers.lenses import grbl as grbl_driver
from elpd_drivers.lenses import tic as tic_driver
from elpd_drivers.sim.boards.avr import AvrBoard, AvrConfig
from elpd_drivers.sim.boards.grbl import GrblBoard, GrblConfig
from elpd_drivers.sim.boards.line import MemoryPort, PtyServer
from elpd_drivers.sim.boards.tic import TicBoard, TicConfig
from elpd_drivers.sim.lens import SimulatedLens
from virtual import MonotonicClock, TestClock

from elpd.units import HostNs

if TYPE_CHECKING:
    from collections.abc import Callable

KINDS = ("tic", "grbl", "avr")
DRIVERS = {"tic": tic_driver, "grbl": grbl_driver, "avr": avr_driver}
BOARDS: dict[str, Any] = {
    "tic": (TicBoard, TicConfig),
    "grbl": (GrblBoard, GrblConfig),
    "avr": (AvrBoard, AvrConfig),
}
UM_PER_STEP = 0.3125
SPEED_SPS = 12_800.0  # 4 mm/s


@dataclass
class Rig:
    kind: str
    clock: TestClock
    motor: SimulatedLens
    board: Any
    port: MemoryPort
    lens: Any = None
    reports: list[Any] = field(default_factory=list)

    def open(self, **settings: Any) -> Any:
        driver = DRIVERS[self.kind]
        if self.kind == "grbl":
            settings = {"trust_position": True, **settings}
        self.lens = driver.open_lens(settings, self.clock, self.port)
        return self.lens

    def poll(self) -> None:
        report = self.lens.poll()
        if report is not None:
            self.reports.append(report)

    def live(self, ms: float, each: Callable[[], object] | None = None) -> None:
        self.clock.pass_ms(ms, each or self.poll)

    def live_until(self, condition: Callable[[], bool], limit_ms: float = 3000.0) -> None:
        for _ in range(round(limit_ms)):
            if condition():
                return
            self.live(1)
        raise AssertionError(f"not within {limit_ms} ms")

    def soon(self, ms: float) -> HostNs:
        return HostNs(self.clock.now_ns() + round(ms * 1e6))

    @property
    def rotor(self) -> float:
        return self.motor.rotor_at(self.clock.now_ns())

    @property
    def moving(self) -> bool:
        return self.motor.velocity_at(self.clock.now_ns()) != 0.0

    def truth(self, times_ns: list[int]) -> np.ndarray:
        return self.motor.motor_steps(np.array(times_ns, dtype=np.int64))


def rig(kind: str, *, seed: int = 1, start_um: float = 1000.0, referenced: bool = True, **config: Any) -> Rig:
    """Make a rig in virtual time; ``open`` connects the driver."""
    clock = TestClock()
    motor = SimulatedLens(start_um=start_um)
    make, settings = BOARDS[kind]
    board = make(motor, settings(referenced=referenced, **config), seed=seed, begin_ns=clock.now_ns())
    port = MemoryPort(board, clock)
    clock.actors.append(port)
    return Rig(kind, clock, motor, board, port)


def open_rig(kind: str, **kwargs: Any) -> Rig:
    """Make a rig and connect its driver."""
    made = rig(kind, **kwargs)
    made.open()
    return made


def served(kind: str, clock: MonotonicClock, **config: Any) -> tuple[PtyServer, SimulatedLens]:
    """Serve a board on a pty."""
    motor = SimulatedLens(start_um=1000.0)
    make, settings = BOARDS[kind]
    return PtyServer(make(motor, settings(referenced=True, **config), begin_ns=clock.now_ns())), motor
