"""A GRBL 1.1h board in front of a simulated lens on its X axis.

What matters to whoever focuses through GRBL is modelled as the firmware does it, not as constants:

- *The segment buffer*, behind which a stop bites, is what executes motion: ``grbl_motion``. A reset (0x18) kills the
  pulses at once; in motion, the position is then unsure and the board locked.
- *The main loop.* Real-time bytes are taken out of the stream on arrival; lines wait in a receive buffer of 128
  characters for their turn, and ``ok`` says "planned", not "done".
- *Alarms.* After a hard limit the board says ``ALARM:1`` and then nothing at all until it is reset. After any alarm
  it sleeps for half a second, deaf even to a reset: the banner after an abrupt stop comes that late.

``FS`` tells the speed at the end of the last prepared segment, which is why it reads 0 while the motor still brakes.
Overrides are accepted and have no effect.
"""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.units import NS_PER_MS, NS_PER_S, NS_PER_US
from elpd_drivers.sim.boards import grbl_text as text
from elpd_drivers.sim.boards.axis import last_step
from elpd_drivers.sim.boards.grbl_motion import (
    HARD_LIMIT,
    HOMING_RESET,
    PLANNER_BLOCKS,
    RESET_IN_MOTION,
    SOFT_LIMIT,
    GrblStepper,
)
from elpd_drivers.sim.boards.grbl_text import GrblError, GrblSettings
from elpd_drivers.sim.boards.served import ServedBoard

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from elpd_drivers.sim.lens import SimulatedLens

RX_BUFFER = 128
RESET_NS, ALARM_NS = 25 * NS_PER_MS, 500 * NS_PER_MS
"""A reset first holds the motors for a moment (``$1``); after ``ALARM:`` the firmware sleeps until that is printed."""
CRITICAL = frozenset({HARD_LIMIT, SOFT_LIMIT})
"""Alarms after which nothing is done before a reset."""

REAL_TIME = frozenset({0x18, 0x21, 0x3F, 0x7E, 0x84, 0x85, 0x87, *range(0x90, 0xA0)})


@dataclass(frozen=True, slots=True)
class GrblConfig:
    """How the board is set up and how its day began.

    ``referenced`` begins homed some time ago (Idle, the lower limit switch at minus the travel, no banner); otherwise
    just powered up, locked until ``$H`` or ``$X``.
    ``firmware`` is whose dialect it speaks: grbl, grblhal, fluidnc or sce2. ``line_us`` is how long the firmware
    takes over a line, ``real_time_us`` until it acts on a real-time byte; uniform between the two.
    """

    speed_um_s: float = 12_000.0
    acceleration_um_s2: float = 200_000.0
    baud: int = 115_200
    referenced: bool = False
    firmware: str = "grbl"
    line_us: tuple[int, int] = (1000, 3000)
    real_time_us: tuple[int, int] = (50, 400)
    ignore_stop: bool = False

    def __post_init__(self) -> None:
        """Raise ``ValueError`` for an unknown firmware."""
        if self.firmware not in text.FIRMWARES:
            raise ValueError(f"firmware is {self.firmware!r}; known are {', '.join(text.FIRMWARES)}")


class GrblBoard:
    """A simulated GRBL. See ``boards.line.SimulatedBoard`` for the three methods that a wire calls.

    Parameters
    ----------
    lens
        What its X axis turns.
    config
        How it is set up; the ``$`` settings follow from it and from the lens.
    seed
        For the firmware's latencies.
    begin_ns
        When it was powered up.
    """

    def __init__(
        self, lens: SimulatedLens, config: GrblConfig | None = None, *, seed: int = 0, begin_ns: int = 0
    ) -> None:
        self.lens = lens
        self.config = config or GrblConfig()
        self.byte_ns = round(10 * NS_PER_S / self.config.baud)
        mechanics = lens.mechanics
        self.settings = GrblSettings.for_lens(
            1000 / mechanics.um_per_step,
            mechanics.travel_um / 1000,
            self.config.speed_um_s * 60 / 1000,
            self.config.acceleration_um_s2 / 1000,
        )
        self._firmware = text.FIRMWARES[self.config.firmware]
        self._tool = 0
        self._random = random.Random(seed)  # noqa: S311  (latency, not secrets)
        self._now_ns = begin_ns
        self._output: list[tuple[int, bytes]] = []
        self._partial = bytearray()
        self._overflown = False
        self._lines: deque[tuple[int, str]] = deque()
        self._busy_ns = begin_ns
        self._real_time: deque[tuple[int, int]] = deque()
        self.stepper = GrblStepper(lens, self.settings, self._firmware.prepared, self._alarm, self._homing_over)
        self._silent = self._suspended = False
        self._alarmed: int | None = None
        self.outputs: dict[str, bool] = {}
        """The outputs that were switched, by name: for tests."""
        self._relative, self._feed_mm_min, self._mode = False, 0.0, 0
        self._reports = 0
        self._asked_homing = False
        self._deaf_until_ns = begin_ns
        if self.config.referenced:
            lag = lens.rotor_at(begin_ns) - lens.pulses_at(begin_ns)
            self.stepper.offset = round(lag - self.stepper.steps_per_mm * self.settings[130])
            self.stepper.homed = True
        else:
            self.stepper.offset = -round(lens.pulses_at(begin_ns))
            self.stepper.state = "Alarm"
            self._say_hello(begin_ns)

    # --- the wire's side -------------------------------------------------------------------------------------------

    def receive(self, data: bytes, at_ns: int) -> None:
        """Take bytes whose last one is complete at *at_ns*."""
        self.advance_to(at_ns)
        for byte in data if at_ns >= self._deaf_until_ns else b"":
            if byte in REAL_TIME:
                self._receive_real_time(byte, at_ns)
            elif byte in b"\r\n":
                # the other half of CR LF is an empty line, which real firmware answers with ok as well
                self._end_line(at_ns)
            elif self._buffered() < RX_BUFFER:
                self._partial.append(byte)
            else:
                self._overflown = True

    def advance_to(self, when_ns: int) -> None:
        """Let lines, real-time bytes, segments and switches happen, in the order of their times."""
        while True:
            events: list[tuple[int, Callable[[int], None]]] = []
            if self._real_time:
                events.append((self._real_time[0][0], self._act))
            events += self.stepper.events()
            if self._lines and not self._lines_wait():
                events.append((self._lines[0][0], self._take_line))
            due, happen = min(events, key=_when, default=(when_ns + 1, self._act))
            if due > when_ns:
                break
            self._now_ns = max(due, self._now_ns)
            happen(self._now_ns)
        self._now_ns = max(when_ns, self._now_ns)
        self.lens.advance(self._now_ns)

    def take_output(self) -> list[tuple[int, bytes]]:
        """Return (and forget) the text that was printed, each piece with the instant at which it was."""
        output, self._output = self._output, []
        return output

    def reset_at(self, at_ns: int) -> None:
        """Let the supply brown out at *at_ns*: pulses stop, the count is lost, the banner comes again."""
        self.advance_to(at_ns)
        self.lens.halt(at_ns)
        self._forget_motion()
        self._lines.clear()
        self._silent = False
        self._forget_modes()
        self.stepper.offset = -round(self.lens.pulses_at(at_ns + NS_PER_MS))
        self.stepper.homed = False
        self.stepper.state = "Alarm" if self.settings[22] else "Idle"
        self._say_hello(at_ns + 500 * NS_PER_MS)

    def alarm_at(self, at_ns: int) -> None:
        """Let a limit switch be pressed at *at_ns*: the pulses stop, and the board says no more until it is reset."""
        self.advance_to(at_ns)
        self.lens.halt(at_ns)
        self._alarm(HARD_LIMIT, at_ns)

    def _lines_wait(self) -> bool:
        """Say whether the main loop is elsewhere: homing, suspended by a hold or cancel, or dead after an alarm."""
        stepper = self.stepper
        cancelling = stepper.motion is not None and stepper.motion.holding
        return self._silent or self._suspended or stepper.held or cancelling or stepper.state == "Home"

    # --- reading ---------------------------------------------------------------------------------------------------

    def _buffered(self) -> int:
        return len(self._partial) + sum(len(line) + 1 for _, line in self._lines)

    def _end_line(self, at_ns: int) -> None:
        line = self._partial.decode("ascii", "replace")
        if self._overflown:
            line = "\0"  # what is left of it cannot be trusted: error 11
        self._partial.clear()
        self._overflown = False
        took_ns = self._random.randint(*self.config.line_us) * NS_PER_US
        self._busy_ns = max(self._busy_ns, at_ns) + (took_ns if line else took_ns // 10)
        self._lines.append((self._busy_ns, line))

    def _receive_real_time(self, byte: int, at_ns: int) -> None:
        if byte == 0x18:
            self._reset(at_ns + 20 * NS_PER_US)
            return
        if self._silent or any(pending == byte for _, pending in self._real_time):
            return  # a flag that is already up
        if byte == 0x85 and self.stepper.state != "Jog":
            return  # the interrupt looks at the state that is
        due = at_ns + self._random.randint(*self.config.real_time_us) * NS_PER_US
        self._real_time.append((max(due, self._real_time[-1][0] if self._real_time else 0), byte))

    def _act(self, at_ns: int) -> None:
        _, byte = self._real_time.popleft()
        stepper = self.stepper
        if byte in {0x3F, 0x87}:
            if stepper.state == "Home" and not self._firmware.tells_homing:
                self._asked_homing = True
                return
            self._report(at_ns, full=byte == 0x87)
        elif byte in {0x21, 0x84, 0x85} and not self.config.ignore_stop:
            if stepper.state == "Jog":
                stepper.blocks = deque(list(stepper.blocks)[:1])
                stepper.hold(at_ns)
            elif stepper.state == "Run" and byte != 0x85:
                stepper.held = True
                stepper.hold(at_ns)
            elif stepper.state == "Idle" and byte == 0x85:
                self._suspended = True  # the jog ended between interrupt and main loop: a hold of nothing
        elif byte == 0x7E and self._suspended:
            self._suspended = False
        elif byte == 0x7E and stepper.held and stepper.motion is None:
            stepper.held = False
            stepper.start_block(at_ns)

    def _take_line(self, at_ns: int) -> None:
        if len(self.stepper.blocks) >= PLANNER_BLOCKS and self.stepper.motion is not None:
            _, line = self._lines.popleft()
            self._lines.appendleft((at_ns + NS_PER_MS, line))
            return
        _, raw = self._lines.popleft()
        line = "".join(raw.split()).upper()
        try:
            if raw == "\0":
                raise GrblError(text.LINE_TOO_LONG)
            if line.startswith("$"):
                self._system(line, at_ns)
            elif line:
                if self.stepper.state in {"Alarm", "Jog"}:
                    raise GrblError(text.LOCKED)
                self._gcode(line, at_ns)
        except GrblError as error:
            self._print(at_ns, f"error:{error.code}")
            return
        if self.stepper.state != "Home":
            self._print(at_ns, "ok")

    # --- lines -----------------------------------------------------------------------------------------------------

    def _system(self, line: str, at_ns: int) -> None:
        if line.startswith("$J="):
            self._jog(line[3:], at_ns)
            return
        if self._alarmed in CRITICAL and self._firmware.hears_in_alarm and line in {"$X", "$H", "$HX"}:
            raise GrblError(text.NOT_IN_ALARM)
        if line == "$HX" and self._firmware.one_axis_homing:
            flag = self._firmware.one_axis_flag
            if flag and not int(self.settings[22]) & flag:
                raise GrblError(text.HOMING_OFF)
            line = "$H"
        if line in {"$X", "$I", "$$", "$#", "$G", "$N", "$C", "$H", "$"}:
            self._query(line, at_ns)
            return
        number, equals, value = line[1:].partition("=")
        if not (equals and number.isdigit()):
            raise GrblError(text.BAD_STATEMENT)
        if self.stepper.state not in {"Idle", "Alarm"}:
            raise GrblError(text.NOT_IDLE)
        self.settings.assign(int(number), value)

    def _query(self, line: str, at_ns: int) -> None:
        if line == "$":
            self._print(at_ns, text.HELP)
        elif line == "$G":
            modal = f"G{self._mode} G54 G17 G21 G{91 if self._relative else 90} G94 M5 M9 T{self._tool}"
            self._print(at_ns, f"[GC:{modal} F{self._feed_mm_min:.0f} S0]")
        elif line == "$X":
            if self.stepper.state == "Alarm":
                self.stepper.state, self._alarmed = "Idle", None
                self._print(at_ns, text.UNLOCKED)
        elif self.stepper.state not in {"Idle", "Alarm"}:
            raise GrblError(text.NOT_IDLE)
        elif line == "$H":
            if not self.settings[22]:
                raise GrblError(text.HOMING_OFF)
            self._alarmed = None
            self.stepper.begin_homing(at_ns)
        else:
            answers: dict[str, Sequence[str]] = {
                "$I": self._firmware.version,
                "$$": self.settings.lines(),
                "$#": text.PARAMETERS,
                "$N": ("$N0=", "$N1="),
                "$C": (),
            }
            for answer in answers[line]:
                self._print(at_ns, answer)

    def _jog(self, words: str, at_ns: int) -> None:
        if self.stepper.state not in {"Idle", "Jog"}:
            raise GrblError(text.NOT_IDLE)
        asked = text.parse_motion(words, jog=True)
        if asked.feed_mm_min is None:
            raise GrblError(text.NO_FEED)
        if asked.x_mm is None:
            raise GrblError(text.BAD_JOG)
        relative = self._relative if asked.relative is None else asked.relative
        target = self.stepper.target_pulses(asked.x_mm, at_ns, relative=relative)
        if self.settings[20] and not self.stepper.inside(target):
            raise GrblError(text.BEYOND_TRAVEL)
        self.stepper.plan(target, asked.feed_mm_min, at_ns, jog=True)

    def _gcode(self, line: str, at_ns: int) -> None:
        words = text.OUTPUT_WORDS | (text.SCE2_OUTPUT_WORDS if self._firmware.has_iris else {})
        if line in words:
            name, on = words[line]
            self.outputs[name] = on
            return
        asked = text.parse_motion(line, jog=False)
        self._relative = self._relative if asked.relative is None else asked.relative
        self._tool = self._tool if asked.tool is None else asked.tool
        self._mode = self._mode if asked.mode is None else asked.mode
        self._feed_mm_min = self._feed_mm_min if asked.feed_mm_min is None else asked.feed_mm_min
        if asked.x_mm is None:
            return
        if self._mode == 1 and not self._feed_mm_min:
            raise GrblError(text.NO_FEED)
        target = self.stepper.target_pulses(asked.x_mm, at_ns, relative=self._relative and not asked.machine)
        if self.settings[20] and not self.stepper.inside(target):
            self._alarm(SOFT_LIMIT, at_ns)
            return
        self.stepper.plan(target, self._feed_mm_min if self._mode else self.settings[110], at_ns, jog=False)

    # --- alarms and resets -----------------------------------------------------------------------------------------

    def _alarm(self, code: int, at_ns: int) -> None:
        self._forget_motion()
        self.stepper.state, self._alarmed = "Alarm", code
        self.stepper.homed = False
        self._print(at_ns, f"ALARM:{code}")
        asleep_ns = 0 if self._firmware.hears_in_alarm else ALARM_NS
        self._deaf_until_ns = at_ns + asleep_ns
        if code in CRITICAL:
            self._silent = not self._firmware.hears_in_alarm
            self._print(at_ns + asleep_ns, text.RESET_TO_CONTINUE)

    def _forget_motion(self) -> None:
        self.stepper.forget()
        self._real_time.clear()

    def _homing_over(self, at_ns: int) -> None:
        self._busy_ns = at_ns
        if self._asked_homing:
            self._asked_homing = False
            self._report(at_ns)  # a flag that was up all the time
        self._print(at_ns, "ok")

    def _reset(self, at_ns: int) -> None:
        """Kill the pulses, forget every line, begin again; in motion the position is lost."""
        if self.config.ignore_stop:
            return
        moving, homing = self.stepper.motion is not None, bool(self.stepper.homing)
        self._partial.clear()
        self._lines.clear()
        self._busy_ns = at_ns
        self._silent = self._suspended = False
        self._forget_modes()
        if moving or homing:
            self.lens.halt(at_ns)
            self._alarm(HOMING_RESET if homing else RESET_IN_MOTION, at_ns + RESET_NS)
        else:
            self._deaf_until_ns = at_ns + RESET_NS
        self._forget_motion()
        if self.stepper.state != "Alarm":
            self.stepper.state = "Idle"
        self._alarmed = None
        self._say_hello(max(self._deaf_until_ns, at_ns + RESET_NS))

    def _forget_modes(self) -> None:
        self._relative, self._feed_mm_min, self._mode, self._tool = False, 0.0, 0, 0

    # --- printing --------------------------------------------------------------------------------------------------

    def _say_hello(self, at_ns: int) -> None:
        self._print(at_ns, self._firmware.greeting)
        if self.stepper.state == "Alarm":
            self._print(at_ns, text.UNLOCK)
        self._reports = 0

    def _report(self, at_ns: int, *, full: bool = False) -> None:
        stepper = self.stepper
        pulses, velocity = self.lens.pulses_at(at_ns), self.lens.velocity_at(at_ns)
        count = last_step(pulses, velocity)
        rotor = self.lens.rotor_at(at_ns)
        pins = "X" if rotor < -0.5 or rotor > self.lens.travel_steps + 0.5 else ""
        state = stepper.state
        if stepper.held:
            state = "Hold:1" if stepper.motion is not None else "Hold:0"
        elif state == "Alarm" and self._alarmed and self._firmware.hears_in_alarm:
            state = f"Alarm:{self._alarmed}"
        every = 30 if stepper.motion is not None else 10
        turn = self._reports % every
        self._reports += 1
        self._print(
            at_ns,
            text.status_report(
                state,
                (count + stepper.offset) / stepper.steps_per_mm,
                stepper.feed_mm_min(at_ns),
                pins=pins,
                wco=turn == 0,
                overrides=turn == 1,
                axes=self._firmware.axes,
                homed=stepper.homed if full and self._firmware.tells_homed else None,
            ),
        )

    def _print(self, at_ns: int, line: str) -> None:
        self._output.append((at_ns, f"{line}\r\n".encode("ascii")))


def _when(event: tuple[int, Callable[[int], None]]) -> int:
    return event[0]


BOARD = ServedBoard(GrblBoard, GrblConfig)
"""The entry point ``elpd.boards: grbl``."""
