"""A Pololu Tic on its TTL serial port: the protocol in front of a simulated lens.

Bytes in, bytes out, as the vendor's user's guide has them (sections 5 to 9): compact and Pololu framing, quick, 7-bit,
32-bit and block-read commands, optional CRC-7, the variables and settings that the vendor's and third-party clients
read, errors with their soft response, safe start, command timeout, homing and limit switches. Motion itself is the
lens's; this file only decides what to ask of it. Speeds on the wire are microsteps per 10 000 s, accelerations
microsteps/s per 100 s.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import partial
from typing import TYPE_CHECKING

from elpd.units import NS_PER_MS, NS_PER_S
from elpd_drivers.sim.boards.agenda import Agenda
from elpd_drivers.sim.boards.axis import Axis, Happened, Search, last_step
from elpd_drivers.sim.boards.served import ServedBoard
from elpd_drivers.sim.boards.tic_words import (
    BLOCK,
    CLEARS_SERIAL_ERROR,
    LONG,
    MAX_BLOCK,
    NOT_A_COMMAND,
    SEVEN_BIT,
    MemoryMap,
    crc7,
    decode_long,
    payload_length,
)

if TYPE_CHECKING:
    from elpd_drivers.sim.lens import SimulatedLens

SPEED_UNIT = 10_000
ACCELERATION_UNIT = 100


class TicError(IntFlag):
    """Bits of "error status", and of "errors occurred"."""

    DEENERGIZED = 1 << 0
    DRIVER = 1 << 1
    LOW_VIN = 1 << 2
    KILL_SWITCH = 1 << 3
    INPUT_INVALID = 1 << 4
    SERIAL = 1 << 5
    COMMAND_TIMEOUT = 1 << 6
    SAFE_START = 1 << 7
    ERR_LINE = 1 << 8
    SERIAL_FORMAT = 1 << 18
    SERIAL_CRC = 1 << 19


class _Operation(IntEnum):
    RESET = 0
    DEENERGIZED = 2
    SOFT_ERROR = 4
    NORMAL = 10


class _Plan(IntEnum):
    OFF = 0
    POSITION = 1
    VELOCITY = 2


class _Input(IntEnum):
    HALT = 2
    POSITION = 3
    VELOCITY = 4


@dataclass(frozen=True, slots=True)
class TicConfig:
    """How a Tic is set up (its non-volatile settings) and how its day began.

    ``referenced`` begins with a position that is certain and equals the lens's own, as after an earlier homing;
    otherwise the count begins at 0 with "position uncertain". ``latency_us`` is the firmware's time from the last
    byte of a command to its effect, uniform between the two.
    """

    device_number: int = 14
    crc_commands: bool = False
    crc_responses: bool = False
    command_timeout_ms: int = 1000
    baud: int = 115_385
    max_speed: int = 200_000_000
    max_acceleration: int = 64_000_000
    homing_speed_towards: int = 32_000_000
    homing_speed_away: int = 4_000_000
    limit_switches: bool = True
    step_mode: int = 7
    referenced: bool = False
    latency_us: tuple[int, int] = (50, 150)
    ignore_stop: bool = False


class TicBoard:
    """A simulated Tic. See ``boards.line.SimulatedBoard`` for the three methods that a wire calls.

    Parameters
    ----------
    lens
        What its motor turns.
    config
        Its settings.
    seed
        For the firmware's latency.
    begin_ns
        When it was powered up.
    """

    def __init__(
        self, lens: SimulatedLens, config: TicConfig | None = None, *, seed: int = 0, begin_ns: int = 0
    ) -> None:
        self.lens = lens
        self.config = config or TicConfig()
        self.byte_ns = round(10 * NS_PER_S / self.config.baud)
        self._random = random.Random(seed)  # noqa: S311  (latency, not secrets)
        self._frame = bytearray()
        self._output: list[tuple[int, bytes]] = []
        self._begin_ns = begin_ns
        self._agenda = Agenda(begin_ns)
        self._axis = Axis(lens, switches=self.config.limit_switches)
        self._errors = self._occurred = TicError(0)
        self._plan, self._input = _Plan.OFF, _Input.HALT
        self._target = 0
        self._uncertain = True
        self._max_speed = self._max_acceleration = self._max_deceleration = self._starting_speed = 0
        self._seven_bit: dict[int, int] = {}
        self._power_up(begin_ns, referenced=self.config.referenced)

    # --- the wire's side -------------------------------------------------------------------------------------------

    def receive(self, data: bytes, at_ns: int) -> None:
        """Take bytes whose last one is complete at *at_ns*."""
        self.advance_to(at_ns)
        for byte in data:
            if byte & 0x80:
                if self._frame:
                    self._serial_error(TicError.SERIAL_FORMAT, at_ns)
                self._frame = bytearray((byte,))
            elif self._frame:
                self._frame.append(byte)
            self._frame_complete(at_ns)

    def advance_to(self, when_ns: int) -> None:
        """Let pending commands, the timeout and the limit switches happen, in the order of their times."""
        self._agenda.run_until(when_ns)
        self.lens.advance(self._agenda.now_ns)

    def take_output(self) -> list[tuple[int, bytes]]:
        """Return (and forget) the responses, each with the instant at which it was handed to the wire."""
        output, self._output = self._output, []
        return output

    def reset_at(self, at_ns: int) -> None:
        """Let the supply brown out at *at_ns*: everything forgotten, motor halted, position unknown."""
        self.advance_to(at_ns)
        self.lens.halt(at_ns)
        self._agenda.clear()
        self._power_up(at_ns, referenced=False)

    def alarm_at(self, at_ns: int) -> None:
        """Let the motor driver fail at *at_ns*: coils off, position unknown; it works again after the next command."""
        self.advance_to(at_ns)
        self._raise_errors(TicError.DRIVER, at_ns)
        self._halt(at_ns)
        self._uncertain = True

    # --- framing ---------------------------------------------------------------------------------------------------

    def _frame_complete(self, at_ns: int) -> None:
        """Take the frame off if its last byte has come; unknown or damaged ones become a serial error."""
        frame = self._frame
        pololu = bool(frame) and frame[0] == 0xAA
        if not frame or (pololu and len(frame) < 3):
            return
        command = frame[2] | 0x80 if pololu else frame[0]
        header = 3 if pololu else 1
        length = payload_length(command)
        if length is None:
            self._frame = bytearray()
            self._serial_error(TicError.SERIAL_FORMAT, at_ns)
            return
        if len(frame) < header + length + self.config.crc_commands:
            return
        self._frame = bytearray()
        if self.config.crc_commands and crc7(bytes(frame[:-1])) != frame[-1]:
            self._serial_error(TicError.SERIAL_CRC, at_ns)
            return
        if pololu and frame[1] != self.config.device_number:
            return
        self._queue(command, bytes(frame[header : header + length]), at_ns)

    def _queue(self, command: int, payload: bytes, at_ns: int) -> None:
        """Let a command take effect after the firmware's latency, and never before an earlier one."""
        latency_ns = self._random.randint(*self.config.latency_us) * 1000
        self._agenda.queue(at_ns + latency_ns, partial(self._execute, command, payload))

    def _serial_error(self, error: TicError, at_ns: int) -> None:
        self._queue(NOT_A_COMMAND, int(error).to_bytes(4, "little"), at_ns)

    def _execute(self, command: int, payload: bytes, at_ns: int) -> None:
        if command in CLEARS_SERIAL_ERROR:
            self._errors &= ~TicError.SERIAL
        if command in CLEARS_SERIAL_ERROR or command == 0x8C:
            self._errors &= ~TicError.COMMAND_TIMEOUT
            self._restart_timeout(at_ns)
        if command == NOT_A_COMMAND:
            self._occurred |= TicError(int.from_bytes(payload, "little"))
            self._raise_errors(TicError.SERIAL, at_ns)
        elif command in BLOCK:
            self._answer(command, payload, at_ns)
        elif command in LONG:
            self._execute_long(command, decode_long(payload), at_ns)
        elif command in SEVEN_BIT:
            self._execute_seven_bit(command, payload[0], at_ns)
        else:
            self._execute_quick(command, at_ns)

    def _execute_long(self, command: int, value: int, at_ns: int) -> None:
        if command == 0xE0:
            self._aim(_Plan.POSITION, value, at_ns)
        elif command == 0xE3:
            self._aim(_Plan.VELOCITY, value, at_ns)
        elif command == 0xEC:
            self._halt(at_ns)
            self._axis.set_count(at_ns, value)
            self._uncertain = False
        elif command == 0xE5:
            self._starting_speed = value & 0xFFFF_FFFF
        elif command == 0xE6:
            self._max_speed = min(value & 0xFFFF_FFFF, 500_000_000)
            if self._plan is not _Plan.OFF:
                self._aim(self._plan, self._target, at_ns)
        elif command == 0xE9:
            self._max_deceleration = (value & 0xFFFF_FFFF) or self._max_acceleration
        else:
            self._max_acceleration = max(value & 0xFFFF_FFFF, 100)

    def _execute_seven_bit(self, command: int, value: int, at_ns: int) -> None:
        if command == 0x97:
            self._go_home(at_ns, forward=bool(value))
        else:
            self._seven_bit[command] = value

    def _execute_quick(self, command: int, at_ns: int) -> None:
        if command == 0x83:
            self._errors &= ~TicError.SAFE_START
        elif command == 0x85:
            self._errors &= ~TicError.DEENERGIZED
        elif command == 0x86:
            self._errors |= TicError.DEENERGIZED
            self._occurred |= TicError.DEENERGIZED
            self._halt(at_ns)
            self._uncertain = True
        elif command == 0x89:
            if self.config.ignore_stop:
                return
            self._halt(at_ns)
            self._uncertain = True
        elif command == 0x8F:
            self._raise_errors(TicError.SAFE_START, at_ns)
        elif command == 0xB0:
            # "Reset" reloads the settings and halts; the position stays, uncertain
            self._halt(at_ns)
            self._load_settings()
            self._uncertain = True
            self._errors = TicError.SAFE_START

    # --- motion ----------------------------------------------------------------------------------------------------

    def _aim(self, plan: _Plan, target: int, at_ns: int) -> None:
        """Plan towards a target, unless an error forbids it."""
        if self._errors:
            return
        self._plan, self._target = plan, target
        self._input = _Input.POSITION if plan is _Plan.POSITION else _Input.VELOCITY
        speed, a = self._max_speed / SPEED_UNIT, self._acceleration_sps2()
        if plan is _Plan.POSITION:
            self._axis.move_to(at_ns, target, speed, a)
        else:
            self._axis.ramp(at_ns, min(max(target / SPEED_UNIT, -speed), speed), a)
        self._watch_switches()

    def _halt(self, at_ns: int) -> None:
        self._plan, self._input = _Plan.OFF, _Input.HALT
        self._axis.halt(at_ns)
        self._watch_switches()

    def _raise_errors(self, errors: TicError, at_ns: int) -> None:
        """Note errors and give the soft response: decelerate to hold. Any error violates safe start, too."""
        self._errors |= errors | TicError.SAFE_START
        self._occurred |= errors
        self._plan, self._input = _Plan.OFF, _Input.HALT
        self._axis.ramp(at_ns, 0.0, self._acceleration_sps2())
        self._watch_switches()

    def _acceleration_sps2(self) -> float:
        return self._max_acceleration * 1.0 / ACCELERATION_UNIT

    # --- limit switches and homing ---------------------------------------------------------------------------------

    def _watch_switches(self) -> None:
        self._agenda.put("switch", self._axis.switch_ns, self._switch)

    def _switch(self, at_ns: int) -> None:
        happened = self._axis.happen(at_ns)
        if happened in {Happened.HOMED, Happened.LIMIT}:
            self._plan, self._input = _Plan.OFF, _Input.HALT
            self._uncertain = happened is Happened.LIMIT
        self._watch_switches()

    def _go_home(self, at_ns: int, *, forward: bool) -> None:
        if self._errors or not self.config.limit_switches:
            return
        self._plan = _Plan.OFF
        self._axis.home(
            at_ns,
            upwards=forward,
            towards_sps=self.config.homing_speed_towards / SPEED_UNIT,
            away_sps=self.config.homing_speed_away / SPEED_UNIT,
            acceleration_sps2=self._acceleration_sps2(),
        )
        self._watch_switches()

    # --- state -----------------------------------------------------------------------------------------------------

    def _power_up(self, at_ns: int, *, referenced: bool) -> None:
        self._begin_ns = at_ns
        self._errors = TicError.SAFE_START
        self._occurred = TicError(0)
        self._uncertain = not referenced
        self._plan, self._input, self._target = _Plan.OFF, _Input.HALT, 0
        self._axis.power_up(at_ns, referenced=referenced)
        self._watch_switches()
        self._load_settings()
        self._restart_timeout(at_ns)

    def _load_settings(self) -> None:
        self._max_speed = self.config.max_speed
        self._max_acceleration = self._max_deceleration = self.config.max_acceleration
        self._starting_speed = 0
        self._seven_bit = {0x91: 32, 0x92: 0, 0x94: self.config.step_mode, 0x98: 0}

    def _restart_timeout(self, at_ns: int) -> None:
        timeout_ms = self.config.command_timeout_ms
        due_ns = at_ns + timeout_ms * NS_PER_MS if timeout_ms else None
        self._agenda.put("timeout", due_ns, partial(self._raise_errors, TicError.COMMAND_TIMEOUT))

    def _answer(self, command: int, payload: bytes, at_ns: int) -> None:
        offset, length = payload[0] | (payload[1] & 0x40) << 1, payload[1] & 0x3F
        if not 1 <= length <= MAX_BLOCK:
            self._serial_error(TicError.SERIAL_FORMAT, at_ns)
            return
        table = self._settings() if command == 0xA8 else self._variables(at_ns)
        answer = bytes(table[offset : offset + length].ljust(length, b"\0"))
        if command == 0xA2:
            self._occurred = TicError(0)
        if self.config.crc_responses:
            answer += bytes((crc7(answer),))
        self._output.append((at_ns, answer))

    def _variables(self, at_ns: int) -> bytearray:
        """Return the 256 bytes that "get variable" reads from."""
        position, velocity = self._axis.count_at(at_ns), self._axis.velocity_at(at_ns)
        low, high = self._axis.at_switches(at_ns)
        flags = (
            (TicError.DEENERGIZED not in self._errors)
            | self._uncertain << 1
            | high << 2
            | low << 3
            | (self._axis.search is not Search.NO) << 4
        )
        state = _Operation.NORMAL
        if self._errors:
            state = _Operation.DEENERGIZED if TicError.DEENERGIZED in self._errors else _Operation.SOFT_ERROR
        since_ns = self._since_last_step_ns(at_ns)
        table = MemoryMap()
        table.put(0x00, 1, state)
        table.put(0x01, 1, flags)
        table.put(0x02, 2, self._errors & 0xFFFF)
        table.put(0x04, 4, self._occurred | self._errors)
        table.put(0x09, 1, self._plan)
        table.put(0x0A, 4, self._target if self._plan is _Plan.POSITION else 0)
        table.put(0x0E, 4, self._target if self._plan is _Plan.VELOCITY else 0)
        table.put(0x12, 4, self._starting_speed)
        table.put(0x16, 4, self._max_speed)
        table.put(0x1A, 4, self._max_deceleration)
        table.put(0x1E, 4, self._max_acceleration)
        table.put(0x22, 4, position)
        table.put(0x26, 4, round(velocity * SPEED_UNIT))
        table.put(0x2A, 4, self._target if self._plan is _Plan.POSITION else position)
        table.put(0x2E, 4, min(since_ns * 3 // 1000, 0xFFFF_FFFF))
        table.put(0x33, 2, 12_000)
        table.put(0x35, 4, (at_ns - self._begin_ns) // NS_PER_MS)
        for offset in (0x3F, 0x41, 0x43, 0x45):
            table.put(offset, 2, 0xFFFF)
        table.put(0x47, 1, 0x1F)
        table.put(0x48, 1, 0x50)
        table.put(0x49, 1, self._seven_bit[0x94])
        table.put(0x4A, 1, self._seven_bit[0x91])
        table.put(0x4B, 1, self._seven_bit[0x92])
        table.put(0x4C, 1, self._input)
        return table.data

    def _since_last_step_ns(self, at_ns: int) -> int:
        velocity = self.lens.velocity_at(at_ns)
        if velocity:
            pulses = self.lens.pulses_at(at_ns)
            return round(abs(pulses - last_step(pulses, velocity)) / abs(velocity) * NS_PER_S)
        return max(0, at_ns - max(self.lens.rest_from_ns() or 0, self._begin_ns))

    def _settings(self) -> bytearray:
        """Return the 256 bytes that "get setting" reads from; what is not simulated is 0."""
        config, table = self.config, MemoryMap()
        table.put(0x06, 2, round(12_000_000 / config.baud))
        table.put(0x07, 1, config.device_number & 0x7F)
        table.put(0x09, 2, config.command_timeout_ms)
        table.put(0x0B, 1, config.crc_commands | config.crc_responses << 1)
        table.put(0x31, 1, 0xFF)
        table.put(0x40, 1, 32)
        table.put(0x41, 1, config.step_mode)
        table.put(0x47, 4, config.max_speed)
        table.put(0x4B, 4, config.max_acceleration)
        table.put(0x4F, 4, config.max_acceleration)
        table.put(0x53, 1, 2)
        table.put(0x5F, 1, 1 if config.limit_switches else 0)
        table.put(0x60, 1, 2 if config.limit_switches else 0)
        table.put(0x61, 4, config.homing_speed_towards)
        table.put(0x65, 4, config.homing_speed_away)
        return table.data


BOARD = ServedBoard(TicBoard, TicConfig)
"""The entry point ``elpd.boards: tic``."""
