"""The daemon's engine on a simulated rig in virtual time, and what must hold of it at any time.

It is begun and killed, asked and waited for; whoever asks and whatever breaks is elsewhere (``people``,
``misfortunes``), and when (``day``).
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
from elpd.service.engine import RigEngine
from elpd.service.engine_port import Answer, Caller, Request
from elpd.service.messages import METHODS
from elpd.service.timing import VirtualTime
from elpd.units import HostNs
from soaks.ledger import Ledger

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from elpd.ports import Clock

PEOPLE = tuple(Caller(number, 1000 + number, 1000, f"person {number}") for number in (1, 2, 3))
ANSWERED_S = 60.0

TRAVEL_UM, UM_PER_STEP, DEPTH_OF_FOCUS_UM = 2500.0, 0.3125, 6.0
RIG = (
    "sim.width=160", "sim.height=120", "sim.scene=camera", "focus.roi_fraction=0.8", "sim.noise_hz=0.2",
    "journal.budget_mb=20", "journal.keep=8", "service.poll_ms=400", "service.look_s=0.8", "service.look_every_s=60",
    "modes.hold_off_s=5", "temperature.table=[[0, 0], [40, 40]]",
)  # fmt: skip
FAR_UM = 250.0

MILD_C = 20.0
COLD_C, HOT_C = 5.0, 35.0
WARMED_MS = 200.0

GIVEN_UP_S, GIVEN_UP_TURN_S = 30.0, 0.05
"""A lens that nobody commands any more has come to rest by then: its controller's own dead-man, or its target."""


class KilledError(BaseException):
    """The process ends here, without a word: nothing may catch this."""


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


class Stage:
    """A daemon and its rig. Everything random follows from the seed."""

    def __init__(self, seed: int, directory: Path) -> None:
        self.chance = np.random.default_rng(seed)
        self.directory = directory
        self.ledger = Ledger(DEPTH_OF_FOCUS_UM)
        self.waiting: dict[int, str] = {}
        self.elapsed_s = 0.0
        self.celsius = MILD_C
        self.afterwards: Callable[[], object] | None = None
        """What undoes a misfortune, once the cycle that it befell has ended."""
        self._numbers = count()
        self._offset_um = 0.0
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
        self.check_limits()
        assert self.truth.mechanism.velocity_at(self.world.now_ns()) == 0.0, "the lens of a dead process still moves"
        self._begin()

    def _begin(self) -> None:
        self.time = LeapingTime(self.elapsed_s)
        self.engine = RigEngine(self.config(), self.time, build=self._build)
        self.engine.listen(self._hear)
        self.engine.step()
        self.engine.ready()
        self.recover()

    def _build(self, config: Config) -> Any:
        parts = rig.build(config)
        assert isinstance(parts.clock, World)
        self._offset_um = 0.0
        self.world, self.truth = parts.clock, parts.truth
        return parts

    def recover(self) -> None:
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

    def finish(self) -> None:
        """End in order; nothing may be left unanswered."""
        self.engine.begin_stopping()
        self.engine.step()
        self.engine.finish_stopping()
        assert not self.waiting, f"unanswered: {self.waiting}"

    # --- what must hold ---

    def check(self) -> None:
        """Assert that the lens rests unless somebody asked, and that nothing was answered twice."""
        self.check_limits()
        if self.engine.place.current is None and self.engine.keeper.parts is not None:
            # a stop that was sent with the last breath of a request may still be on the wire
            resting = self.truth.mechanism.velocity_at(self.world.now_ns()) == 0.0
            assert resting or self.engine.situation.fault is not None, "the lens moves, and nobody asked for it"
        assert not self._doubled, f"answered twice: {self._doubled}"

    def check_limits(self) -> None:
        """Assert that the lens is inside its limits."""
        um = self.truth.mechanism.pulses_at(self.world.now_ns()) * UM_PER_STEP
        assert -1.0 <= um <= TRAVEL_UM + 1.0, f"outside the limits: {um} um"

    # --- what people and misfortunes use ---

    def shift(self, by_um: float, in_s: float, over_ms: float) -> None:
        """Move focus, so far, after so long, over so long."""
        self._offset_um += by_um
        begin_s = self.time.now_s() + in_s
        self.ledger.shifted(begin_s, begin_s + 1e-3 * over_ms, by_um)
        self.truth.drift.shift(self.world.now_ns() + round(in_s * 1e9), by_um, over_ms)

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
        return self.focus_um + float(self.chance.uniform(-FAR_UM, FAR_UM))

    def warm(self, by_c: float) -> float:
        """Let it become warmer, focus with it; return the new temperature (40)."""
        before_c = self.celsius
        self.celsius = float(np.clip(self.celsius + by_c, COLD_C, HOT_C))
        self.shift(self.celsius - before_c, 0.0, WARMED_MS)
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

    @property
    def focus_um(self) -> float:
        """Where focus is."""
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
