"""Stories: a whole cycle on the simulated rig in virtual time, a misfortune on the way, and what must hold afterwards.

``play`` runs one cycle with spies between the cycle and its devices: they note what was asked and when, and change
nothing. Misfortunes come as ``Event``: so many milliseconds after a phase began, do something to the world. Whatever
the story, ``assert_invariants`` must hold at its end; the test then says what else it expects.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from elpd_drivers.sim.rig import SimulatedTruth
from elpd_drivers.sim.world import BIRTH_NS

from elpd import rig
from elpd.config import Config, load
from elpd.errors import DeviceError, ElpdError
from elpd.focus.cycle import FocusCycle
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.records import BiasSet, CameraPacket, CommandStamp, FocusResult, LensReport, Outcome, Roi, StopMode
from elpd.units import NS_PER_MS, HostNs, after_ms

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from elpd.ports import Lens, RigParts
    from elpd.records import Geometry, LensCapabilities, LensLimits, PositionEstimate
    from elpd.units import Steps

SMALL = ("sim.width=320", "sim.height=240", "sim.scene=camera", "focus.roi_fraction=0.5", "journal.enabled=false")
"""A sensor that renders quickly, on a scene that focuses well."""

STOP_LIMIT_MS = 5.0
CAMERA_STOP_LIMIT_MS = 50.0
AFTERMATH_MS = 2_000.0
HISTORY_STEP_NS = 100_000


@dataclass(frozen=True)
class Event:
    """*do* to the story, *after_ms* of virtual time after the first note of *phase*."""

    phase: str
    after_ms: float
    do: Callable[[Story], None]


@dataclass(frozen=True)
class Command:
    """What the lens was asked, when, and until when it may move for it."""

    at_ns: int
    name: str
    until_ns: int | None = None
    mode: StopMode | None = None


@dataclass
class Story:
    """A cycle that was played: what it was asked, what it did, how it ended."""

    config: Config
    settings: CycleSettings
    parts: RigParts
    truth: SimulatedTruth
    start_steps: float
    result: FocusResult | None = None
    error: ElpdError | None = None
    ended_ns: int = 0
    errors: dict[str, float | None] = field(default_factory=dict)
    notes: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)
    lost_told: int = 0
    waiting: int = 0
    """How many packets the camera's ring is said to hold, one less with each that is read: a computer too slow."""
    fell_behind: bool = False
    camera_started_ns: int | None = None
    cancelled_ns: int | None = None
    misfortune_ns: int | None = None

    @property
    def outcome(self) -> Outcome | None:
        """How the cycle ended; ``None`` after an error."""
        return None if self.result is None else self.result.outcome

    def cancel(self) -> None:
        """Ask for the cycle's end, as a person would, now."""
        self.cancelled_ns = self.parts.clock.now_ns()

    def named(self, event: str) -> list[dict[str, Any]]:
        """Return the notes of one name."""
        return [fields for name, fields in self.notes if name == event]

    @property
    def phases(self) -> list[str]:
        """The phases in the order in which they began."""
        return [fields["name"] for fields in self.named("phase")]

    @property
    def reversal_travels_um(self) -> list[float]:
        """How far the lens went each time before it was told that focus lies behind."""
        return [abs(one["ended_um"] - one["begun_um"]) for one in self.named("sweep") if one["end"] == "behind"]

    @property
    def moved(self) -> bool:
        """Whether the lens was ever asked to move, or did."""
        asked = any(command.name in {"run", "move_to", "home"} for command in self.commands)
        return asked or bool(np.ptp(self.truth.mechanism.motor_steps(self.history_ns())))

    def stopped_after_ms(self, when_ns: int) -> float:
        """Return how long after an instant the next stop was sent."""
        later = [command.at_ns for command in self.commands if command.name == "stop" and command.at_ns >= when_ns]
        assert later, "no stop was sent"
        return (later[0] - when_ns) / NS_PER_MS

    def history_ns(self) -> np.ndarray:
        """Every tenth of a millisecond from the world's birth to now."""
        return np.arange(BIRTH_NS, self.parts.clock.now_ns(), HISTORY_STEP_NS)


def play(
    *overrides: str,
    request: FocusRequest | None = None,
    events: Sequence[Event] = (),
    small: bool = True,
    spy: type[SpyLens] | None = None,
) -> Story:
    """Run one cycle on a simulated rig, then let two seconds pass, and return the story."""
    config = load(overrides=[*(SMALL if small else ("journal.enabled=false",)), *overrides])
    settings = CycleSettings.from_config(config)
    inner = rig.build(config)
    truth = inner.truth
    assert isinstance(truth, SimulatedTruth)
    start_steps = truth.mechanism.pulses_at(inner.clock.now_ns())
    story = Story(config, settings, inner, truth, start_steps)
    lens, camera = (spy or SpyLens)(inner.lens, story), SpyCamera(inner.camera, story)
    story.parts = replace(inner, lens=lens, camera=camera)
    cycle = FocusCycle(
        story.parts,
        settings,
        request or FocusRequest(),
        Sink(story, events),
        cancelled=lambda: story.cancelled_ns is not None,
    )
    try:
        story.result = cycle.run()
    except ElpdError as error:
        story.error = error
    story.ended_ns = inner.clock.now_ns()
    if story.result is not None:
        story.errors = truth.errors(story.result)
    inner.clock.sleep_until(after_ms(inner.clock.now_ns(), AFTERMATH_MS))
    rig.release(inner)
    return story


def assert_invariants(story: Story) -> None:
    """What holds at the end of every story."""
    _one_ending(story)
    _limits_held(story)
    _motion_ended(story)
    _stops_came_in_time(story)
    result = story.result
    if result is None:
        return
    assert result.lost >= story.lost_told, "loss is counted"
    assert result.lost == story.lost_told or story.fell_behind, "nothing is let go but under an overload"
    assert result.reversals <= story.settings.max_reversals
    if result.outcome is Outcome.FOCUSED:
        final = story.errors["final_error_um"]
        assert final is not None
        assert abs(final) <= story.settings.depth_of_focus_um, f"never FOCUSED without evidence: {final:+.1f} um off"
        assert result.focus_um is not None
        assert result.sigma_um is not None
        assert result.sigma_um <= story.settings.max_sigma_dof * story.settings.depth_of_focus_um
    else:
        _at_declared_place(story)


def _one_ending(story: Story) -> None:
    assert (story.result is None) != (story.error is None)
    results = story.named("result")
    assert len(results) == (story.result is not None), "exactly one terminal result"
    if story.result is not None:
        assert story.notes[-1][0] == "result", "nothing is decided after the result"
        assert story.result.reason


def _limits_held(story: Story) -> None:
    times = story.history_ns()
    limits, mechanism = story.parts.lens.limits, story.truth.mechanism
    asked = mechanism.motor_steps(times)
    assert asked.min() >= limits.min_steps - 1, "the motor was sent below its limits"
    assert asked.max() <= limits.max_steps + 1, "the motor was sent above its limits"
    speed_sps = np.abs(np.diff(asked)) / (HISTORY_STEP_NS / 1e9)
    assert speed_sps.max(initial=0.0) <= 1.01 * limits.max_speed_sps


def _motion_ended(story: Story) -> None:
    """No motion outlives its deadline: braking included, the pulses have ended or another command took over."""
    capabilities, mechanism = story.parts.lens.capabilities, story.truth.mechanism
    braking_ms = capabilities.stop_onset_ms + 4 * capabilities.stop_onset_sigma_ms + 25.0
    moves = [command for command in story.commands if command.name != "stop"]
    for command in moves:
        assert command.until_ns is not None
        end_ns = after_ms(HostNs(command.until_ns), braking_ms)
        overtaken = any(other.at_ns > command.at_ns and other.at_ns <= end_ns for other in story.commands)
        if not overtaken and end_ns < story.parts.clock.now_ns():
            assert mechanism.velocity_at(end_ns) == 0.0, f"{command.name} outlived its deadline"
    if story.result is not None:
        assert mechanism.velocity_at(story.ended_ns) == 0.0, "a result means a lens at rest"
        now = story.parts.clock.now_ns()
        assert mechanism.pulses_at(now) == mechanism.pulses_at(story.ended_ns), "the lens moved after the result"
    else:
        assert mechanism.velocity_at(story.parts.clock.now_ns()) == 0.0, "the lens moves two seconds after a fault"


def _stops_came_in_time(story: Story) -> None:
    mechanism = story.truth.mechanism
    if story.cancelled_ns is not None and mechanism.velocity_at(story.cancelled_ns) != 0.0:
        assert story.stopped_after_ms(story.cancelled_ns) <= STOP_LIMIT_MS
    if isinstance(story.error, DeviceError):
        stops = [command for command in story.commands if command.name == "stop"]
        assert stops, "a fault sends a stop, whatever is broken"
        assert stops[-1].mode is StopMode.ABRUPT, "the strongest stop"
        assert (story.ended_ns - stops[-1].at_ns) / NS_PER_MS <= STOP_LIMIT_MS


def _at_declared_place(story: Story) -> None:
    declared_um = {"start": None, "hold": None, "preset": story.settings.preset_um}[story.settings.on_failure]
    steps = story.truth.mechanism.pulses_at(story.ended_ns)
    if story.settings.on_failure == "start":
        assert abs(steps - story.start_steps) <= 1.0, "the lens is back at its start"
    elif declared_um is not None:
        assert abs(steps - declared_um / story.parts.um_per_step) <= 1.0, "the lens is at its preset"


class Sink:
    """The notes of a story; phases start its events' clocks."""

    def __init__(self, story: Story, events: Sequence[Event]) -> None:
        self._story = story
        self._events = list(events)

    def note(self, event: str, /, **fields: Any) -> None:
        self._story.notes.append((event, fields))
        if event != "phase":
            return
        for due in [one for one in self._events if one.phase == fields["name"]]:
            self._events.remove(due)
            self._story.truth.world.add(Timer(self._story, due))


class Timer:
    """An actor of the world that acts once, when its time has come."""

    def __init__(self, story: Story, event: Event) -> None:
        self._story = story
        self._event: Event | None = event
        self._due_ns = after_ms(story.parts.clock.now_ns(), event.after_ms)

    def advance_to(self, when: HostNs) -> None:
        if self._event is not None and when >= self._due_ns:
            event, self._event = self._event, None
            if self._story.ended_ns == 0:
                self._story.misfortune_ns = when
                event.do(self._story)


class SpyLens:
    """Notes every command; changes nothing."""

    def __init__(self, lens: Lens, story: Story) -> None:
        self.inner, self.story = lens, story

    @property
    def limits(self) -> LensLimits:
        return self.inner.limits

    @property
    def capabilities(self) -> LensCapabilities:
        return self.inner.capabilities

    def home(self, deadline: HostNs) -> LensReport:
        self._heard("home", until_ns=deadline)
        return self.inner.home(deadline)

    def move_to(self, target: Steps, speed_sps: float) -> CommandStamp:
        now = self.story.parts.clock.now_ns()
        way_s = abs(target - self.inner.position_at(now).steps) / speed_sps + 0.3
        self._heard("move_to", until_ns=after_ms(now, 1000.0 * way_s))
        return self.inner.move_to(target, speed_sps)

    def run(self, velocity_sps: float, until: HostNs) -> CommandStamp:
        self._heard("run", until_ns=until)
        return self.inner.run(velocity_sps, until)

    def stop(self, mode: StopMode) -> CommandStamp:
        self._heard("stop", mode=mode)
        return self.inner.stop(mode)

    def poll(self) -> LensReport | None:
        return self.inner.poll()

    def position_at(self, when: HostNs) -> PositionEstimate:
        return self.inner.position_at(when)

    def _heard(self, name: str, until_ns: int | None = None, mode: StopMode | None = None) -> None:
        self.story.commands.append(Command(self.story.parts.clock.now_ns(), name, until_ns, mode))


class SpyCamera:
    """Counts what a camera says was lost; passes everything on."""

    def __init__(self, camera: Any, story: Story) -> None:
        self._camera, self._story = camera, story

    @property
    def geometry(self) -> Geometry:
        return self._camera.geometry

    @property
    def min_latency_us(self) -> float:
        return float(self._camera.min_latency_us)

    def start(self) -> None:
        self._story.camera_started_ns = self._story.parts.clock.now_ns()
        self._camera.start()

    def read(self, timeout_s: float) -> CameraPacket | None:
        packet = self._camera.read(timeout_s)
        if packet is not None:
            self._story.lost_told += packet.lost_events
            if self._story.waiting > 0:
                packet = replace(packet, backlog=self._story.waiting)
                self._story.fell_behind = True
                self._story.waiting -= 1
        return packet

    def stop(self) -> None:
        self._camera.stop()

    def close(self) -> None:
        self._camera.close()

    def set_window(self, window: Roi | None) -> None:
        self._camera.set_window(window)

    def apply_biases(self, biases: BiasSet) -> None:
        self._camera.apply_biases(biases)

    def set_mask(self, pixels: Sequence[tuple[int, int]]) -> int:
        return int(self._camera.set_mask(pixels))
