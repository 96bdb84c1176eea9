"""A Zaber device (firmware 7, ASCII protocol) in front of a simulated lens; a second axis may turn an iris.

What matters to whoever drives one: every message may carry a number and a checksum, a wrong checksum is silence;
replies say whether the axis is busy and the most serious warning there is; after power-up the axis has no reference
("WR") and refuses absolute moves until it was homed; a limit sensor that is met unexpectedly ends the motion and sets
"WL" until the next one; moves may carry their own speed and acceleration; ``stop`` brakes, ``estop`` does not.
Settings are in the device's units: 1.6384 per microstep/s, 1.6384 per 10 000 microsteps/s².
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from elpd.units import NS_PER_S, NS_PER_US
from elpd_drivers.sim.boards.agenda import Agenda
from elpd_drivers.sim.boards.axis import Axis, Happened, Search
from elpd_drivers.sim.boards.served import ServedBoard

if TYPE_CHECKING:
    from elpd_drivers.sim.aperture import StepperIris
    from elpd_drivers.sim.lens import SimulatedLens

SPEED_UNIT, ACCELERATION_UNIT = 1.6384, 1.6384e-4
LINE_LENGTH = 80
HOMING_S = 0.5
"""How long an iris takes for its whole way while it is homed."""
SEVERITY = ("FM", "FO", "WL", "WR", "WH", "NI")


class RefusedError(Exception):
    """A command that is answered with RJ and the reason."""


@dataclass(frozen=True, slots=True)
class ZaberConfig:
    """How a device is set up and how its day began.

    ``checksum`` is its setting comm.checksum: whether its own messages carry one. ``referenced`` begins homed.
    ``latency_us`` is the firmware's time from a command's last byte to its effect and reply, uniform between the two.
    """

    speed_um_s: float = 12_000.0
    acceleration_um_s2: float = 200_000.0
    device: int = 1
    baud: int = 115_200
    version: str = "7.38"
    checksum: bool = True
    alerts: bool = False
    referenced: bool = False
    latency_us: tuple[int, int] = (150, 450)
    ignore_stop: bool = False


class ZaberBoard:
    """A simulated Zaber device. See ``boards.line.SimulatedBoard`` for the three methods that a wire calls.

    Parameters
    ----------
    lens
        What its axis 1 turns.
    config
        Its settings.
    seed
        For the firmware's latency.
    begin_ns
        When it was powered up.
    """

    def __init__(
        self, lens: SimulatedLens, config: ZaberConfig | None = None, *, seed: int = 0, begin_ns: int = 0
    ) -> None:
        self.lens = lens
        self.config = config or ZaberConfig()
        self.byte_ns = round(10 * NS_PER_S / self.config.baud)
        self._random = random.Random(seed)  # noqa: S311  (latency, not secrets)
        self._agenda = Agenda(begin_ns)
        self._axis = Axis(lens)
        self._partial = bytearray()
        self._output: list[tuple[int, bytes]] = []
        self._flags: set[str] = set()
        self.iris: StepperIris | None = None
        """What axis 2 turns, if there is one."""
        self._iris_flags: set[str] = {"WR", "WH"}
        self._iris_rest_ns = begin_ns
        self.outputs: dict[str, bool] = {}
        """The digital outputs that were switched, by name: for tests."""
        self._settings: dict[str, float | str] = {}
        self._power_up(begin_ns, referenced=self.config.referenced)

    # --- the wire's side -------------------------------------------------------------------------------------------

    def receive(self, data: bytes, at_ns: int) -> None:
        """Take bytes whose last one is complete at *at_ns*."""
        self.advance_to(at_ns)
        for byte in data:
            if byte in b"\r\n":
                line = self._partial.decode("ascii", "replace")
                self._partial.clear()
                if line:
                    latency_ns = self._random.randint(*self.config.latency_us) * NS_PER_US
                    self._agenda.queue(at_ns + latency_ns, partial(self._take_line, line))
            elif len(self._partial) < 2 * LINE_LENGTH:
                self._partial.append(byte)

    iris_axis = 2
    """Which of its axes turns it."""

    def add_iris(self, iris: StepperIris) -> None:
        """Put an iris on axis 2."""
        self.iris = iris
        self._settings["system.axiscount"] = 2

    def advance_to(self, when_ns: int) -> None:
        """Let pending commands and the limit sensors happen, in the order of their times."""
        self._agenda.run_until(when_ns)
        self.lens.advance(self._agenda.now_ns)

    def take_output(self) -> list[tuple[int, bytes]]:
        """Return (and forget) the messages, each with the instant at which it was handed to the wire."""
        output, self._output = self._output, []
        return output

    def reset_at(self, at_ns: int) -> None:
        """Let the supply brown out at *at_ns*: motor halted, no reference."""
        self.advance_to(at_ns)
        self.lens.halt(at_ns)
        self._agenda.clear()
        self._partial.clear()
        self._power_up(at_ns, referenced=False)

    def alarm_at(self, at_ns: int) -> None:
        """Let the motor driver get too hot and switch itself off at *at_ns*."""
        self.advance_to(at_ns)
        self._flags.add("FM")
        self._axis.halt(at_ns)
        self._watch_limits()
        self._alert(at_ns)

    # --- messages --------------------------------------------------------------------------------------------------

    def _take_line(self, line: str, at_ns: int) -> None:
        start = line.rfind("/")
        if start < 0:
            return
        line = line[start:]
        if len(line) > 3 and line[-3] == ":":
            line, given = line[:-3], line[-2:]
            if given != _checksum(line):
                return  # as if it had not been said
        words = line[1:].split()
        numbers = [int(words.pop(0)) for _ in range(3) if words and words[0].isdigit()]
        device, axis = (*numbers, 0, 0)[:2]
        number = numbers[2] if len(numbers) > 2 else None
        if device not in {0, self.config.device}:
            return
        try:
            if axis == self.iris_axis and self.iris is not None:
                data, verdict = self._obey_iris(self.iris, words, at_ns), "OK"
            elif axis not in {0, 1}:
                raise RefusedError("BADAXIS")
            else:
                data, verdict = self._obey(words, at_ns), "OK"
        except RefusedError as refused:
            data, verdict = str(refused), "RJ"
        numbered = "" if number is None else f" {number:02d}"
        status = self._iris_status(at_ns) if axis == self.iris_axis and self.iris is not None else self._status(at_ns)
        self._say(f"@{self.config.device:02d} {axis}{numbered} {verdict} {status} {data}", at_ns)

    def _say(self, message: str, at_ns: int) -> None:
        if self.config.checksum:
            message += f":{_checksum(message)}"
        self._output.append((at_ns, f"{message}\r\n".encode("ascii")))

    def _alert(self, at_ns: int) -> None:
        if self.config.alerts:
            self._say(f"!{self.config.device:02d} 1 {self._status(at_ns)}", at_ns)

    def _status(self, at_ns: int) -> str:
        flag = next((flag for flag in SEVERITY if flag in self._flags), "--")
        return f"{'BUSY' if self._busy(at_ns) else 'IDLE'} {flag}"

    def _busy(self, at_ns: int) -> bool:
        rest_ns = self.lens.rest_from_ns()
        return self._axis.search is not Search.NO or rest_ns is None or rest_ns > at_ns

    def _obey(self, words: list[str], at_ns: int) -> str:
        match words:
            case []:
                return "0"
            case ["get", name]:
                return self._get(name, at_ns)
            case ["set", name, value]:
                return self._set(name, value, at_ns)
            case ["move", "abs" | "rel" | "vel" | "min" | "max" as kind, *values]:
                return self._move(kind, values, at_ns)
            case ["home"]:
                return self._home(at_ns)
            case ["stop"]:
                return self._stop(at_ns, abrupt=False)
            case ["estop"]:
                return self._stop(at_ns, abrupt=True)
            case ["warnings", *clear] if clear in ([], ["clear"]):
                return self._warnings(clear=bool(clear))
            case ["io", "set", "do", port, "0" | "1" as level]:
                return self._switch(port, level)
            case ["driver", "disable" | "enable" as which]:
                return self._driver(at_ns, on=which == "enable")
        raise RefusedError("BADCOMMAND")

    # --- axis 2 ----------------------------------------------------------------------------------------------------

    def _obey_iris(self, iris: StepperIris, words: list[str], at_ns: int) -> str:
        speed_sps = self._setting("maxspeed", {}) / SPEED_UNIT
        match words:
            case ["get", "pos"]:
                return str(round(float(iris.steps_at(at_ns))))
            case ["get", "limit.max"]:
                return str(round(iris.steps))
            case ["get", name]:
                return self._get(name, at_ns)
            case ["home"]:
                self._iris_flags.clear()
                self._iris_rest_ns = iris.turn(at_ns, 0.0, min(speed_sps, iris.steps / HOMING_S))
            case ["stop" | "estop"]:
                iris.halt(at_ns)
                self._iris_rest_ns = at_ns
            case ["move", "abs", target, *more] if len(more) <= 2:
                goal = _number(target)
                if self._iris_flags or not 0.0 <= goal <= iris.steps:
                    raise RefusedError("BADDATA")
                wanted_sps = _number(more[0]) / SPEED_UNIT if more else speed_sps
                self._iris_rest_ns = iris.turn(at_ns, goal, wanted_sps)
            case _:
                raise RefusedError("BADCOMMAND")
        return "0"

    def _iris_status(self, at_ns: int) -> str:
        flag = next((flag for flag in SEVERITY if flag in self._iris_flags), "--")
        return f"{'BUSY' if self._iris_rest_ns > at_ns else 'IDLE'} {flag}"

    # --- motion ----------------------------------------------------------------------------------------------------

    def _move(self, kind: str, values: list[str], at_ns: int) -> str:
        needed = 0 if kind in {"min", "max"} else 1
        if not needed <= len(values) <= needed + (1 if kind == "vel" else 2):
            raise RefusedError("BADDATA")
        numbers = [_number(value) for value in values]
        if "FO" in self._flags or "FM" in self._flags:
            raise RefusedError("DRIVERDISABLED")
        optional = dict(zip(("accel",) if kind == "vel" else ("maxspeed", "accel"), numbers[needed:], strict=False))
        acceleration = self._setting("accel", optional) / ACCELERATION_UNIT
        if kind == "vel":
            if abs(numbers[0]) > self._setting("maxspeed", {}) * 2:
                raise RefusedError("BADDATA")
            self._begin_motion()
            self._axis.ramp(at_ns, numbers[0] / SPEED_UNIT, acceleration)
        else:
            target = {"min": "limit.min", "max": "limit.max"}.get(kind)
            goal = self._setting(target, {}) if target else numbers[0]
            goal += self._axis.count_at(at_ns) if kind == "rel" else 0
            bounded = self._setting("limit.min", {}) <= goal <= self._setting("limit.max", {})
            if "WR" in self._flags or not bounded:
                raise RefusedError("BADDATA")
            self._begin_motion()
            self._axis.move_to(at_ns, round(goal), self._setting("maxspeed", optional) / SPEED_UNIT, acceleration)
        self._watch_limits()
        return "0"

    def _begin_motion(self) -> None:
        self._flags -= {"WL", "NI"}

    def _stop(self, at_ns: int, *, abrupt: bool) -> str:
        if self.config.ignore_stop:
            return "0"
        if self._busy(at_ns):
            self._flags.add("NI")
        if abrupt:
            self._axis.halt(at_ns)
        else:
            self._axis.ramp(at_ns, 0.0, self._setting("motion.decelonly", {}) / ACCELERATION_UNIT)
        self._watch_limits()
        return "0"

    def _driver(self, at_ns: int, *, on: bool) -> str:
        if on:
            self._flags -= {"FO", "FM"}
        else:
            self._flags |= {"FO", "WR"}
            self._axis.halt(at_ns)
            self._watch_limits()
        return "0"

    def _switch(self, port: str, level: str) -> str:
        if port not in {"1", "2", "3", "4"}:
            raise RefusedError("BADDATA")
        self.outputs[f"do{port}"] = level == "1"
        return "0"

    def _home(self, at_ns: int) -> str:
        if "FO" in self._flags or "FM" in self._flags:
            raise RefusedError("DRIVERDISABLED")
        self._begin_motion()
        approach = self._setting("limit.approach.maxspeed", {}) / SPEED_UNIT
        self._axis.home(
            at_ns,
            upwards=False,
            towards_sps=approach,
            away_sps=approach / 8,
            acceleration_sps2=self._setting("accel", {}) / ACCELERATION_UNIT,
        )
        self._watch_limits()
        return "0"

    def _watch_limits(self) -> None:
        self._agenda.put("limit", self._axis.switch_ns, self._limit)

    def _limit(self, at_ns: int) -> None:
        happened = self._axis.happen(at_ns)
        if happened is Happened.HOMED:
            self._flags -= {"WR", "WH"}
            self._agenda.put("alert", self.lens.rest_from_ns(), self._alert)
        elif happened is Happened.LIMIT:
            self._flags.add("WL")
            self._agenda.put("alert", self.lens.rest_from_ns(), self._alert)
        self._watch_limits()

    # --- settings --------------------------------------------------------------------------------------------------

    def _power_up(self, at_ns: int, *, referenced: bool) -> None:
        mechanics, config = self.lens.mechanics, self.config
        self._axis.power_up(at_ns, referenced=referenced)
        self._flags = set() if referenced else {"WR", "WH"}
        acceleration = round(config.acceleration_um_s2 / mechanics.um_per_step * ACCELERATION_UNIT)
        self._settings = {
            "version": config.version,
            "deviceid": 50_081,
            "device.id": 50_081,
            "system.axiscount": 1 if self.iris is None else 2,
            "system.serial": 12_345,
            "resolution": 64,
            "comm.checksum": int(config.checksum),
            "comm.alert": int(config.alerts),
            "limit.min": 0,
            "limit.max": int(self.lens.travel_steps),
            "limit.approach.maxspeed": round(1000 / mechanics.um_per_step * SPEED_UNIT),
            "maxspeed": round(config.speed_um_s / mechanics.um_per_step * SPEED_UNIT),
            "accel": acceleration,
            "motion.accelonly": acceleration,
            "motion.decelonly": acceleration,
        }
        self._watch_limits()

    def _setting(self, name: str, instead: dict[str, float]) -> float:
        """Return a setting, or what a command says instead of it; 0 there means the setting."""
        return instead.get(name) or float(self._settings[name])

    def _get(self, name: str, at_ns: int) -> str:
        if name == "pos":
            return str(self._axis.count_at(at_ns))
        if name == "vel":
            return str(round(self._axis.velocity_at(at_ns) * SPEED_UNIT))
        if name not in self._settings:
            raise RefusedError("BADCOMMAND")
        return str(self._settings[name])

    def _set(self, name: str, value: str, at_ns: int) -> str:
        number = _number(value)
        if name == "pos":
            self._axis.set_count(at_ns, round(number))
            self._flags -= {"WR", "WH"}
        elif name in {"maxspeed", "accel", "motion.accelonly", "motion.decelonly", "limit.approach.maxspeed"}:
            if number < 1:
                raise RefusedError("BADDATA")
            both = ("accel", "motion.accelonly", "motion.decelonly") if name == "accel" else (name,)
            self._settings |= dict.fromkeys(both, round(number))
        else:
            raise RefusedError("BADCOMMAND")
        return "0"

    def _warnings(self, *, clear: bool) -> str:
        flags = [flag for flag in SEVERITY if flag in self._flags]
        if clear:
            self._flags -= {"WL", "NI"}
        return " ".join((f"{len(flags):02d}", *flags))


def _checksum(message: str) -> str:
    return f"{(256 - sum(message[1:].encode('ascii', 'replace')) % 256) % 256:02X}"


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise RefusedError("BADDATA") from None


BOARD = ServedBoard(ZaberBoard, ZaberConfig)
"""The entry point ``elpd.boards: zaber``."""
