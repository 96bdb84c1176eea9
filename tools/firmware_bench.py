"""What the lens controller's firmware does on a simulated ATmega328P: stops, steps, dead-man, against the pins.

`python tools/firmware_bench.py [--steps 1000000] [--seed 1] [--json]`. Times are the AVR's own, from its cycle count.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "drivers"))

from elpd_drivers.lenses import avr_wire as wire
from elpd_drivers.sim.boards.avr import AvrBoard, AvrConfig
from elpd_drivers.sim.lens import LensMechanics, SimulatedLens

MS = 1_000_000
TRAVEL_STEPS = 40_000
TICK_NS = 500
"""Of the firmware's stamps."""


@dataclass
class Bench:
    """A board, and the one question after the other that is put to it."""

    dead_man_ms: int = 500
    now: int = 0
    sequence: int = 0
    frames: wire.Frames = field(default_factory=wire.Frames)

    def __post_init__(self) -> None:
        """Power it up in the middle of a long travel."""
        mechanics = LensMechanics(um_per_step=1.0, travel_um=TRAVEL_STEPS, backlash_um=0.0)
        self.lens = SimulatedLens(mechanics, start_um=TRAVEL_STEPS / 2, history_s=1.0)
        self.board = AvrBoard(self.lens, AvrConfig(referenced=True))
        settings = wire.configure(640_000, 16_000, 0, TRAVEL_STEPS, self.dead_man_ms, 100)
        if self.ask(wire.CONFIGURE, settings).status != wire.OK:
            raise RuntimeError("the firmware refused its settings")

    def send(self, data: bytes) -> None:
        """Put bytes on the wire, one after the other."""
        for byte in data:
            self.now += self.board.byte_ns
            self.board.receive(bytes((byte,)), self.now)

    def live(self, ms: float) -> None:
        """Let time pass."""
        self.now += round(ms * MS)
        self.board.advance_to(self.now)

    def ask(self, command: int, payload: bytes = b"") -> wire.Reply:
        """Send a command and return its reply."""
        self.sequence = (self.sequence + 1) & 0xFF
        self.send(wire.encode(self.sequence, command, payload))
        for _ in range(50):
            self.live(0.2)
            data = b"".join(part for _, part in self.board.take_output())
            for reply in self.frames.feed(data):
                if reply.sequence == self.sequence:
                    return reply
        raise RuntimeError(f"no reply to command {command}")

    @property
    def last_step_ns(self) -> int:
        """When STEP last rose."""
        return self.board.last_step_ns


def stops(count: int, seed: int) -> list[float]:
    """Return the times from the end of a stop byte to the last step after it, us, at 8,000 steps/s; 0: none came."""
    chance, bench, times = random.Random(seed), Bench(), []  # noqa: S311
    for number in range(count):
        target = TRAVEL_STEPS if number % 2 else 0  # there and back: it stays in the middle
        bench.ask(wire.GO, wire.go(target, 8_000))
        bench.live(60 + chance.random())
        bench.send(wire.HALT)
        at = bench.now
        bench.live(3)
        times.append(max(0.0, (bench.last_step_ns - at) / 1000))
    return times


@dataclass
class Counted:
    """Steps made, commands sent, and how often the firmware's count and its stamps were not what the pins did.

    ``stamp_us`` is by how much its stamps of last steps strayed from the pin's own times, at the most.
    """

    made: int = 0
    commands: int = 0
    disagreements: int = 0
    stamp_us: float = 0.0


def count_steps(wanted: int, seed: int) -> Counted:
    """Let it make *wanted* steps by random commands, and compare."""
    chance, bench, wrong, commands = random.Random(seed), Bench(), 0, 0  # noqa: S311
    offsets_ns = []
    while bench.board.steps_made < wanted:
        draw = chance.random()
        commands += 1
        if draw < 0.8:
            bench.ask(wire.GO, wire.go(chance.randrange(TRAVEL_STEPS + 1), chance.randrange(2_000, 16_001)))
        elif draw < 0.9:
            bench.send(wire.BRAKE)
        else:
            bench.send(wire.HALT)
        bench.live(chance.uniform(0.0, 400.0))
        if chance.random() < 0.2:
            bench.send(wire.HALT)
            bench.live(2)
            reply = bench.ask(wire.STATUS)
            wrong += reply.position != bench.board.pin_position
            offsets_ns.append(bench.last_step_ns - reply.step_stamp * TICK_NS)
    return Counted(bench.board.steps_made, commands, wrong, (max(offsets_ns) - min(offsets_ns)) / 1000)


def dead_man(limit_ms: int) -> float:
    """Return how long after the last word the motor was at rest, ms, from 12,800 steps/s."""
    bench = Bench(dead_man_ms=limit_ms)
    bench.ask(wire.GO, wire.go(TRAVEL_STEPS, 12_800))
    at = bench.now
    bench.live(limit_ms + 500)
    return (bench.last_step_ns - at) / MS


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--stops", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    times = sorted(stops(chosen.stops, chosen.seed))
    counted = count_steps(chosen.steps, chosen.seed)
    answer = {
        "stop_us": {"median": times[len(times) // 2], "worst": times[-1], "stops": len(times)},
        "steps": asdict(counted),
        "dead_man_ms": {"limit": 200, "at_rest_after": dead_man(200)},
    }
    if chosen.json:
        print(json.dumps(answer))
        return
    print(f"stop byte to last step: median {times[len(times) // 2]:.1f} us, worst {times[-1]:.1f} us ({len(times)})")
    print(
        f"step counter against the pins: {counted.made} steps, {counted.commands} commands, "
        f"{counted.disagreements} disagreements; stamps within {counted.stamp_us:.1f} us"
    )
    print(f"dead-man of 200 ms: at rest {answer['dead_man_ms']['at_rest_after']:.1f} ms after the last word")


if __name__ == "__main__":
    main()
