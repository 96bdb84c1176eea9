"""A day of the daemon in virtual time: continuous autofocus, people who ask for things, and everything that breaks.

    python tools/soak.py                       a day on the simulated rig, the seed 1
    python tools/soak.py --hours 2 --seed 7    less of another one
    python tools/soak.py --json                the figures as one object

The engine is the daemon's own, stepped without threads; hours in which nobody listens are leapt over. Focus is knocked
away while the camera listens, and the daemon is expected to find it again by itself. At random people ask for things,
cables are pulled, boards are reset, the process is stopped for a while or killed, the configuration is read again, the
state is damaged. All along it is asserted that every request has exactly one answer and that the lens stays inside its
limits and rests when nothing is done; the figures tell how many cycles found focus, how far from the truth, and whether
the memory grew.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import structlog
from elpd_drivers.sim.world import World

from elpd import log, rig
from elpd.config import Config, load
from elpd.errors import ElpdError
from elpd.service.engine import RigEngine
from elpd.service.engine_port import Answer, Caller, Request
from elpd.service.messages import METHODS
from elpd.service.timing import VirtualTime
from elpd.units import HostNs

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.ports import Clock

RIG = (
    "sim.width=160", "sim.height=120", "sim.scene=camera", "focus.roi_fraction=0.8", "sim.noise_hz=0.2",
    "journal.budget_mb=20", "journal.keep=8", "service.poll_ms=400", "service.look_s=0.8", "service.look_every_s=100",
    "modes.hold_off_s=5",
)  # fmt: skip
KNOCK_S = 0.4
"""How long after the camera began to listen focus is knocked away; the rest of the look hears of it."""

KNOCK_UM = 90.0
FAR_UM = 250.0
ROOM_UM = 500.0
"""Focus stays so far from the ends of the travel."""

GOOD_DOF = 1.5
"""FOCUSED means: no further from true focus than this many depths of focus."""

PEOPLE_EVERY_S = 240.0
MISFORTUNE_EVERY_S = 900.0
CLEARED_AFTER_S = 30.0
DEPTH_OF_FOCUS_UM = 6.0

PEOPLE = tuple(Caller(number, 1000 + number, 1000, f"person {number}") for number in (1, 2, 3))


class LeapingTime(VirtualTime):
    """Virtual time that leaps over naps."""

    _world: World | None = None

    def follow(self, clock: Clock | None) -> None:
        """Go on by another world's time."""
        super().follow(clock)
        self._world = clock if isinstance(clock, World) else None

    def nap(self, seconds: float) -> None:
        """Let time pass in one step."""
        if self._world is None:
            super().nap(seconds)
        else:
            self._world.leap_to(HostNs(self._world.now_ns() + round(seconds * 1e9)))


class Soak:
    """One day, or as long as it is run."""

    def __init__(self, seed: int, directory: Path, *, misfortunes: bool = True) -> None:
        self.chance = np.random.default_rng(seed)
        self.directory = directory
        self.misfortunes = misfortunes
        self.counts: Counter[str] = Counter()
        self.outcomes: Counter[str] = Counter()
        self.errors_um: list[float] = []
        self.rss_mb: list[float] = []
        self.waiting: dict[int, str] = {}
        self.numbers = count()
        self.offset_um = 0.0
        self.next_person_s = self.next_misfortune_s = 0.0
        self.clear_at_s: float | None = None
        self.knocked_look = True
        self.doubled: list[str] = []
        self.elapsed_s = 0.0
        self._begin()

    # --- the daemon's life ---

    def config(self, *overrides: str) -> Config:
        """Return the rig's configuration."""
        where = (f"journal.directory={self.directory / 'runs'}", f"state.directory={self.directory / 'state'}")
        return load(overrides=[*RIG, *where, f"sim.seed={self.chance.integers(1 << 16)}", *overrides])

    def _begin(self) -> None:
        self.time = LeapingTime(self.elapsed_s)
        self.engine = RigEngine(self.config(), self.time, build=self._build)
        self.engine.listen(self._hear)
        self.engine.step()
        self.engine.ready()
        self._recover()

    def _build(self, config: Config) -> Any:
        parts = rig.build(config)
        assert isinstance(parts.clock, World)
        self.offset_um = 0.0
        self.world, self.truth = parts.clock, parts.truth
        return parts

    def _recover(self) -> None:
        """Do what a person does after a start or a fault: clear it, home, ask for continuous autofocus."""
        self.engine.clear()
        self._until(lambda: self.engine.keeper.parts is not None and self.engine.situation.fault is None, 30.0)
        if self.engine.situation.lens.referenced is not True:
            self._wait(self.ask("home"))
            self._wait(self.ask("move", to_um=self._somewhere_um()))
        self._wait(self.ask("mode", mode="continuous"))

    def run(self, hours: float) -> None:
        """Let so many hours pass."""
        end_s = self.elapsed_s + 3600.0 * hours
        told_s = 0.0
        while self.elapsed_s < end_s:
            self._turn()
            if self.elapsed_s - told_s > 3600.0:
                told_s = self.elapsed_s
                self.rss_mb.append(self.engine.status().rss_mb)
                print(f"{told_s / 3600:4.0f} h  {dict(self.outcomes)}  {self.rss_mb[-1]:.0f} MB", file=sys.stderr)

    def finish(self) -> None:
        """End in order; nothing may be left unanswered."""
        self.engine.begin_stopping()
        self.engine.step()
        self.engine.finish_stopping()
        assert not self.waiting, f"unanswered: {self.waiting}"

    # --- one turn ---

    def _turn(self) -> None:
        self.engine.step()
        self.elapsed_s = self.time.now_s()
        self._check()
        self._knock()
        if self.elapsed_s > self.next_person_s:
            self.next_person_s = self.elapsed_s + float(self.chance.exponential(PEOPLE_EVERY_S))
            self._person()
        if self.misfortunes and self.elapsed_s > self.next_misfortune_s:
            self.next_misfortune_s = self.elapsed_s + float(self.chance.exponential(MISFORTUNE_EVERY_S))
            self._misfortune()
        if self.engine.situation.fault is None:
            self.clear_at_s = None
        elif self.clear_at_s is None:
            self.clear_at_s = self.elapsed_s + CLEARED_AFTER_S
        elif self.elapsed_s > self.clear_at_s:
            self.clear_at_s = None
            self._recover()

    def _check(self) -> None:
        truth = self.truth
        steps, now = truth.mechanism.pulses_at(self.world.now_ns()), self.world.now_ns()
        assert -1.0 <= steps * 0.3125 <= 2501.0, f"outside the limits: {steps * 0.3125} um"
        if self.engine.place.current is None and self.engine.keeper.parts is not None:
            # a stop that was sent with the last breath of a request may still be on the wire
            assert truth.mechanism.velocity_at(now) == 0.0 or self.engine.situation.fault is not None
        assert not self.doubled, f"answered twice: {self.doubled}"

    def _knock(self) -> None:
        """Move focus while the camera listens, once a look, mostly."""
        looking = self.engine.place.current is None and self.engine.idle.looking
        if not looking:
            self.knocked_look = False
            return
        if self.knocked_look or self.chance.random() > 0.75:
            self.knocked_look = True
            return
        self.knocked_look = True
        here_um = self.truth.focus_carriage_um + self.offset_um
        by_um = float(self.chance.normal(0.0, KNOCK_UM))
        if not ROOM_UM < here_um + by_um < 2500.0 - ROOM_UM:
            by_um = -by_um
        self.offset_um += by_um
        self.counts["knocks"] += 1
        self.truth.drift.shift(self.world.now_ns() + round(KNOCK_S * 1e9), by_um, 40.0)

    # --- people ---

    def ask(self, method: str, **params: Any) -> int | None:
        """Ask for something; ``None`` if it was refused."""
        number = next(self.numbers)
        caller = PEOPLE[int(self.chance.integers(len(PEOPLE)))]
        self.counts["requests"] += 1
        try:
            job = self.engine.submit(Request(method, METHODS[method].model_validate(params), caller))
        except ElpdError as error:
            self.counts[f"refused {error.kind}"] += 1
            return None
        self.waiting[number] = method
        job.add_done_callback(lambda answer: self._answered(number, method, answer))
        return number

    def _somewhere_um(self) -> float:
        """Return a place from which focus can be found; a map from a millimetre off shows nothing."""
        return self.truth.focus_carriage_um + self.offset_um + float(self.chance.uniform(-FAR_UM, FAR_UM))

    def _answered(self, number: int, method: str, answer: Answer) -> None:
        if self.waiting.pop(number, None) is None:
            self.doubled.append(f"{method} {number}")
        self.counts["answers"] += 1
        if answer.error is not None:
            self.counts[f"error {answer.error.kind}"] += 1

    def _person(self) -> None:
        """Ask for anything, sometimes while something else is being done."""
        chance = self.chance
        wishes: dict[str, Callable[[], dict[str, Any]]] = {
            "focus": lambda: {"on_disconnect": "cancel" if chance.random() < 0.5 else "finish"},
            "move": lambda: {"to_um": self._somewhere_um()},
            "jog": lambda: {"by_um": float(chance.normal(0, 100))},
            "preset": lambda: {"action": "save", "name": f"p{chance.integers(3)}"},
            "stop": dict,
            "cancel": dict,
            "lease": lambda: {"action": "acquire", "seconds": 60.0},
            "temperature": lambda: {"celsius": float(chance.uniform(10, 30))},
            "map": lambda: {"max_width": 64},
            "runs": dict,
            "metrics": dict,
            "status": dict,
            "record": lambda: {"seconds": 0.05},
        }
        method = str(chance.choice(list(wishes)))
        self.ask(method, **wishes[method]())
        if chance.random() < 0.5:  # and before that has begun, or in the middle of it, something else
            self.ask(str(chance.choice(["focus", "home", "cancel", "stop"])))
        if chance.random() < 0.3:
            self.engine.gone(PEOPLE[int(chance.integers(len(PEOPLE)))])
        self._until(lambda: not self.waiting, 60.0)
        if self.engine.situation.fault is None:
            self.ask("mode", mode="continuous")

    # --- misfortunes ---

    def _misfortune(self) -> None:
        """Let something break, at any moment of whatever is being done."""
        if self.engine.keeper.parts is None or self.engine.situation.fault is not None:
            return
        now_ns = self.world.now_ns()
        faults, board = self.truth.port.faults, self.truth.port.wire.board
        what: dict[str, Callable[[], object]] = {
            "lens unplugged": lambda: setattr(faults, "disconnect_at_ns", now_ns),
            "lens deaf": lambda: setattr(faults, "drop_to_board", True),
            "lens mute": lambda: setattr(faults, "drop_to_host", True),
            "board reset": lambda: board.reset_at(self.world.now_ns()),
            "camera unplugged": lambda: self._break_camera(vanishes_at_s=0.0),
            "camera silent": lambda: self._break_camera(silent_from_s=0.0),
            "stopped for a moment": lambda: self._jump(0.7),
            "stopped for long": lambda: self._jump(3.0),
            "killed": self._kill,
            "state damaged": self._damage,
            "reloaded": lambda: self.engine.reload(self.config("focus.deadline_ms=4000")),
            "disk full": self._fill_disk,
        }
        name = str(self.chance.choice(list(what)))
        self.counts[name] += 1
        if self.chance.random() < 0.5:
            self.ask("focus")
            self.world.add(_Later(self.world.now_ns() + int(self.chance.uniform(1e6, 300e6)), what[name]))
            self._until(lambda: not self.waiting, 60.0)
        else:
            what[name]()

    def _break_camera(self, **how: float) -> None:
        camera: Any = self.engine.keeper.parts and self.engine.keeper.parts.camera
        if camera is not None:
            camera._faults = replace(camera._faults, **how)  # noqa: SLF001  (nobody else may)

    def _jump(self, seconds: float) -> None:
        self.world._now = HostNs(self.world._now + round(seconds * 1e9))  # noqa: SLF001  (as a stopped process sees it)

    def _kill(self) -> None:
        """End without a word. Whoever waited for an answer has lost its connection."""
        if self.engine.place.current is not None:
            return
        self.waiting.clear()
        self.engine.keeper.close()
        self._begin()

    def _damage(self) -> None:
        path = self.directory / "state" / "service.json"
        if path.exists():
            path.write_bytes(path.read_bytes()[: int(self.chance.integers(200))])

    def _fill_disk(self) -> None:
        """Put a file where the runs' folder was, for one cycle."""
        runs = self.directory / "runs"
        shutil.rmtree(runs, ignore_errors=True)
        runs.touch()
        self._wait(self.ask("focus"))
        runs.unlink(missing_ok=True)

    # --- parts ---

    def _hear(self, event: Any) -> None:
        if event.event == "result":
            self.outcomes[event.outcome] += 1
            error_um = (event.truth or {}).get("final_error_um")
            if event.outcome == "FOCUSED" and error_um is not None:
                self.errors_um.append(error_um)

    def _wait(self, number: int | None) -> None:
        if number is not None:
            self._until(lambda: number not in self.waiting, 60.0)

    def _until(self, reached: Callable[[], bool], limit_s: float) -> None:
        end_s = self.time.now_s() + limit_s
        while not reached():
            assert self.time.now_s() < end_s, f"not within {limit_s:g} s: {self.waiting}, {self.engine.status()}"
            self.engine.step()

    def figures(self) -> dict[str, Any]:
        """Return what came of it."""
        errors = np.abs(np.array(self.errors_um or [0.0]))
        return {
            "hours": round(self.elapsed_s / 3600, 2),
            "cycles": sum(self.outcomes.values()),
            "outcomes": dict(self.outcomes),
            "error_um": {
                "p50": float(np.median(errors)),
                "p99": float(np.quantile(errors, 0.99)),
                "max": float(errors.max()),
            },
            "beyond": int((errors > GOOD_DOF * DEPTH_OF_FOCUS_UM).sum()),
            "rss_mb": [round(one, 1) for one in self.rss_mb],
            "counts": dict(sorted(self.counts.items())),
        }


class _Later:
    """An actor of the world that acts once."""

    def __init__(self, due_ns: int, do: Callable[[], object]) -> None:
        self._due_ns, self._do = due_ns, do
        self._done = False

    def advance_to(self, when: HostNs) -> None:
        """Act, if it is time."""
        if not self._done and when >= self._due_ns:
            self._done = True
            self._do()


def main() -> int:
    """Run a day; exit 1 if something did not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    log.configure()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(50))
    with tempfile.TemporaryDirectory() as directory:
        soak = Soak(chosen.seed, Path(directory))
        soak.run(chosen.hours)
        soak.finish()
    figures = soak.figures()
    if chosen.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:10s} {value}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
