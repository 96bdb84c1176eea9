"""A simulated lens behind each board, opened by its driver: in virtual time, in memory or over a pty."""

from __future__ import annotations

import functools
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from elpd_drivers.lenses import avr_wire
from elpd_drivers.sim.boards import avr as avr_board
from elpd_drivers.sim.boards.line import MemoryPort, PtyServer
from elpd_drivers.sim.controllers import CONTROLLERS
from elpd_drivers.sim.lens import LensMechanics, SimulatedLens
from pty_port import PtyPort
from virtual import MonotonicClock, TestClock

from elpd.units import HostNs, Steps

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

KINDS = tuple(CONTROLLERS)
LINES = {"memory": MemoryPort, "pty": PtyPort}
UM_PER_STEP = 0.3125
SPEED_SPS = 12_800.0  # 4 mm/s


def _avr_lie(data: bytes) -> bytes:
    """Put the position at the start (3200, no byte of it escaped) elsewhere, under a right CRC."""
    if (3200).to_bytes(4, "little") not in data:
        return data
    body = bytearray()
    escaped = False
    for byte in data[1:-1]:
        if byte == 0xFD:
            escaped = True
            continue
        body.append(byte ^ 0x20 if escaped else byte)
        escaped = False
    sequence, command = body[0], body[1]
    return avr_wire.encode(sequence, command, bytes(body[2:5]) + (900).to_bytes(4, "little") + bytes(body[9:-2]))


def _tmcl_lie(data: bytes) -> bytes:
    if data[4:8] != (3200).to_bytes(4, "big"):
        return data
    lie = data[:4] + (900).to_bytes(4, "big")
    return lie + bytes((sum(lie) % 256,))


@dataclass(frozen=True)
class Dialect:
    """What the contract must know of a protocol.

    ``hardest_stop_ms`` is the time from the strongest stop at full speed to rest; ``moves`` tells the command that
    starts a motion, ``lie`` makes the position at the start another one, in a reply that is right otherwise,
    ``question`` is something that an earlier session may have asked, and ``spoil`` flips a bit that a checksum guards.
    ``homed`` opens one that an earlier session has homed; ``end_switches`` says whether the controller itself stops at
    the ends of the travel, ``stops`` whether it can be stopped, and ``remembers`` whether it knows where it is by
    itself. Where there is no ``lie``, no positions are reported.
    """

    hardest_stop_ms: float
    abrupt_keeps_reference: bool
    moves: Callable[[bytes], bool]
    lie: Callable[[bytes], bytes] | None
    question: bytes
    spoil: Callable[[bytes], bytes] | None
    settings: dict[str, Any] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)
    homed: dict[str, Any] = field(default_factory=dict)
    end_switches: bool = True
    stops: bool = True
    remembers: bool = True


def _flip(data: bytes) -> bytes:
    return bytes((data[0], data[1] ^ 4, *data[2:]))


RAMP_MS = 1000 * SPEED_SPS / 640_000.0
DIALECTS = {
    "tic": Dialect(
        2.0,
        abrupt_keeps_reference=True,
        moves=lambda data: b"\xe0" in data,
        lie=lambda data: (b"\0\0\7\0" + data[4:]) if len(data) == 8 else data,
        question=bytes((0xA1, 0x22, 10)),
        spoil=_flip,
        settings={"crc_responses": True},
        config={"crc_responses": True},
    ),
    "grbl": Dialect(
        2.0,
        abrupt_keeps_reference=False,
        moves=lambda data: data.startswith(b"$J"),
        lie=lambda data: data.replace(b"MPos:-1.500", b"MPos:-0.200"),
        question=b"?",
        spoil=None,
        homed={"trust_position": True},
    ),
    "avr": Dialect(
        2.0,
        abrupt_keeps_reference=True,
        moves=lambda data: data[:1] == b"\xfe" and data[2] == avr_wire.GO,
        lie=_avr_lie,
        question=avr_wire.encode(9, avr_wire.STATUS),
        spoil=lambda data: bytes((*data[:7], data[7] ^ 4, *data[8:])),
    ),
    "tmcl": Dialect(
        RAMP_MS + 6.0,
        abrupt_keeps_reference=True,
        moves=lambda data: data[1] == 4,
        lie=_tmcl_lie,
        question=bytes((1, 6, 1, 0, 0, 0, 0, 0, 8)),
        spoil=lambda data: bytes((*data[:6], data[6] ^ 4, *data[7:])),
    ),
}


def _zaber_lie(data: bytes) -> bytes:
    if b" 3200:" not in data:
        return data
    lie = data.decode("ascii").split(":")[0].replace(" 3200", " 900")
    return f"{lie}:{-sum(lie[1:].encode('ascii')) & 255:02X}\r\n".encode("ascii")


DIALECTS["zaber"] = Dialect(
    4.0,
    abrupt_keeps_reference=False,
    moves=lambda data: b" move " in data,
    lie=_zaber_lie,
    question=b"/1 1 07 get pos",
    spoil=lambda data: data.replace(b" OK ", b" OJ ") if data.startswith(b"@") else data,
)


DIALECTS["scf4"] = Dialect(
    3.0,
    abrupt_keeps_reference=True,
    moves=lambda data: data.startswith(b"G0"),
    lie=lambda data: data.replace(b"35200,", b"32900,"),
    question=b"!1\n",
    spoil=None,
    homed={"trust_position": True, "relative": "G91", "speed_scale": 7_680_000.0},
    end_switches=False,
)


DIALECTS["theia"] = Dialect(
    0.0,
    abrupt_keeps_reference=True,
    moves=lambda data: data[:1] in {b"\x62", b"\x66"},
    lie=None,
    question=b"\x76\x0d",
    spoil=None,
    homed={"max_speed_um_s": 4000.0, "late_ms": 200.0},
    stops=False,
    remembers=False,
)


def needs(ability: str, because: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Skip a test for the kinds whose dialect has not the *ability*, for the reason given."""

    def only_where_able(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def run(kind: str, *args: Any, **kwargs: Any) -> None:
            if not getattr(DIALECTS[kind], ability):
                pytest.skip(because)
            test(kind, *args, **kwargs)

        return run

    return only_where_able


@dataclass
class Rig:
    kind: str
    clock: TestClock
    motor: SimulatedLens
    board: Any
    port: MemoryPort | PtyPort
    lens: Any = None
    reports: list[Any] = field(default_factory=list)

    def open(self, **settings: Any) -> Any:
        self.lens = CONTROLLERS[self.kind].open_lens({**self.dialect.homed, **settings}, self.clock, self.port)
        self.reports.clear()
        return self.lens

    def poll(self) -> None:
        report = self.lens.poll()
        if report is not None:
            self.reports.append(report)

    def live(self, ms: float, each: Callable[[], object] | None = None) -> None:
        self.clock.pass_ms(ms, each or self.poll)

    def plug_in(self) -> None:
        """Connect the board, which had power all the time, by another cable."""
        self.clock.actors.remove(self.port)
        self.port = type(self.port)(self.board, self.clock)
        self.clock.actors.append(self.port)

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
    def dialect(self) -> Dialect:
        return DIALECTS[self.kind]

    @property
    def moving(self) -> bool:
        return self.motor.velocity_at(self.clock.now_ns()) != 0.0

    def truth(self, times_ns: list[int]) -> np.ndarray:
        return self.motor.motor_steps(np.array(times_ns, dtype=np.int64))


def _skip_what_cannot_be_built(kind: str) -> None:
    hindrance = avr_board.hindrance() if kind == "avr" else None
    if hindrance is not None:
        pytest.skip(hindrance)


_line: list[type[MemoryPort | PtyPort]] = [MemoryPort]


@contextmanager
def rigs_over(line: str) -> Iterator[None]:
    """Let the rigs that are made meanwhile have that kind of line."""
    _line.append(LINES[line])
    try:
        yield
    finally:
        _line.pop()


def rig(
    kind: str,
    *,
    seed: int = 1,
    start_um: float = 1000.0,
    um_per_step: float = UM_PER_STEP,
    referenced: bool = True,
    **config: Any,
) -> Rig:
    """Make a rig in virtual time; ``open`` connects the driver."""
    _skip_what_cannot_be_built(kind)
    clock = TestClock()
    motor = SimulatedLens(LensMechanics(um_per_step=um_per_step), start_um=start_um)
    kinds = CONTROLLERS[kind].board
    board = kinds.make(motor, kinds.config(referenced=referenced, **config), seed=seed, begin_ns=clock.now_ns())
    port = _line[-1](board, clock)
    clock.actors.append(port)
    return Rig(kind, clock, motor, board, port)


def open_rig(kind: str, **kwargs: Any) -> Rig:
    """Make a rig and connect its driver; what remembers no position is homed and brought back."""
    made = rig(kind, **kwargs)
    made.open()
    if not made.dialect.remembers and kwargs.get("referenced", True):
        begin = Steps(round(made.rotor))
        made.lens.home(made.soon(10_000))
        made.lens.move_to(begin, SPEED_SPS)
        made.live(1000)
        made.reports.clear()
    return made


def served(kind: str, clock: MonotonicClock, **config: Any) -> tuple[PtyServer, SimulatedLens]:
    """Serve a board on a pty."""
    _skip_what_cannot_be_built(kind)
    motor = SimulatedLens(start_um=1000.0)
    kinds = CONTROLLERS[kind].board
    config = kinds.config(referenced=True, **config)
    return PtyServer(kinds.make(motor, config, seed=0, begin_ns=clock.now_ns())), motor
