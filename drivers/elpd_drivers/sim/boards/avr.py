"""Our own lens controller on the bench: not a model of the firmware but the firmware, on a simulated ATmega328P.

``drivers/firmware`` is built with gcc-avr and runs under simavr, instruction by instruction; bytes go into its UART and
come out of it, its STEP and DIR pins turn the simulated lens, whose ends close its limit switches. A step is made on
the pin's rising edge; the rotor follows within one step's time.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
from collections import deque
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from elpd.errors import LensError
from elpd.motion.kinematics import Piece
from elpd.units import NS_PER_MS, NS_PER_S
from elpd_drivers.lenses import avr_wire as wire
from elpd_drivers.sim.boards.served import ServedBoard

if TYPE_CHECKING:
    from elpd_drivers.sim.lens import SimulatedLens

FIRMWARE = Path(__file__).parents[3] / "firmware"
PACKAGES = "gcc-avr avr-libc libsimavr-dev libelf-dev"
CYCLE_NS = 62.5
SLICE_NS = NS_PER_MS // 5
LONGEST_STEP_S = 0.0005
ROOM = 4096


@dataclass(frozen=True, slots=True)
class AvrConfig:
    """How the controller's day began.

    ``referenced`` begins with its count set to where the lens is; otherwise as after power-up. ``ignore_stop`` loses
    the single stop bytes on the way.
    """

    referenced: bool = False
    ignore_stop: bool = False
    baud: int = 500_000


class AvrBoard:
    """The firmware under simavr. See ``boards.line.SimulatedBoard`` for the three methods that a wire calls.

    Parameters
    ----------
    lens
        What its motor turns.
    config
        How its day began.
    seed
        Unused: nothing here is random.
    begin_ns
        When it was powered up.
    """

    def __init__(
        self, lens: SimulatedLens, config: AvrConfig | None = None, *, seed: int = 0, begin_ns: int = 0
    ) -> None:
        del seed
        self.lens = lens
        self.config = config or AvrConfig()
        self.byte_ns = round(10 * NS_PER_S / self.config.baud)
        self._bench = load_bench()
        elf, _ = built()
        rotor = round(lens.rotor_at(begin_ns))
        self._handle = self._bench.bench_open(os.fsencode(elf), rotor, 0, round(lens.travel_steps))
        if not self._handle:
            raise LensError(f"simavr cannot run {elf}; delete it, it will be built again")
        self._cycles = (ctypes.c_uint64 * ROOM)()
        self._bytes = (ctypes.c_uint8 * ROOM)()
        self._ways = (ctypes.c_int32 * ROOM)()
        self._speaking = bytearray()
        self._syncs: list[tuple[int, bool]] = []
        self._spoke_ns = begin_ns
        self._output: deque[tuple[int, bytes]] = deque()
        self._now_ns = begin_ns
        self._boot_ns = float(begin_ns)
        self._stepped_ns = begin_ns
        self._pins = rotor
        self._goal: float | None = None
        self._power_up(begin_ns, rotor if self.config.referenced else None)

    def __del__(self) -> None:
        """Give the AVR's memory back."""
        if getattr(self, "_handle", None):
            self._bench.bench_close(self._handle)
            self._handle = None

    # --- the wire's side -------------------------------------------------------------------------------------------

    def receive(self, data: bytes, at_ns: int) -> None:
        """Take bytes whose last one is complete at *at_ns*."""
        self.advance_to(at_ns - self.byte_ns)  # the AVR's own UART takes the byte's time once more
        for byte in data:
            if not (self.config.ignore_stop and bytes((byte,)) in {wire.HALT, wire.BRAKE}):
                self._bench.bench_receive(self._handle, byte)

    def advance_to(self, when_ns: int) -> None:
        """Run the firmware up to *when_ns*."""
        while self._now_ns < when_ns:
            self._now_ns = min(when_ns, self._now_ns + SLICE_NS)
            if self._bench.bench_run(self._handle, max(0, round((self._now_ns - self._boot_ns) / CYCLE_NS))):
                raise LensError("the firmware crashed under simavr")
            self._turn()
            self._listen()
            self._note_syncs()

    def take_output(self) -> list[tuple[int, bytes]]:
        """Return (and forget) what was handed to the wire."""
        taken = list(self._output)
        self._output.clear()
        return taken

    # --- for tests -------------------------------------------------------------------------------------------------

    def reset_at(self, at_ns: int) -> None:
        """Let the supply fail for an instant: everything is lost but where the motor is."""
        self.advance_to(at_ns)
        self._bench.bench_reset(self._handle)
        self._turn()

    def alarm_at(self, at_ns: int) -> None:
        """Let it meet what it has instead of alarms: a reset by its own watchdog."""
        self.reset_at(at_ns)

    @property
    def steps_made(self) -> int:
        """How many rising edges STEP has had."""
        return int(self._bench.bench_steps_made(self._handle))

    @property
    def pin_position(self) -> int:
        """Where the motor must be by the edges on STEP and the level of DIR, in steps since it was told where it is."""
        return self._pins

    @property
    def last_step_ns(self) -> int:
        """When STEP rose last."""
        return self._stepped_ns

    @property
    def sync_edges(self) -> int:
        """How many edges SYNC has had."""
        return int(self._bench.bench_sync_edges(self._handle))

    def take_sync_edges(self) -> list[tuple[int, bool]]:
        """Return (and forget) the edges on SYNC so far: when, and the level after it."""
        taken, self._syncs = self._syncs, []
        return taken

    @property
    def outputs(self) -> dict[str, bool]:
        """The output that can be switched, by name."""
        return {"iris": self.iris_open}

    @property
    def iris_open(self) -> bool:
        """The state of the IRIS pin."""
        return bool(self._bench.bench_iris(self._handle))

    # --- below: how it is done -------------------------------------------------------------------------------------

    def _power_up(self, begin_ns: int, position: int | None) -> None:
        """Let it boot, before *begin_ns*; then tell it where it is, if somebody had."""
        boot_ns = 20 * NS_PER_MS
        self._boot_ns = float(begin_ns - boot_ns)
        self._now_ns = begin_ns - boot_ns
        self.advance_to(begin_ns - boot_ns // 2)
        if position is not None:
            for byte in wire.encode(0, wire.SET_POSITION, position.to_bytes(4, "little", signed=True)):
                self._bench.bench_receive(self._handle, byte)
        self.advance_to(begin_ns)
        self._output.clear()

    def _time_of(self, cycle: int) -> int:
        return round(self._boot_ns + cycle * CYCLE_NS)

    def _turn(self) -> None:
        """Let the lens follow the steps that were made, and the switches follow the lens."""
        count = self._bench.bench_steps(self._handle, self._cycles, self._ways, ROOM)
        for index in range(count):
            at_ns = max(self._time_of(self._cycles[index]), self._stepped_ns)
            interval_s = min(max((at_ns - self._stepped_ns) / NS_PER_S, 1e-6), LONGEST_STEP_S)
            self._stepped_ns = at_ns
            self._pins += self._ways[index]
            target = self._target(at_ns) + self._ways[index]
            gap = target - self.lens.pulses_at(at_ns)
            self.lens.follow(at_ns, (Piece(interval_s, gap / interval_s, 0.0), Piece(float("inf"), 0.0, 0.0)))
            self._goal = target
        self._bench.bench_place(self._handle, round(self.lens.rotor_at(self._now_ns)))

    def _target(self, at_ns: int) -> float:
        """Return the step that the rotor is on, or on its way to."""
        return round(self.lens.pulses_at(at_ns)) if self._goal is None else self._goal

    def _note_syncs(self) -> None:
        count = self._bench.bench_syncs(self._handle, self._cycles, self._ways, ROOM)
        self._syncs += [(self._time_of(self._cycles[index]), bool(self._ways[index])) for index in range(count)]

    def _listen(self) -> None:
        count = self._bench.bench_sent(self._handle, self._cycles, self._bytes, ROOM)
        for index in range(count):
            if not self._speaking:
                self._spoke_ns = self._time_of(self._cycles[index])
            self._speaking.append(self._bytes[index])
            if self._bytes[index] == wire.END:  # frames leave whole: the UART sends their bytes without a pause
                self._output.append((self._spoke_ns, bytes(self._speaking)))
                self._speaking.clear()


def hindrance() -> str | None:
    """Return what stands in the way of building the firmware, with what to do; ``None``: nothing."""
    if not FIRMWARE.is_dir():
        return f"{FIRMWARE} is missing: the firmware's sources come with a checkout, not with an installation"
    missing = [tool for tool in ("avr-gcc", "gcc", "make") if shutil.which(tool) is None]
    if not Path("/usr/include/simavr").is_dir():
        missing.append("simavr's headers")
    if missing:
        return f"the firmware cannot be built without {', '.join(missing)}; apt-get install make gcc {PACKAGES}"
    return None


@cache
def built() -> tuple[Path, Path]:
    """Build firmware and bench, once for each version of their sources; return the paths of both.

    Raises ``LensError`` if the sources or the compilers are missing, or a build fails, with what to do.
    """
    reason = hindrance()
    if reason is not None:
        raise LensError(reason)
    digest = hashlib.sha3_224()
    for source in sorted([*FIRMWARE.glob("*.[ch]"), FIRMWARE / "Makefile"]):
        digest.update(source.read_bytes())
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = home / "elpd" / f"firmware-{digest.hexdigest()[:12]}"
    elf, bench = folder / "lens.elf", folder / "bench.so"
    if not (elf.exists() and bench.exists()):
        scratch = folder.with_name(f"{folder.name}.{os.getpid()}")
        scratch.mkdir(parents=True, exist_ok=True)
        _run(["make", "-s", "-C", str(FIRMWARE), f"OUT={scratch}"])
        shared = [
            "-O2",
            "-shared",
            "-fPIC",
            f"-I{FIRMWARE}",
            "-o",
            str(scratch / "bench.so"),
            str(FIRMWARE / "bench.c"),
        ]
        _run(["gcc", *shared, "-lsimavr", "-lelf"])
        try:
            scratch.rename(folder)
        except OSError:  # somebody else was faster
            shutil.rmtree(scratch)
    return elf, bench


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603  (our own words)
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()
        first = next((line for line in said if "error" in line), said[-1] if said else "no message")
        raise LensError(f"{command[0]} failed to build the firmware: {first}; apt-get install make gcc {PACKAGES}")


@cache
def load_bench() -> ctypes.CDLL:
    """Load the bench and declare its functions."""
    _, path = built()
    bench = ctypes.CDLL(str(path))
    handle, words = ctypes.c_void_p, ctypes.POINTER(ctypes.c_uint64)
    bench.bench_open.restype = handle
    bench.bench_open.argtypes = [ctypes.c_char_p, ctypes.c_int32, ctypes.c_int32, ctypes.c_int32]
    bench.bench_run.argtypes = [handle, ctypes.c_uint64]
    bench.bench_receive.argtypes = [handle, ctypes.c_uint8]
    bench.bench_place.argtypes = [handle, ctypes.c_int32]
    bench.bench_sent.argtypes = [handle, words, ctypes.POINTER(ctypes.c_uint8), ctypes.c_uint32]
    bench.bench_syncs.argtypes = [handle, words, ctypes.POINTER(ctypes.c_int32), ctypes.c_uint32]
    bench.bench_steps.argtypes = [handle, words, ctypes.POINTER(ctypes.c_int32), ctypes.c_uint32]
    for name in ("bench_close", "bench_reset", "bench_iris", "bench_steps_made", "bench_sync_edges"):
        getattr(bench, name).argtypes = [handle]
    for name in ("bench_steps_made", "bench_sync_edges"):
        getattr(bench, name).restype = ctypes.c_uint64
    return bench


BOARD = ServedBoard(AvrBoard, AvrConfig)
