"""A Theia MCR600 board with its focus motor in front of a simulated lens, and its iris motor, if there is an iris.

What matters to whoever drives one: nothing is read while a motor moves, so nothing stops it; a motion is answered when
it is over; the board counts no steps; it ends a motion at a switch that it was told to respect, and does not say so;
and the one command that knows a place (0x73) goes to the switch first.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from elpd.units import NS_PER_S, NS_PER_US
from elpd_drivers.lenses import theia_wire as wire
from elpd_drivers.sim.boards.agenda import Agenda
from elpd_drivers.sim.boards.axis import Axis
from elpd_drivers.sim.boards.iris_motor import IrisMotor
from elpd_drivers.sim.boards.served import ServedBoard

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd_drivers.sim.aperture import StepperIris
    from elpd_drivers.sim.lens import SimulatedLens

AT_ONCE_SPS2 = 1e10
SERIAL_NUMBER = (0x05, 0x50, 0x00, 0x00, 0x12, 0x34)


@dataclass(frozen=True, slots=True)
class TheiaConfig:
    """How a board is made.

    ``switch_high`` says at which end of the travel the switch is. ``referenced`` is here for all boards alike and
    changes nothing: this one has no position to remember. ``latency_us`` is from a command's last byte to its effect
    or reply, uniform between the two.
    """

    version: tuple[int, int, int, int, int] = (5, 3, 1, 0, 0)
    switch_high: bool = False
    referenced: bool = False
    baud: int = 115_200
    latency_us: tuple[int, int] = (150, 450)


class TheiaBoard:
    """A simulated MCR600. See ``boards.line.SimulatedBoard`` for the three methods that a wire calls.

    Parameters
    ----------
    lens
        What its motor 1 turns.
    config
        Its settings.
    seed
        For the firmware's latency.
    begin_ns
        When it was powered up.
    """

    def __init__(
        self, lens: SimulatedLens, config: TheiaConfig | None = None, *, seed: int = 0, begin_ns: int = 0
    ) -> None:
        self.lens = lens
        self.config = config or TheiaConfig()
        self.byte_ns = round(10 * NS_PER_S / self.config.baud)
        self._random = random.Random(seed)  # noqa: S311  (latency, not secrets)
        self._agenda = Agenda(begin_ns)
        self._axis = Axis(lens, switches=False)
        self._partial = bytearray()
        self._output: list[tuple[int, bytes]] = []
        self._setups: dict[int, bytes] = {}
        self._busy = False
        self.iris_motor: IrisMotor | None = None
        """Motor 3, if it turns an iris."""

    # --- the iris --------------------------------------------------------------------------------------------------

    iris_axis = 3
    """Which of its motors that is."""

    def add_iris(self, iris: StepperIris) -> None:
        """Put an iris on motor 3."""
        self.iris_motor = IrisMotor(iris)

    # --- the wire's side -------------------------------------------------------------------------------------------

    def receive(self, data: bytes, at_ns: int) -> None:
        """Take bytes whose last one is complete at *at_ns*; while a motor moves they are lost."""
        self.advance_to(at_ns)
        if self._busy:
            return
        for byte in data:
            self._partial.append(byte)
            length = wire.COMMAND_LENGTHS.get(self._partial[0])
            if length is None:
                self._partial.clear()
            elif len(self._partial) == length:
                message = bytes(self._partial)
                self._partial.clear()
                if byte == wire.END:
                    latency_ns = self._random.randint(*self.config.latency_us) * NS_PER_US
                    self._agenda.queue(at_ns + latency_ns, partial(self._obey, message))

    def advance_to(self, when_ns: int) -> None:
        """Let pending commands, the switch and the ends of motions happen, in the order of their times."""
        self._agenda.run_until(when_ns)
        self.lens.advance(self._agenda.now_ns)

    def take_output(self) -> list[tuple[int, bytes]]:
        """Return (and forget) the replies, each with the instant at which it was handed to the wire."""
        output, self._output = self._output, []
        return output

    def reset_at(self, at_ns: int) -> None:
        """Let the supply brown out at *at_ns*: motor halted, nothing said."""
        self.advance_to(at_ns)
        self.lens.halt(at_ns)
        if self.iris_motor is not None:
            self.iris_motor.halt(at_ns)
        self._agenda.clear()
        self._partial.clear()
        self._busy = False

    # --- commands --------------------------------------------------------------------------------------------------

    def _obey(self, message: bytes, at_ns: int) -> None:
        command, motor = message[0], message[1]
        if command == wire.VERSION:
            self._say(at_ns, command, *self.config.version)
        elif command == wire.SERIAL:
            self._say(at_ns, command, *SERIAL_NUMBER)
        elif command == wire.READ_SETUP:
            self._output.append((at_ns, self._setups.get(motor, bytes((command, *[0xFF] * 10, wire.END)))))
        elif command == wire.SET_UP:
            known = motor in {1, 2, 3, 4}
            if known:
                self._setups[motor] = bytes((wire.READ_SETUP,)) + message[1:]
            self._say(at_ns, command, int(not known))
        else:
            self._move(message, at_ns)

    def _say(self, at_ns: int, *message: int) -> None:
        self._output.append((at_ns, bytes((*message, wire.END))))

    # --- motion ----------------------------------------------------------------------------------------------------

    def _move(self, message: bytes, at_ns: int) -> None:
        setup = self._setups.get(message[1])
        steps, pace = int.from_bytes(message[2:4], "big"), int.from_bytes(message[5:7], "big")
        slowest, fastest = (0, 0) if setup is None else (_word(setup, 7), _word(setup, 9))
        if setup is None or not slowest <= pace <= fastest:
            self._say(at_ns, wire.DONE, 1)
            return
        if message[1] == self.iris_axis and self.iris_motor is not None:
            closing = message[0] == wire.FORWARD
            self.iris_motor.move_to(at_ns, self.iris_motor.count_at(at_ns) + (-steps if closing else steps), pace)
        if message[1] != 1:  # another motor than the one that turns the lens
            self._after(at_ns, steps / pace, self._done)
            return
        self._busy = True
        if message[0] == wire.HOME:
            self._seek(setup, steps, pace, at_ns)
            return
        upwards = message[0] == wire.FORWARD
        self._go(steps if upwards else -steps, pace, at_ns)
        respected = bool(setup[3] if self.config.switch_high else setup[4])
        if respected and upwards == self.config.switch_high:
            self._agenda.put("switch", self._edge_ns(at_ns), self._end_at_switch)

    def _go(self, steps: int, pace: int, at_ns: int) -> None:
        self._axis.move_to(at_ns, self._axis.count_at(at_ns) + steps, float(pace), AT_ONCE_SPS2)
        self._agenda.put("end", max(self.lens.rest_from_ns() or at_ns, at_ns), self._done)

    def _seek(self, setup: bytes, back: int, pace: int, at_ns: int) -> None:
        """Go to the end where the switch is said to be, and so many steps back; not found in time, it has failed."""
        upwards = bool(setup[3])
        way = 1 if upwards else -1
        self._go(way * round(1.1 * _word(setup, 5)), pace, at_ns)
        self._agenda.put("end", max(self.lens.rest_from_ns() or at_ns, at_ns), self._failed)
        if upwards != self.config.switch_high:
            return
        if self._pressed(at_ns):
            self._agenda.put("switch", at_ns, partial(self._halt_and, self._failed))
        else:
            back_there = partial(self._go, -way * back, pace)
            self._agenda.put("switch", self._edge_ns(at_ns), partial(self._halt_and, back_there))

    def _pressed(self, at_ns: int) -> bool:
        rotor = self.lens.rotor_at(at_ns)
        return rotor > self.lens.travel_steps - 0.5 if self.config.switch_high else rotor < 0.5

    def _edge_ns(self, from_ns: int) -> int | None:
        edge = self.lens.travel_steps - 0.5 if self.config.switch_high else 0.5
        return self.lens.reaches(edge, from_ns, upwards=self.config.switch_high)

    def _end_at_switch(self, at_ns: int) -> None:
        self._halt_and(self._done, at_ns)

    def _halt_and(self, then: Callable[[int], None], at_ns: int) -> None:
        self._axis.halt(at_ns)
        self._agenda.put("end", max(self.lens.rest_from_ns() or at_ns, at_ns), then)

    def _after(self, at_ns: int, seconds: float, then: Callable[[int], None]) -> None:
        self._busy = True
        self._agenda.put("end", at_ns + round(seconds * NS_PER_S), then)

    def _done(self, at_ns: int) -> None:
        self._finish(at_ns, 0)

    def _failed(self, at_ns: int) -> None:
        self._axis.halt(at_ns)
        self._finish(at_ns, 1)

    def _finish(self, at_ns: int, result: int) -> None:
        self._busy = False
        self._agenda.put("switch", None, self._done)
        self._agenda.put("end", None, self._done)
        self._say(at_ns, wire.DONE, result)


def _word(setup: bytes, at: int) -> int:
    return int.from_bytes(setup[at : at + 2], "big")


BOARD = ServedBoard(TheiaBoard, TheiaConfig)
"""The entry point ``elpd.boards: theia``."""
