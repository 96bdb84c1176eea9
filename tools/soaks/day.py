"""The daemon's engine in virtual time, stepped without threads; hours in which nobody listens are leapt over.

Focus is knocked away while the camera listens, and the daemon is expected to find it again by itself. What must hold is
asserted at every turn: the lens stays inside its limits, it rests when nothing is done, every request has one answer.
"""

from __future__ import annotations

import sys
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np
from elpd_drivers.sim.world import World

from elpd import rig
from elpd.config import Config, load
from elpd.errors import ElpdError
from elpd.service import memory
from elpd.service.engine import RigEngine
from elpd.service.engine_port import Answer, Request
from elpd.service.messages import METHODS
from elpd.service.timing import VirtualTime
from elpd.units import HostNs
from soaks.ledger import Ledger
from soaks.misfortunes import GIVEN_UP_S, GIVEN_UP_TURN_S, KilledError, Later, misfortunes
from soaks.people import ANSWERED_S, PEOPLE, visit

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from elpd.ports import Clock

TRAVEL_UM, UM_PER_STEP, DEPTH_OF_FOCUS_UM = 2500.0, 0.3125, 6.0
RIG = (
    "sim.width=160", "sim.height=120", "sim.scene=camera", "focus.roi_fraction=0.8", "sim.noise_hz=0.2",
    "journal.budget_mb=20", "journal.keep=8", "service.poll_ms=400", "service.look_s=0.8", "service.look_every_s=60",
    "modes.hold_off_s=5", "temperature.table=[[0, 0], [40, 40]]",
)  # fmt: skip
KNOCK_S = 0.4
"""How long after the camera began to listen focus is knocked away; the rest of the look hears of it."""

KNOCK_UM, KNOCK_MS, KNOCKS = 90.0, 40.0, 0.75
"""How far (standard deviation), how long it takes, and in which share of the looks."""

FAR_UM = 250.0
ROOM_UM = 500.0
"""Focus stays so far from the ends of the travel."""

MILD_C = 20.0
COLD_C, HOT_C = 5.0, 35.0
WARMED_MS = 200.0
PEOPLE_EVERY_S = 240.0
MISFORTUNE_EVERY_S = 900.0
CLEARED_AFTER_S = 30.0
WEIGHED_EVERY_S = 1800.0


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


class Day:
    """One day, or as long as it is run. Everything follows from the seed."""

    def __init__(
        self,
        seed: int,
        directory: Path,
        *,
        people_every_s: float = PEOPLE_EVERY_S,
        misfortune_every_s: float = MISFORTUNE_EVERY_S,
    ) -> None:
        self.chance = np.random.default_rng(seed)
        self.directory = directory
        self.ledger = Ledger(DEPTH_OF_FOCUS_UM)
        self.waiting: dict[int, str] = {}
        self.enough = False
        """Set to end ``run`` early."""
        self.elapsed_s = 0.0
        self.celsius = MILD_C
        self.afterwards: Callable[[], object] | None = None
        """What undoes a misfortune, once the cycle that it befell has ended."""
        self._people_every_s, self._misfortune_every_s = people_every_s, misfortune_every_s
        self._numbers = count()
        self._offset_um = 0.0
        self._next_person_s = self._next_misfortune_s = 0.0
        self._clear_at_s: float | None = None
        self._knocked_look = True
        self._doubled: list[str] = []
        self._begin()

    # --- the daemon's life ---

    def config(self, *overrides: str) -> Config:
        """Return the rig's configuration."""
        where = (f"journal.directory={self.directory / 'runs'}", f"state.directory={self.directory / 'state'}")
        return load(overrides=[*RIG, *where, f"sim.seed={self.chance.integers(1 << 16)}", *overrides])

    def killed(self) -> None:
        """Begin anew after an end without a word. Whoever waited for an answer has lost its connection."""
        self.waiting.clear()
        self.engine.keeper.close()
        for _ in range(round(GIVEN_UP_S / GIVEN_UP_TURN_S)):
            self.world.leap_to(HostNs(self.world.now_ns() + round(GIVEN_UP_TURN_S * 1e9)))
        self._check_limits()
        assert self.truth.mechanism.velocity_at(self.world.now_ns()) == 0.0, "the lens of a dead process still moves"
        self._begin()

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
        self._offset_um = 0.0
        self.world, self.truth = parts.clock, parts.truth
        return parts

    def _recover(self) -> None:
        """Do what a person does after a start or a fault: see to it, clear it, home, ask for continuous autofocus."""
        if self.afterwards is not None:
            self.afterwards()
            self.afterwards = None
        self.engine.clear()
        self.until(lambda: self.engine.keeper.parts is not None and self.engine.situation.fault is None, 30.0)
        if self.engine.situation.lens.referenced is not True:
            self.wait(self.ask("home"))
            self.wait(self.ask("move", to_um=self.somewhere_um()))
        self.wait(self.ask("mode", mode="continuous"))

    def run(self, hours: float, cycles: int = 0) -> None:
        """Let so many hours pass, and more until there were so many cycles."""
        memory.drop_compiler()  # as the daemon does
        end_s, weighed_s = self.elapsed_s + 3600.0 * hours, self.elapsed_s
        while not self.enough and (self.elapsed_s < end_s or self.ledger.outcomes.total() < cycles):
            try:
                self._turn()
            except KilledError:
                self.killed()
            if self.elapsed_s - weighed_s >= WEIGHED_EVERY_S:
                weighed_s = self.elapsed_s
                row = self.ledger.weigh(weighed_s / 3600)
                print(f"{row}  {dict(self.ledger.outcomes)}", file=sys.stderr, flush=True)

    def finish(self) -> None:
        """End in order; nothing may be left unanswered."""
        self.engine.begin_stopping()
        self.engine.step()
        self.engine.finish_stopping()
        assert not self.waiting, f"unanswered: {self.waiting}"

    def figures(self) -> dict[str, Any]:
        """Return what came of it."""
        return {"hours": round(self.elapsed_s / 3600, 2), **self.ledger.figures()}

    # --- one turn ---

    def _turn(self) -> None:
        before = self.ledger.outcomes.total()
        self.engine.step()
        if self.ledger.outcomes.total() != before:
            memory.give_back()  # as the daemon does
        self.elapsed_s = self.time.now_s()
        self._check()
        self._knock()
        if self.elapsed_s > self._next_person_s:
            self._next_person_s = self.elapsed_s + float(self.chance.exponential(self._people_every_s))
            visit(self)
        if self.elapsed_s > self._next_misfortune_s:
            self._next_misfortune_s = self.elapsed_s + float(self.chance.exponential(self._misfortune_every_s))
            self._misfortune()
        if self.engine.situation.fault is None:
            self._clear_at_s = None
        elif self._clear_at_s is None:
            self._clear_at_s = self.elapsed_s + CLEARED_AFTER_S
        elif self.elapsed_s > self._clear_at_s:
            self._clear_at_s = None
            self._recover()

    def _check(self) -> None:
        self._check_limits()
        if self.engine.place.current is None and self.engine.keeper.parts is not None:
            # a stop that was sent with the last breath of a request may still be on the wire
            resting = self.truth.mechanism.velocity_at(self.world.now_ns()) == 0.0
            assert resting or self.engine.situation.fault is not None, "the lens moves, and nobody asked for it"
        assert not self._doubled, f"answered twice: {self._doubled}"

    def _check_limits(self) -> None:
        um = self.truth.mechanism.pulses_at(self.world.now_ns()) * UM_PER_STEP
        assert -1.0 <= um <= TRAVEL_UM + 1.0, f"outside the limits: {um} um"

    def _knock(self) -> None:
        """Move focus while the camera listens, once a look, mostly."""
        if self.engine.place.current is not None or not self.engine.idle.looking:
            self._knocked_look = False
            return
        if self._knocked_look or self.chance.random() > KNOCKS:
            self._knocked_look = True
            return
        self._knocked_look = True
        by_um = float(self.chance.normal(0.0, KNOCK_UM))
        if not ROOM_UM < self._focus_um() + by_um < TRAVEL_UM - ROOM_UM:
            by_um = -by_um
        self.ledger.counts["knocks"] += 1
        self._shift(by_um, KNOCK_S, KNOCK_MS)

    def _shift(self, by_um: float, in_s: float, over_ms: float) -> None:
        self._offset_um += by_um
        begin_s = self.time.now_s() + in_s
        self.ledger.shifted(begin_s, begin_s + 1e-3 * over_ms, by_um)
        self.truth.drift.shift(self.world.now_ns() + round(in_s * 1e9), by_um, over_ms)

    def _misfortune(self) -> None:
        """Let something break, at any moment of whatever is being done."""
        if self.engine.keeper.parts is None or self.engine.situation.fault is not None:
            return
        what = misfortunes(self)
        name = str(self.chance.choice(list(what)))
        self.ledger.counts[name] += 1
        if self.chance.random() < 0.5 or name.startswith("27"):
            self.ask("focus")
            self.world.add(Later(self.world.now_ns() + int(self.chance.uniform(1e6, 300e6)), what[name]))
            self.until(lambda: not self.waiting, ANSWERED_S)
        else:
            what[name]()
        if self.afterwards is not None and self.engine.situation.fault is None and self.engine.worker.reload is None:
            self.afterwards()
            self.afterwards = None

    # --- what people and misfortunes use ---

    def ask(self, method: str, **params: Any) -> int | None:
        """Ask for something; ``None`` if it was refused."""
        number = next(self._numbers)
        caller = PEOPLE[int(self.chance.integers(len(PEOPLE)))]
        self.ledger.counts["requests"] += 1
        try:
            job = self.engine.submit(Request(method, METHODS[method].model_validate(params), caller))
        except ElpdError as error:
            self.ledger.counts[f"refused {error.kind}"] += 1
            return None
        self.waiting[number] = method
        job.add_done_callback(lambda answer: self._answered(number, method, answer))
        return number

    def somewhere_um(self) -> float:
        """Return a place from which focus can be found; a map from a millimetre off shows nothing."""
        return self._focus_um() + float(self.chance.uniform(-FAR_UM, FAR_UM))

    def warm(self, by_c: float) -> float:
        """Let it become warmer, focus with it; return the new temperature (40)."""
        before_c = self.celsius
        self.celsius = float(np.clip(self.celsius + by_c, COLD_C, HOT_C))
        self._shift(self.celsius - before_c, 0.0, WARMED_MS)
        return self.celsius

    def wait(self, number: int | None) -> None:
        """Let time pass until a request is answered."""
        if number is not None:
            self.until(lambda: number not in self.waiting, ANSWERED_S)

    def until(self, reached: Callable[[], bool], limit_s: float) -> None:
        """Let time pass until something holds."""
        end_s = self.time.now_s() + limit_s
        while not reached():
            assert self.time.now_s() < end_s, f"not within {limit_s:g} s: {self.waiting}, {self.engine.status()}"
            self.engine.step()

    # --- below ---

    def _focus_um(self) -> float:
        return float(self.truth.focus_carriage_um + self._offset_um)

    def _answered(self, number: int, method: str, answer: Answer) -> None:
        if self.waiting.pop(number, None) is None:
            self._doubled.append(f"{method} {number}")
        self.ledger.counts["answers"] += 1
        if answer.error is not None:
            self.ledger.counts[f"error {answer.error.kind}"] += 1
            if answer.error.kind == "InternalError":  # a defect, whatever befell it
                print(f"{self.elapsed_s:.0f} s  {method}: {answer.error.message}", file=sys.stderr, flush=True)

    def _hear(self, event: Any) -> None:
        if event.event == "state" and event.state == "FOCUSING":
            self.ledger.began(self.time.now_s())
        elif event.event == "result":
            self.ledger.ended(self.time.now_s(), event.outcome, (event.truth or {}).get("final_error_um"))
