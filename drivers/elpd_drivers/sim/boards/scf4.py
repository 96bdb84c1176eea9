"""A Kurokesu SCF4 (three stepper drivers behind a USB serial port) with its motor A in front of a simulated lens.

Its motor C may turn an iris.

What matters to whoever drives one: every command has exactly one reply; ``!1`` tells positions, photo-interrupters and
whether motors move; the position is a counter of 16 bits that wraps; a move is answered when it was read, not when it
is over, and there is no other motion than to a number of steps; a delay (``G4``) blocks the parser, so that not even a
stop gets through; which of ``G90`` and ``G91`` means relative, the maker's page and examples tell differently. Nothing
is known of what a move in mid-motion does: here it is refused, so that nobody relies on it.

Written from the maker's page of commands and the examples of the SDK; there was nothing to compare with.
"""

from __future__ import annotations

import random
import re
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from elpd.units import NS_PER_MS, NS_PER_S, NS_PER_US
from elpd_drivers.sim.boards.agenda import Agenda
from elpd_drivers.sim.boards.axis import Axis
from elpd_drivers.sim.boards.iris_motor import IrisMotor
from elpd_drivers.sim.boards.served import ServedBoard

if TYPE_CHECKING:
    from elpd_drivers.sim.aperture import StepperIris
    from elpd_drivers.sim.lens import SimulatedLens

LINE_LENGTH = 80
WRAP = 1 << 16
HOMED_COUNT = 32_000
"""What the maker's examples call the edge of the photo-interrupter."""

_WORD = re.compile(r"([A-Z])([+-]?\d+)")
_SETTINGS = frozenset({7, 8, 232, 234, 235, 241, 242, 243, 244, 245, 246})


class RefusedError(Exception):
    """A command that is not understood, or not now."""


@dataclass(frozen=True, slots=True)
class Scf4Config:
    """How a board is made and how its day began.

    ``speed_scale`` is the product of the code of ``M240`` and the steps per second that it makes. ``relative`` is the
    word for relative moves. ``edge_um`` is where the photo-interrupter changes, from 0 above it to 1 below it.
    ``stops_at_edge`` says whether a forced move ends at that edge by itself. ``acceleration_um_s2`` of 0 starts and
    stops without a ramp. ``referenced`` begins homed by an earlier session. ``latency_us`` is from a command's last
    byte to its effect and reply, uniform between the two.
    """

    version: str = "EVB.1.0.2, SCF4-M RevB, Kurokesu, 5DDFF39-3739584E-43204208"
    speed_scale: float = 7_680_000.0
    acceleration_um_s2: float = 0.0
    relative: str = "G91"
    edge_um: float = 0.0
    stops_at_edge: bool = True
    referenced: bool = False
    latency_us: tuple[int, int] = (150, 450)
    baud: int = 1_000_000
    ignore_stop: bool = False


class Scf4Board:
    """A simulated SCF4. See ``boards.line.SimulatedBoard`` for the three methods that a wire calls.

    Parameters
    ----------
    lens
        What its motor A turns.
    config
        Its settings.
    seed
        For the firmware's latency.
    begin_ns
        When it was powered up.
    """

    def __init__(
        self, lens: SimulatedLens, config: Scf4Config | None = None, *, seed: int = 0, begin_ns: int = 0
    ) -> None:
        self.lens = lens
        self.config = config or Scf4Config()
        self.byte_ns = round(10 * NS_PER_S / self.config.baud)
        self._random = random.Random(seed)  # noqa: S311  (latency, not secrets)
        self._agenda = Agenda(begin_ns)
        self._axis = Axis(lens, switches=False)
        self._edge_steps = self.config.edge_um / lens.mechanics.um_per_step - 0.5
        self._acceleration_sps2 = (self.config.acceleration_um_s2 or 1e9) / lens.mechanics.um_per_step
        self._partial = bytearray()
        self._output: list[tuple[int, bytes]] = []
        self._parser_free_ns = begin_ns
        self._code = 600
        self.iris_motor: IrisMotor | None = None
        """Motor C, if it turns an iris."""
        self._iris_code = 600
        self._power_up(begin_ns)
        if self.config.referenced:
            self._axis.set_count(begin_ns, HOMED_COUNT + round(lens.rotor_at(begin_ns)))
            self._ready = True

    # --- the iris --------------------------------------------------------------------------------------------------

    iris_axis = "C"
    """Which of its motors that is."""

    def add_iris(self, iris: StepperIris) -> None:
        """Put an iris on motor C."""
        self.iris_motor = IrisMotor(iris)

    # --- the wire's side -------------------------------------------------------------------------------------------

    def receive(self, data: bytes, at_ns: int) -> None:
        """Take bytes whose last one is complete at *at_ns*."""
        self.advance_to(at_ns)
        for byte in data:
            if byte in b"\r\n":
                line = self._partial.decode("ascii", "replace").strip()
                self._partial.clear()
                if line:
                    self._queue(line, at_ns)
            elif len(self._partial) < LINE_LENGTH:
                self._partial.append(byte)

    def advance_to(self, when_ns: int) -> None:
        """Let pending commands and the photo-interrupter happen, in the order of their times."""
        self._agenda.run_until(when_ns)
        self.lens.advance(self._agenda.now_ns)

    def take_output(self) -> list[tuple[int, bytes]]:
        """Return (and forget) the replies, each with the instant at which it was handed to the wire."""
        output, self._output = self._output, []
        return output

    def reset_at(self, at_ns: int) -> None:
        """Let the supply brown out at *at_ns*: motor halted, counter and settings lost."""
        self.advance_to(at_ns)
        self.lens.halt(at_ns)
        self._agenda.clear()
        self._partial.clear()
        self._parser_free_ns = at_ns
        self._power_up(at_ns)

    # --- commands --------------------------------------------------------------------------------------------------

    def _queue(self, line: str, at_ns: int) -> None:
        begin_ns = max(at_ns + self._random.randint(*self.config.latency_us) * NS_PER_US, self._parser_free_ns)
        delay = re.fullmatch(r"G4 ?P(\d+)", line)
        if delay:  # its reply comes when it is over, and nothing is read before
            begin_ns += int(delay[1]) * NS_PER_MS
            self._parser_free_ns = begin_ns
        self._agenda.queue(begin_ns, partial(self._take_line, line))

    def _take_line(self, line: str, at_ns: int) -> None:
        try:
            reply = self._obey(line, at_ns)
        except RefusedError as refused:
            reply = f"ERROR {refused}"
        self._output.append((at_ns, f"{reply}\r\n".encode("ascii", "replace")))

    def _obey(self, line: str, at_ns: int) -> str:
        if line == "$S":
            return self.config.version
        if line == "!1":
            return self._status(at_ns)
        if line in {"$B1", "$B2", "$B3"}:
            self.lens.halt(at_ns)
            self._power_up(at_ns)
            self._ready = line == "$B2"
            return "OK"
        word, _, rest = line.partition(" ")
        values = {axis: int(number) for axis, number in _WORD.findall(rest)}
        if rest and not re.fullmatch(r"([A-Z]([+-]?\d+)? ?)+", rest):
            raise RefusedError("PARAMETER")
        match word:
            case "G0":
                self._go(values.get("A"), at_ns)
                self._turn(values.get("C"), at_ns)
            case "G4" if "P" in values:
                pass
            case "G90" | "G91":
                self._relative = word == self.config.relative
            case "G92":
                if "A" in values:
                    self._axis.set_count(at_ns, values["A"] % WRAP)
                if "C" in values and self.iris_motor is not None:
                    self.iris_motor.set_count(at_ns, values["C"] % WRAP)
            case "M0":
                self._stop(rest, at_ns)
            case "M230" | "M231":
                self._forced = word == "M231" and "A" in rest
            case "M238" | "M239":
                self._led = word == "M238"
            case "M240":
                self._code = max(values.get("A", self._code), 1)
                self._iris_code = max(values.get("C", self._iris_code), 1)
            case _ if word[:1] == "M" and word[1:].isdigit() and int(word[1:]) in _SETTINGS:
                pass
            case _:
                raise RefusedError("COMMAND")
        return "OK"

    def _status(self, at_ns: int) -> str:
        count = self._axis.count_at(at_ns) % WRAP
        moving = self._axis.velocity_at(at_ns) != 0.0
        third = self.iris_motor
        turned, turning = (0, False) if third is None else (third.count_at(at_ns) % WRAP, third.moving_at(at_ns))
        return f"{count}, 0, {turned}, {int(self._covered(at_ns))}, 0, 0, {int(moving)}, 0, {int(turning)}"

    def _covered(self, at_ns: int) -> bool:
        return self._led and self.lens.rotor_at(at_ns) < self._edge_steps

    def _go(self, number: int | None, at_ns: int) -> None:
        if number is None:
            return
        if not self._ready or self._axis.velocity_at(at_ns) != 0.0:
            raise RefusedError("BUSY" if self._ready else "NOT INITIALIZED")
        if abs(number) >= WRAP or (number < 0 and not self._relative):
            raise RefusedError("RANGE")
        count = self._axis.count_at(at_ns)
        goal = count + number if self._relative else count - count % WRAP + number
        self._axis.move_to(at_ns, goal, self.config.speed_scale / self._code, self._acceleration_sps2)
        if self._forced and self.config.stops_at_edge:
            covered = self._covered(at_ns)
            edge_ns = self.lens.reaches(self._edge_steps, at_ns, upwards=covered) if self._led else None
            self._agenda.put("edge", edge_ns, self._halt)

    def _turn(self, number: int | None, at_ns: int) -> None:
        if number is None or self.iris_motor is None:
            return
        if not self._ready or self.iris_motor.moving_at(at_ns):
            raise RefusedError("BUSY" if self._ready else "NOT INITIALIZED")
        count = self.iris_motor.count_at(at_ns)
        goal = count + number if self._relative else number
        self.iris_motor.move_to(at_ns, goal, self.config.speed_scale / self._iris_code)

    def _stop(self, axes: str, at_ns: int) -> None:
        if self.config.ignore_stop or (axes and "A" not in axes):
            return
        if self._axis.velocity_at(at_ns) != 0.0:
            self._agenda.put("edge", None, self._halt)
            if self.config.acceleration_um_s2:
                self._axis.ramp(at_ns, 0.0, self._acceleration_sps2)
            else:
                self._axis.halt(at_ns)

    def _halt(self, at_ns: int) -> None:
        self._axis.halt(at_ns)

    def _power_up(self, at_ns: int) -> None:
        self._agenda.put("edge", None, self._halt)
        self._axis.set_count(at_ns, 0)
        self._relative, self._forced, self._led, self._ready = True, False, False, False
        self._code = self._iris_code = 600
        if self.iris_motor is not None:
            self.iris_motor.set_count(at_ns, 0)


BOARD = ServedBoard(Scf4Board, Scf4Config)
"""The entry point ``elpd.boards: scf4``."""
