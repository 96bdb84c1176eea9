"""A GRBL 1.1h board in front of a simulated lens on its X axis.

What matters to whoever focuses through GRBL is modelled as the firmware does it, not as constants:

- *The segment buffer.* Motion is executed in segments of 10 ms, five of which are prepared ahead, the running one
  among them. A hold or a jog cancel changes the first segment that is not yet prepared, so it bites 40 to 50 ms after
  its byte. A reset (0x18) kills the pulses at once; in motion, the position is then unsure and the board locked.
- *The main loop.* Real-time bytes are taken out of the stream on arrival; lines wait in a receive buffer of 128
  characters for their turn, and ``ok`` says "planned", not "done".
- *Alarms.* After a hard limit the board says ``ALARM:1`` and then nothing at all until it is reset.

``FS`` tells the speed at the end of the last prepared segment, which is why it reads 0 while the motor still brakes.
Consecutive blocks do not blend: each ends at rest. Overrides are accepted and have no effect.
"""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.motion.kinematics import Knot, Piece, approach, in_segments, lay_out, ramp, state_at
from elpd.units import NS_PER_MS, NS_PER_S, NS_PER_US
from elpd_drivers.sim.boards import grbl_text as text
from elpd_drivers.sim.boards.axis import last_step
from elpd_drivers.sim.boards.grbl_text import GrblError, GrblSettings
from elpd_drivers.sim.boards.served import ServedBoard

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from elpd_drivers.sim.lens import SimulatedLens

SEGMENT_S = 0.010
SEGMENT_NS = round(SEGMENT_S * NS_PER_S)
PREPARED_SEGMENTS = 5
PLANNER_BLOCKS = 15
RX_BUFFER = 128
REAL_TIME = frozenset({0x18, 0x21, 0x3F, 0x7E, 0x84, 0x85, *range(0x90, 0xA0)})


@dataclass(frozen=True, slots=True)
class GrblConfig:
    """How the board is set up and how its day began.

    ``referenced`` begins homed some time ago (Idle, the lower limit switch at minus the travel, no banner); otherwise
    just powered up, locked until ``$H`` or ``$X``.
    ``line_us`` is how long the firmware takes over a line, ``real_time_us`` until it acts on a real-time byte;
    uniform between the two.
    """

    speed_um_s: float = 12_000.0
    acceleration_um_s2: float = 200_000.0
    baud: int = 115_200
    referenced: bool = False
    line_us: tuple[int, int] = (1000, 3000)
    real_time_us: tuple[int, int] = (50, 400)
    ignore_stop: bool = False


@dataclass(frozen=True, slots=True)
class _Block:
    target_pulses: float
    speed_sps: float
    jog: bool


@dataclass(slots=True)
class _Motion:
    """What the stepper executes: the profile as planned, when it began, and when it ends."""

    profile: list[Knot]
    begin_ns: int
    end_ns: int
    holding: bool = False

    def prepared_until_ns(self, now_ns: int) -> int:
        """Return the end of the last segment that is prepared at *now_ns*."""
        running = (now_ns - self.begin_ns) // SEGMENT_NS
        return min(self.begin_ns + (running + PREPARED_SEGMENTS) * SEGMENT_NS, self.end_ns)


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
        self._random = random.Random(seed)  # noqa: S311  (latency, not secrets)
        self._now_ns = begin_ns
        self._output: list[tuple[int, bytes]] = []
        self._partial = bytearray()
        self._overflown = False
        self._lines: deque[tuple[int, str]] = deque()
        self._busy_ns = begin_ns
        self._real_time: deque[tuple[int, int]] = deque()
        self._blocks: deque[_Block] = deque()
        self._motion: _Motion | None = None
        self._state = "Idle"
        self._held = self._silent = False
        self.outputs: dict[str, bool] = {}
        """The outputs that were switched, by name: for tests."""
        self._homing: list[Callable[[int], None]] = []
        self._homing_due_ns: int | None = None
        self._switch_ns: int | None = None
        self._relative, self._feed_mm_min, self._mode = False, 0.0, 0
        self._reports = 0
        if self.config.referenced:
            lag = lens.rotor_at(begin_ns) - lens.pulses_at(begin_ns)
            self._offset = round(lag - self._spm * self.settings[130])
        else:
            self._offset = -round(lens.pulses_at(begin_ns))
            self._state = "Alarm"
            self._say_hello(begin_ns)

    # --- the wire's side -------------------------------------------------------------------------------------------

    def receive(self, data: bytes, at_ns: int) -> None:
        """Take bytes whose last one is complete at *at_ns*."""
        self.advance_to(at_ns)
        for byte in data:
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
            events: list[tuple[int, int]] = []
            if self._real_time:
                events.append((self._real_time[0][0], 0))
            if self._switch_ns is not None:
                events.append((self._switch_ns, 1))
            if self._motion is not None:
                events.append((self._motion.end_ns, 2))
            if self._homing_due_ns is not None:
                events.append((self._homing_due_ns, 3))
            if self._lines and not self._lines_wait():
                events.append((self._lines[0][0], 4))
            due, kind = min(events, default=(when_ns + 1, 0))
            if due > when_ns:
                break
            self._now_ns = max(due, self._now_ns)
            (self._act, self._switch, self._motion_ended, self._home_on, self._take_line)[kind](self._now_ns)
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
        self._offset = -round(self.lens.pulses_at(at_ns + NS_PER_MS))
        self._state = "Alarm" if self.settings[22] else "Idle"
        self._say_hello(at_ns + 500 * NS_PER_MS)

    def alarm_at(self, at_ns: int) -> None:
        """Let a limit switch be pressed at *at_ns*: the pulses stop, and the board says no more until it is reset."""
        self.advance_to(at_ns)
        self.lens.halt(at_ns)
        self._alarm(1, at_ns)
        self._silent = True

    def _lines_wait(self) -> bool:
        """Say whether the main loop is elsewhere: homing, suspended by a hold or cancel, or dead after an alarm."""
        cancelling = self._motion is not None and self._motion.holding
        return self._silent or self._held or cancelling or self._state == "Home"

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
        due = at_ns + self._random.randint(*self.config.real_time_us) * NS_PER_US
        self._real_time.append((max(due, self._real_time[-1][0] if self._real_time else 0), byte))

    def _act(self, at_ns: int) -> None:
        _, byte = self._real_time.popleft()
        if byte == 0x3F:
            self._report(at_ns)
        elif byte in {0x21, 0x84, 0x85} and not self.config.ignore_stop:
            if self._state == "Jog":
                self._blocks = deque(list(self._blocks)[:1])
                self._hold(at_ns)
            elif self._state == "Run" and byte != 0x85:
                self._held = True
                self._hold(at_ns)
        elif byte == 0x7E and self._held and self._motion is None:
            self._held = False
            self._start_block(at_ns)

    def _take_line(self, at_ns: int) -> None:
        if len(self._blocks) >= PLANNER_BLOCKS and self._motion is not None:
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
                if self._state in {"Alarm", "Jog"}:
                    raise GrblError(text.LOCKED)
                self._gcode(line, at_ns)
        except GrblError as error:
            self._print(at_ns, f"error:{error.code}")
            return
        if self._state != "Home":
            self._print(at_ns, "ok")

    # --- lines -----------------------------------------------------------------------------------------------------

    def _system(self, line: str, at_ns: int) -> None:
        if line.startswith("$J="):
            self._jog(line[3:], at_ns)
            return
        if line in {"$X", "$I", "$$", "$#", "$G", "$N", "$C", "$H", "$"}:
            self._query(line, at_ns)
            return
        number, equals, value = line[1:].partition("=")
        if not (equals and number.isdigit()):
            raise GrblError(text.BAD_STATEMENT)
        if self._state not in {"Idle", "Alarm"}:
            raise GrblError(text.NOT_IDLE)
        self.settings.assign(int(number), value)

    def _query(self, line: str, at_ns: int) -> None:
        if line == "$":
            self._print(at_ns, text.HELP)
        elif line == "$G":
            modal = f"G{self._mode} G54 G17 G21 G{91 if self._relative else 90} G94 M5 M9 T0"
            self._print(at_ns, f"[GC:{modal} F{self._feed_mm_min:.0f} S0]")
        elif line == "$X":
            if self._state == "Alarm":
                self._state = "Idle"
                self._print(at_ns, text.UNLOCKED)
        elif self._state not in {"Idle", "Alarm"}:
            raise GrblError(text.NOT_IDLE)
        elif line == "$H":
            if not self.settings[22]:
                raise GrblError(text.HOMING_OFF)
            self._begin_homing(at_ns)
        else:
            answers: dict[str, Sequence[str]] = {
                "$I": text.VERSION,
                "$$": self.settings.lines(),
                "$#": text.PARAMETERS,
                "$N": ("$N0=", "$N1="),
                "$C": (),
            }
            for answer in answers[line]:
                self._print(at_ns, answer)

    def _jog(self, words: str, at_ns: int) -> None:
        if self._state not in {"Idle", "Jog"}:
            raise GrblError(text.NOT_IDLE)
        asked = text.parse_motion(words, jog=True)
        if asked.feed_mm_min is None:
            raise GrblError(text.NO_FEED)
        if asked.x_mm is None:
            raise GrblError(text.BAD_JOG)
        relative = self._relative if asked.relative is None else asked.relative
        target = self._target_pulses(asked.x_mm, relative=relative)
        if self.settings[20] and not self._inside(target):
            raise GrblError(text.BEYOND_TRAVEL)
        self._plan(target, asked.feed_mm_min, at_ns, jog=True)

    def _gcode(self, line: str, at_ns: int) -> None:
        if line in text.OUTPUT_WORDS:
            name, on = text.OUTPUT_WORDS[line]
            self.outputs[name] = on
            return
        asked = text.parse_motion(line, jog=False)
        self._relative = self._relative if asked.relative is None else asked.relative
        self._mode = self._mode if asked.mode is None else asked.mode
        self._feed_mm_min = self._feed_mm_min if asked.feed_mm_min is None else asked.feed_mm_min
        if asked.x_mm is None:
            return
        if self._mode == 1 and not self._feed_mm_min:
            raise GrblError(text.NO_FEED)
        target = self._target_pulses(asked.x_mm, relative=self._relative and not asked.machine)
        if self.settings[20] and not self._inside(target):
            self._alarm(2, at_ns)
            self._silent = True
            return
        self._plan(target, self._feed_mm_min if self._mode else self.settings[110], at_ns, jog=False)

    # --- motion ----------------------------------------------------------------------------------------------------

    @property
    def _spm(self) -> float:
        return self.settings[100]

    def _target_pulses(self, x_mm: float, *, relative: bool) -> float:
        """Return where a motion ends; a relative one counts from the end of what is planned already."""
        begin = 0
        if relative:
            planned = self._blocks[-1].target_pulses if self._blocks else self.lens.pulses_at(self._now_ns)
            begin = round(planned) + self._offset
        return float(begin + round(x_mm * self._spm) - self._offset)

    def _inside(self, target_pulses: float) -> bool:
        return round(-self.settings[130] * self._spm) <= target_pulses + self._offset <= 0

    def _plan(self, target: float, feed_mm_min: float, at_ns: int, *, jog: bool) -> None:
        speed_sps = min(feed_mm_min, self.settings[110]) / 60 * self._spm
        end = self._blocks[-1].target_pulses if self._blocks else round(self.lens.pulses_at(at_ns))
        if target == end or speed_sps <= 0:
            return
        self._blocks.append(_Block(target, speed_sps, jog))
        if self._motion is None and not self._held:
            self._start_block(at_ns)

    def _start_block(self, at_ns: int) -> None:
        if not self._blocks:
            self._state = "Idle"
            return
        block = self._blocks[0]
        self._state = "Jog" if block.jog else "Run"
        steps = self.lens.pulses_at(at_ns)
        self._execute(approach(steps, 0.0, block.target_pulses, block.speed_sps, self._acceleration_sps2()), at_ns)

    def _execute(self, pieces: Sequence[Piece], at_ns: int, *, holding: bool = False) -> _Motion:
        """Let the stepper follow a profile from *at_ns* on, segment by segment."""
        profile = lay_out(at_ns, self.lens.pulses_at(at_ns), pieces)
        self._motion = motion = _Motion(profile, at_ns, max(profile[-1].begin_ns, at_ns), holding)
        self.lens.follow(at_ns, in_segments(pieces, SEGMENT_S))
        self._watch_switches(at_ns)
        return motion

    def _hold(self, at_ns: int) -> None:
        """Brake from the first segment that is not yet prepared."""
        motion = self._motion
        if motion is None or motion.holding:
            return
        motion.holding = True
        onset_ns = motion.prepared_until_ns(at_ns)
        if onset_ns >= motion.end_ns:
            return  # the motion ends by itself within what is prepared
        _, velocity = state_at(motion.profile, onset_ns)
        pieces = ramp(velocity, 0.0, self._acceleration_sps2())
        begin_ns, earlier = motion.begin_ns, motion.profile
        braking = self._execute(pieces, onset_ns, holding=True)
        braking.profile = [*(knot for knot in earlier if knot.begin_ns < onset_ns), *braking.profile]
        braking.begin_ns = begin_ns

    def _motion_ended(self, at_ns: int) -> None:
        held = self._motion is not None and self._motion.holding
        self._motion = None
        if self._homing:
            self._homing_due_ns = at_ns + round(self.settings[26] * NS_PER_MS)
            return
        if self._held:
            return  # feed hold: the block is taken up again at ~
        if held:
            self._blocks.clear()
        elif self._blocks:
            self._blocks.popleft()
        self._start_block(at_ns)

    def _acceleration_sps2(self) -> float:
        return self.settings[120] * self._spm

    def _forget_motion(self) -> None:
        self._motion = None
        self._blocks.clear()
        self._real_time.clear()
        self._homing = []
        self._homing_due_ns = self._switch_ns = None
        self._held = False

    # --- switches, homing, alarms ----------------------------------------------------------------------------------

    def _watch_switches(self, from_ns: int) -> None:
        self._switch_ns = None
        if self.settings[21] and not self._homing:
            times = [
                self.lens.reaches(-0.5, from_ns, upwards=False),
                self.lens.reaches(self.lens.travel_steps + 0.5, from_ns, upwards=True),
            ]
            self._switch_ns = min((when for when in times if when is not None), default=None)

    def _switch(self, at_ns: int) -> None:
        self._switch_ns = None
        if self._homing:
            self.lens.halt(at_ns)
            self._motion = None
            self._homing_due_ns = at_ns + round(self.settings[26] * NS_PER_MS)
        elif self._motion is not None:
            self.lens.halt(at_ns)
            self._alarm(1, at_ns)
            self._silent = True

    def _alarm(self, code: int, at_ns: int) -> None:
        self._forget_motion()
        self._state = "Alarm"
        self._print(at_ns, f"ALARM:{code}")
        if code in {1, 2}:
            self._print(at_ns, text.RESET_TO_CONTINUE)

    def _reset(self, at_ns: int) -> None:
        """Kill the pulses, forget every line, begin again; in motion the position is lost."""
        if self.config.ignore_stop:
            return
        moving, homing = self._motion is not None, bool(self._homing)
        self._partial.clear()
        self._lines.clear()
        self._busy_ns = at_ns
        self._silent = False
        self._relative, self._feed_mm_min, self._mode = False, 0.0, 0
        if moving or homing:
            self.lens.halt(at_ns)
            self._alarm(6 if homing else 3, at_ns)
        self._forget_motion()
        if self._state != "Alarm":
            self._state = "Idle"
        self._say_hello(at_ns + NS_PER_MS)

    def _begin_homing(self, at_ns: int) -> None:
        self._blocks.clear()
        self._state = "Home"
        self._homing = [
            lambda now: self._seek(self.settings[25], now),
            lambda now: self._pull_off(self.settings[25], now),
            lambda now: self._seek(self.settings[24], now),
            lambda now: self._pull_off(self.settings[24], now),
            self._homed,
        ]
        self._homing_due_ns = at_ns

    def _home_on(self, at_ns: int) -> None:
        self._homing_due_ns = None
        self._homing.pop(0)(at_ns)

    def _towards(self) -> float:
        return -1.0 if int(self.settings[23]) & 1 else 1.0

    def _seek(self, feed_mm_min: float, at_ns: int) -> None:
        towards, speed = self._towards(), feed_mm_min / 60 * self._spm
        farthest = self.lens.pulses_at(at_ns) + towards * 1.5 * self.settings[130] * self._spm
        self._execute(approach(self.lens.pulses_at(at_ns), 0.0, farthest, speed, self._acceleration_sps2()), at_ns)
        edge = -0.5 if towards < 0 else self.lens.travel_steps + 0.5
        self._switch_ns = self.lens.reaches(edge, at_ns, upwards=towards > 0)
        if self._switch_ns is None:
            self.lens.halt(at_ns)
            self._alarm(9, at_ns)

    def _pull_off(self, feed_mm_min: float, at_ns: int) -> None:
        steps, speed = self.lens.pulses_at(at_ns), feed_mm_min / 60 * self._spm
        target = round(steps) - self._towards() * round(self.settings[27] * self._spm)
        self._execute(approach(steps, 0.0, target, speed, self._acceleration_sps2()), at_ns)
        self._switch_ns = None

    def _homed(self, at_ns: int) -> None:
        pulled = self.settings[27] * self._spm
        machine = -self.settings[130] * self._spm + pulled if self._towards() < 0 else -pulled
        self._offset = round(machine) - round(self.lens.pulses_at(at_ns))
        self._state = "Idle"
        self._homing = []
        self._busy_ns = at_ns
        self._print(at_ns, "ok")

    # --- printing --------------------------------------------------------------------------------------------------

    def _say_hello(self, at_ns: int) -> None:
        self._print(at_ns, text.BANNER)
        if self._state == "Alarm":
            self._print(at_ns, text.UNLOCK)
        self._reports = 0

    def _report(self, at_ns: int) -> None:
        pulses, velocity = self.lens.pulses_at(at_ns), self.lens.velocity_at(at_ns)
        count = last_step(pulses, velocity)
        feed = 0.0
        if self._motion is not None:
            _, ahead_sps = state_at(self._motion.profile, self._motion.prepared_until_ns(at_ns))
            feed = abs(ahead_sps) / self._spm * 60
        rotor = self.lens.rotor_at(at_ns)
        pins = "X" if rotor < -0.5 or rotor > self.lens.travel_steps + 0.5 else ""
        state = self._state
        if self._held:
            state = "Hold:1" if self._motion is not None else "Hold:0"
        every = 30 if self._motion is not None else 10
        turn = self._reports % every
        self._reports += 1
        self._print(
            at_ns,
            text.status_report(
                state, (count + self._offset) / self._spm, feed, pins=pins, wco=turn == 0, overrides=turn == 1
            ),
        )

    def _print(self, at_ns: int, line: str) -> None:
        self._output.append((at_ns, f"{line}\r\n".encode("ascii")))


BOARD = ServedBoard(GrblBoard, GrblConfig)
"""The entry point ``elpd.boards: grbl``."""
