"""Stories of the daemon: its engine stepped in virtual time, on a simulated rig with spies, without a thread."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from elpd_drivers.sim.rig import SimulatedTruth

from elpd import rig
from elpd.config import Config, load
from elpd.errors import ElpdError
from elpd.service.engine import RigEngine
from elpd.service.engine_port import Answer, Caller, Request
from elpd.service.messages import METHODS
from elpd.service.timing import VirtualTime

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from elpd.ports import RigParts
    from elpd.service.job import Job
    from elpd.service.messages import Event, Status

SMALL = ("sim.width=320", "sim.height=240", "sim.scene=camera", "focus.roi_fraction=0.5", "sim.seed=3")
"""A sensor that renders quickly, on a scene that focuses well."""

ME, SOMEBODY = Caller(1, 100, 1000, "me"), Caller(2, 200, 1001, "somebody")


class UnansweredError(AssertionError):
    """A request has no answer yet."""


@dataclass
class Asked:
    """A request and what came of it."""

    job: Job
    answers: list[Answer] = field(default_factory=list)

    @property
    def answer(self) -> Answer:
        """The one answer."""
        if not self.answers:
            raise UnansweredError(self.job.request.method)
        assert len(self.answers) == 1, "a request has one terminal answer"
        return self.answers[0]

    @property
    def result(self) -> Any:
        """The result; fails on an error."""
        assert self.answer.error is None, self.answer.error
        return self.answer.result

    @property
    def kind(self) -> str | None:
        """The error's kind, ``None`` for a result."""
        return None if self.answer.error is None else self.answer.error.kind


class Daemon:
    """An engine under test."""

    def __init__(
        self,
        directory: Path,
        *overrides: str,
        build: Callable[[Config], RigParts] = rig.build,
        small: bool = True,
        prepare: Callable[[Config], None] = lambda _: None,
    ) -> None:
        self.directory = directory
        self._overrides = (
            *(SMALL if small else ()),
            f"journal.directory={directory / 'runs'}",
            f"state.directory={directory / 'state'}",
            *overrides,
        )
        self.events: list[Event] = []
        self.built = 0
        self.asked: list[Asked] = []
        self._build = build
        self.time = VirtualTime()
        self.engine = RigEngine(self.config(), self.time, build=self._built, prepare=prepare)
        self.engine.listen(self.events.append)

    def config(self, *overrides: str) -> Config:
        """Return the configuration, changed."""
        return load(overrides=[*self._overrides, *overrides])

    def begin(self) -> Daemon:
        """Open the rig and take requests."""
        self.engine.step()
        self.engine.ready()
        return self

    def end(self) -> None:
        """Go down in order."""
        self.engine.begin_stopping()
        self.engine.step()
        self.engine.finish_stopping()

    # --- asking ---

    def ask(self, method: str, *, by: Caller = ME, **params: Any) -> Asked:
        """Submit a request; raises what the engine raises."""
        job = self.engine.submit(Request(method, METHODS[method].model_validate(params), by))
        asked = Asked(job)
        job.add_done_callback(asked.answers.append)
        self.asked.append(asked)
        return asked

    def refused(self, method: str, *, by: Caller = ME, **params: Any) -> ElpdError:
        """Submit a request that must be refused on the spot; return why."""
        try:
            self.ask(method, by=by, **params)
        except ElpdError as error:
            return error
        raise AssertionError(f"{method} was accepted")

    def do(self, method: str, *, by: Caller = ME, **params: Any) -> Any:
        """Submit, run until it is answered, return the result."""
        return self.until_answered(self.ask(method, by=by, **params)).result

    def until_answered(self, asked: Asked) -> Asked:
        """Run until a request has its answer."""
        self.until(lambda: bool(asked.answers))
        return asked

    # --- time ---

    def until(self, reached: Callable[[], bool], limit_s: float = 30.0) -> None:
        """Run until something is so."""
        end_s = self.time.now_s() + limit_s
        while not reached():
            assert self.time.now_s() < end_s, f"not within {limit_s:g} s"
            self.engine.step()

    def run(self, seconds: float) -> None:
        """Let the daemon turn for so long."""
        end_s = self.time.now_s() + seconds
        while self.time.now_s() < end_s:
            self.engine.step()

    def after_ms(self, ms: float, do: Callable[[], None]) -> None:
        """Do something in the rig's world, so many milliseconds from now, whatever the daemon does then."""
        truth = self.truth
        truth.world.add(_Once(truth.world.now_ns() + round(ms * 1e6), do))

    def at_phase(self, phase: str, after_ms: float, do: Callable[[], None]) -> None:
        """Do something so many milliseconds after the next cycle enters a phase."""

        def hear(event: Event) -> None:
            if event.event == "phase" and event.phase == phase:
                leave()
                self.after_ms(after_ms, do)

        leave = self.engine.listen(hear)

    # --- looking ---

    @property
    def status(self) -> Status:
        """What the daemon tells of itself."""
        return self.engine.status()

    @property
    def parts(self) -> RigParts:
        """The rig, while it is open."""
        assert self.engine.keeper.parts is not None
        return self.engine.keeper.parts

    @property
    def truth(self) -> SimulatedTruth:
        """What only the simulator knows."""
        truth = self.parts.truth
        assert isinstance(truth, SimulatedTruth)
        return truth

    @property
    def velocity(self) -> float:
        """How fast the motor turns now."""
        return float(self.truth.mechanism.velocity_at(self.truth.world.now_ns()))

    @property
    def steps(self) -> float:
        """Where the motor is now."""
        return float(self.truth.mechanism.pulses_at(self.truth.world.now_ns()))

    def told(self, name: str) -> list[Any]:
        """Return the events of one name."""
        return [event for event in self.events if event.event == name]

    def assert_all_answered(self) -> None:
        """Every accepted request has exactly one answer."""
        assert all(len(asked.answers) == 1 for asked in self.asked)

    def _built(self, config: Config) -> RigParts:
        self.built += 1
        return self._build(config)


class _Once:
    """An actor of the world that acts once."""

    def __init__(self, due_ns: int, do: Callable[[], None]) -> None:
        self._due_ns, self._do = due_ns, do
        self._done = False

    def advance_to(self, when: int) -> None:
        if not self._done and when >= self._due_ns:
            self._done = True
            self._do()
