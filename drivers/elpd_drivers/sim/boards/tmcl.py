"""A Trinamic stepper module that speaks TMCL, its motor 0 in front of a simulated lens; motor 1 may turn an iris.

Nine bytes in, nine bytes out, as the TMCL reference has them: motion commands, axis and global parameters, the
reference search, the ports, and the module's version. The oddities that matter to a driver:

- *One command at a time.* The next one is looked at when the reply to the one before it is out. On a full-duplex line
  (USB, RS232) it waits meanwhile; on a half-duplex one (RS485) what arrives then is lost, because the module is
  talking itself.
- *A stop is not abrupt.* MST brakes with the maximum acceleration, which begins at once.
- *No memory of the day before.* After power-up the position is 0 wherever the motor stands, and user variables are 0.
- Modules with a TMC429 count speed and acceleration in its units, in steps that are coarse.
- Command 136 answers with a text and no checksum. A datagram that stays incomplete is forgotten.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from elpd.units import NS_PER_MS, NS_PER_S, NS_PER_US
from elpd_drivers.sim.boards.agenda import Agenda
from elpd_drivers.sim.boards.axis import Axis, Happened, Search
from elpd_drivers.sim.boards.iris_motor import IrisMotor
from elpd_drivers.sim.boards.served import ServedBoard
from elpd_drivers.sim.boards.tmcl_words import (
    AXIS_DEFAULTS,
    READ_ONLY,
    WITH_TMC429,
    Datagram,
    MotionUnits,
    Status,
    as_signed,
    reply_bytes,
)

if TYPE_CHECKING:
    from elpd_drivers.sim.aperture import StepperIris
    from elpd_drivers.sim.lens import SimulatedLens

FORGET_NS = 5 * NS_PER_MS
REFERENCED_MARK, MARK_VARIABLE = 0x454C_5044, 55
OVERTEMPERATURE = 2


@dataclass(frozen=True, slots=True)
class TmclConfig:
    """How a module is set up and how its day began.

    ``module`` says which one it is, and with that whether it counts in a TMC429's units. ``referenced`` begins homed,
    by this project's driver, which leaves its mark in a user variable. ``latency_us`` is the firmware's time from a
    command's last byte to its effect and reply, uniform between the two.
    """

    module: int = 1260
    version: int = 119
    address: int = 1
    host: int = 2
    baud: int = 115_200
    half_duplex: bool = False
    pulse_divisor: int = 3
    ramp_divisor: int = 6
    referenced: bool = False
    latency_us: tuple[int, int] = (100, 400)
    ignore_stop: bool = False


MAX_CURRENT = 6
"""The axis parameter."""


class TmclBoard:
    """A simulated TMCL module. See ``boards.line.SimulatedBoard`` for the three methods that a wire calls.

    Parameters
    ----------
    lens
        What its motor 0 turns.
    config
        Its settings.
    seed
        For the firmware's latency.
    begin_ns
        When it was powered up.
    """

    def __init__(
        self, lens: SimulatedLens, config: TmclConfig | None = None, *, seed: int = 0, begin_ns: int = 0
    ) -> None:
        self.lens = lens
        self.config = config or TmclConfig()
        self.byte_ns = round(10 * NS_PER_S / self.config.baud)
        internal = self.config.module in WITH_TMC429
        self._units = MotionUnits(self.config.pulse_divisor, self.config.ramp_divisor) if internal else MotionUnits()
        self._random = random.Random(seed)  # noqa: S311  (latency, not secrets)
        self._agenda = Agenda(begin_ns)
        self._axis = Axis(lens)
        self._frame = bytearray()
        self._byte_at_ns = self._free_ns = begin_ns
        self._output: list[tuple[int, bytes]] = []
        self._parameters: dict[int, int] = {}
        self._globals: dict[tuple[int, int], int] = {}
        self._ports: dict[int, int] = {}
        self._velocity_mode = False
        self._target = 0
        self._driver_flags = 0
        self.iris_motor: IrisMotor | None = None
        """Motor 1, if it turns an iris."""
        self.iris_flags = 0
        """What its driver says is wrong."""
        self._iris_speed = AXIS_DEFAULTS[4]
        self._power_up(begin_ns, referenced=self.config.referenced)

    # --- the iris --------------------------------------------------------------------------------------------------

    iris_axis = 1
    """Which of its motors that is."""

    def add_iris(self, iris: StepperIris) -> None:
        """Put an iris on motor 1."""
        self.iris_motor = IrisMotor(iris)

    def _obey_iris(self, motor: IrisMotor, asked: Datagram, at_ns: int) -> int | Status:
        match asked.command, asked.kind:
            case 3, _:
                motor.halt(at_ns)
            case 4, 0 | 1:
                target = asked.value if asked.kind == 0 else motor.count_at(at_ns) + asked.value
                if not self.iris_flags:
                    motor.move_to(at_ns, target, max(self._iris_speed, 1) * self._units.speed_sps)
            case 5, 1:
                motor.set_count(at_ns, asked.value)
            case 5, 4:
                if not 0 <= asked.value <= self._units.largest:
                    return Status.INVALID_VALUE
                self._iris_speed = asked.value
            case 6, 1:
                return motor.count_at(at_ns)
            case 6, 153 | 154 if self._units.internal:
                return self._parameters[asked.kind]
            case 6, 208:
                return self.iris_flags
            case _:
                return Status.WRONG_TYPE
        return asked.value

    # --- the wire's side -------------------------------------------------------------------------------------------

    def receive(self, data: bytes, at_ns: int) -> None:
        """Take bytes whose last one is complete at *at_ns*."""
        self.advance_to(at_ns)
        for byte in data:
            if at_ns - self._byte_at_ns > FORGET_NS:
                self._frame.clear()
            self._byte_at_ns = at_ns
            if self.config.half_duplex and at_ns - self.byte_ns < self._free_ns:
                self._frame.clear()
                continue  # it is talking itself
            self._frame.append(byte)
            if len(self._frame) == Datagram.LENGTH:
                self._accept(bytes(self._frame), at_ns)
                self._frame.clear()

    def advance_to(self, when_ns: int) -> None:
        """Let pending commands and the switches happen, in the order of their times."""
        self._agenda.run_until(when_ns)
        self.lens.advance(self._agenda.now_ns)

    def take_output(self) -> list[tuple[int, bytes]]:
        """Return (and forget) the replies, each with the instant at which it was handed to the wire."""
        output, self._output = self._output, []
        return output

    def reset_at(self, at_ns: int) -> None:
        """Let the supply brown out at *at_ns*: everything forgotten, motor halted, position 0."""
        self.advance_to(at_ns)
        self.lens.halt(at_ns)
        self._agenda.clear()
        self._frame.clear()
        self._power_up(at_ns, referenced=False)

    def alarm_at(self, at_ns: int) -> None:
        """Let the motor driver get too hot and switch itself off at *at_ns*, until the next power-up."""
        self.advance_to(at_ns)
        self._driver_flags |= OVERTEMPERATURE
        self._halt(at_ns)

    # --- datagrams -------------------------------------------------------------------------------------------------

    def _accept(self, raw: bytes, at_ns: int) -> None:
        """Let a command take effect after the firmware's latency, behind the reply to the one before it."""
        if raw[0] != self.config.address:
            return
        latency_ns = self._random.randint(*self.config.latency_us) * NS_PER_US
        due_ns = max(at_ns, self._free_ns) + latency_ns
        self._free_ns = due_ns + Datagram.LENGTH * self.byte_ns
        self._agenda.queue(due_ns, partial(self._execute, Datagram.read(raw)))

    def _execute(self, asked: Datagram | None, at_ns: int) -> None:
        if asked is None:
            self._reply(0, Status.WRONG_CHECKSUM, 0, at_ns)
            return
        if asked.command == 136 and asked.kind == 0:
            text = f"{self.config.module:04d}V{self.config.version:03d}"
            self._output.append((at_ns, bytes((self.config.host,)) + text.encode("ascii")))
            return
        handlers = {
            1: self._rotate,
            2: self._rotate,
            3: self._stop,
            4: self._move,
            5: self._set_axis,
            6: self._get_axis,
            9: self._set_global,
            10: self._get_global,
            13: self._search,
            14: self._set_port,
            15: self._get_port,
            136: self._version,
        }
        handler = handlers.get(asked.command)
        if handler is None:
            self._reply(asked.command, Status.INVALID_COMMAND, asked.value, at_ns)
            return
        if self.iris_motor is not None and asked.bank == self.iris_axis and asked.command in range(1, 7):
            answer = self._obey_iris(self.iris_motor, asked, at_ns)
        else:
            answer = handler(asked, at_ns)
        if isinstance(answer, Status):
            self._reply(asked.command, answer, asked.value, at_ns)
        else:
            self._reply(asked.command, Status.OK, answer, at_ns)

    def _reply(self, command: int, status: Status, value: int, at_ns: int) -> None:
        raw = reply_bytes(self.config.host, self.config.address, status, command, value)
        self._output.append((at_ns, raw))

    def _version(self, asked: Datagram, at_ns: int) -> int | Status:
        del at_ns
        if asked.kind != 1:
            return Status.WRONG_TYPE
        return self.config.module << 16 | self.config.version // 100 << 8 | self.config.version % 100

    # --- motion ----------------------------------------------------------------------------------------------------

    def _rotate(self, asked: Datagram, at_ns: int) -> int | Status:
        if asked.bank:
            return Status.INVALID_VALUE
        self._run(asked.value if asked.command == 1 else -asked.value, at_ns)
        return asked.value

    def _stop(self, asked: Datagram, at_ns: int) -> int | Status:
        if asked.bank:
            return Status.INVALID_VALUE
        if not self.config.ignore_stop:
            self._run(0, at_ns)
        return asked.value

    def _run(self, speed: int, at_ns: int) -> None:
        self._velocity_mode = True
        self._axis.ramp(at_ns, self._driven(speed * self._units.speed_sps), self._acceleration_sps2())
        self._watch_switches()

    def _move(self, asked: Datagram, at_ns: int) -> int | Status:
        if asked.kind not in {0, 1}:
            return Status.WRONG_TYPE
        if asked.bank:
            return Status.INVALID_VALUE
        self._target = asked.value if asked.kind == 0 else self._axis.count_at(at_ns) + asked.value
        self._go(at_ns)
        return self._target

    def _go(self, at_ns: int) -> None:
        self._velocity_mode = False
        speed = max(self._parameters[4], 1) * self._units.speed_sps
        if not self._driver_flags:
            self._axis.move_to(at_ns, self._target, speed, self._acceleration_sps2())
        self._watch_switches()

    def _driven(self, velocity_sps: float) -> float:
        return 0.0 if self._driver_flags else velocity_sps

    def _halt(self, at_ns: int) -> None:
        self._velocity_mode = True
        self._axis.halt(at_ns)
        self._watch_switches()

    def _acceleration_sps2(self) -> float:
        return max(self._parameters[5], 1) * self._units.acceleration_sps2

    # --- switches and the reference search -------------------------------------------------------------------------

    def _search(self, asked: Datagram, at_ns: int) -> int | Status:
        if asked.kind == 2:
            return {Search.NO: 0, Search.TOWARDS: 1, Search.AWAY: 3}[self._axis.search]
        if asked.kind == 1:
            if self._axis.search is not Search.NO:
                self._run(0, at_ns)
            return 0
        if asked.kind != 0:
            return Status.WRONG_TYPE
        if self._parameters[193] != 1 or self._parameters[13]:
            return Status.INVALID_VALUE  # of the search modes, the simulated lens has the switches for one
        self._axis.home(
            at_ns,
            upwards=False,
            towards_sps=self._parameters[194] * self._units.speed_sps,
            away_sps=self._parameters[195] * self._units.speed_sps,
            acceleration_sps2=self._acceleration_sps2(),
        )
        self._watch_switches()
        return 0

    def _watch_switches(self) -> None:
        off = self._axis.search is Search.NO and (self._parameters.get(12) or self._parameters.get(13))
        self._agenda.put("switch", None if off else self._axis.switch_ns, self._switch)

    def _switch(self, at_ns: int) -> None:
        if self._axis.happen(at_ns) in {Happened.HOMED, Happened.LIMIT}:
            self._velocity_mode = True
            self._target = self._axis.count_at(at_ns + NS_PER_MS)
        self._watch_switches()

    # --- parameters ------------------------------------------------------------------------------------------------

    def _power_up(self, at_ns: int, *, referenced: bool) -> None:
        self._axis.power_up(at_ns, referenced=referenced)
        self._parameters = dict(AXIS_DEFAULTS)
        if self._units.internal:
            self._parameters |= {153: self.config.ramp_divisor, 154: self.config.pulse_divisor, 4: 1000, 5: 500}
        self._globals = {(2, MARK_VARIABLE): REFERENCED_MARK} if referenced else {}
        self._velocity_mode, self._driver_flags = True, 0
        self._iris_speed = AXIS_DEFAULTS[4]
        if self.iris_motor is not None:
            self.iris_motor.set_count(at_ns, 0)
        self._target = self._axis.count_at(at_ns)
        self._free_ns = at_ns
        self._watch_switches()

    def _set_axis(self, asked: Datagram, at_ns: int) -> int | Status:
        kind, value = asked.kind, asked.value
        if kind not in self._parameters or kind in READ_ONLY:
            return Status.WRONG_TYPE
        if asked.bank or (kind in {4, 5, 194, 195} and not 0 <= value <= self._units.largest):
            return Status.INVALID_VALUE
        self._parameters[kind] = value
        if kind == 0:
            self._target = value
            self._go(at_ns)
        elif kind == 1:
            self._axis.set_count(at_ns, value)
            self._target = value
        elif kind == 2:
            self._run(value, at_ns)
        elif kind == MAX_CURRENT:
            (self.lens.release if value else self.lens.stick)(at_ns)  # without a current no field holds the rotor
        elif kind in {4, 5} and not self._velocity_mode and self._axis.search is Search.NO:
            self._go(at_ns)
        return value

    def _get_axis(self, asked: Datagram, at_ns: int) -> int | Status:
        if asked.kind not in self._parameters:
            return Status.WRONG_TYPE
        if asked.bank:
            return Status.INVALID_VALUE
        position, velocity = self._axis.count_at(at_ns), self._axis.velocity_at(at_ns)
        low, high = self._axis.at_switches(at_ns)
        now = {
            0: self._target,
            1: position,
            3: int(velocity / self._units.speed_sps),
            8: int(position == self._target and velocity == 0.0),
            10: int(high),
            11: int(low),
            208: self._driver_flags,
        }
        return now.get(asked.kind, self._parameters[asked.kind])

    def _set_global(self, asked: Datagram, at_ns: int) -> int | Status:
        del at_ns
        if asked.bank not in {0, 2}:
            return Status.INVALID_VALUE
        self._globals[asked.bank, asked.kind] = as_signed(asked.value)
        return asked.value

    def _get_global(self, asked: Datagram, at_ns: int) -> int | Status:
        del at_ns
        if asked.bank not in {0, 2}:
            return Status.INVALID_VALUE
        return self._globals.get((asked.bank, asked.kind), 0)

    def _set_port(self, asked: Datagram, at_ns: int) -> int | Status:
        del at_ns
        if asked.bank != 2 or asked.kind > 7 or asked.value not in {0, 1}:
            return Status.INVALID_VALUE
        self._ports[asked.kind] = asked.value
        return asked.value

    @property
    def outputs(self) -> dict[str, bool]:
        """The outputs that were switched, by name: for tests."""
        return {f"out{port}": value != 0 for port, value in self._ports.items()}

    def _get_port(self, asked: Datagram, at_ns: int) -> int | Status:
        del at_ns
        if asked.bank > 2 or asked.kind > 7:
            return Status.INVALID_VALUE
        return self._ports.get(asked.kind, 0) if asked.bank == 2 else 0


BOARD = ServedBoard(TmclBoard, TmclConfig)
"""The entry point ``elpd.boards: tmcl``."""
