"""Virtual time: it moves only when somebody waits.

A simulated rig has one consumer (the focus loop) and a few devices, so a scheduler would be furniture. The world keeps
one number, the present instant, and moves it in ``sleep_until``: in slices short enough that a byte written at one
instant reaches its board before the next, telling each actor to catch up. Nothing else moves time, so a run is as
fast as the CPU and repeats bit for bit. With a *pace* the world additionally sleeps so as never to run ahead of the
wall clock; it may fall behind, and ``lag_s`` says by how much. It makes up for at most 50 ms of that, so that after an
idle minute, in which nobody waited, it does not rush through the next one.

Randomness is one generator per component, derived from the seed and the component's name, so that a part which
draws once more does not change what another part sees.
"""

from __future__ import annotations

import time
import zlib
from typing import Protocol

import numpy as np

from elpd.errors import ConfigError
from elpd.units import NS_PER_S, HostNs

BIRTH_NS = HostNs(NS_PER_S)
"""The first instant. Not zero, so that a duration mistaken for an instant shows."""

SLICE_NS = 250_000
"""The longest that actors are left alone while time passes."""

CATCH_UP_S = 0.05
"""How far behind the wall clock a paced world may be and still hurry."""


class Actor(Protocol):
    """Something that lives in the world's time, such as a lens board."""

    def advance_to(self, when: HostNs) -> None:
        """Let time pass up to *when*; never earlier than the last call."""
        ...


class World:
    """The clock of a simulated rig (``elpd.ports.Clock``). Used from one thread.

    Parameters
    ----------
    pace
        0: as fast as the CPU can. Otherwise how many virtual seconds pass per wall second, at the most.
    """

    def __init__(self, pace: float = 0.0) -> None:
        if not 0 <= pace < float("inf"):
            raise ConfigError(f"sim.pace is {pace}; give 0 (virtual time), 1 (the wall clock's) or another factor")
        self._pace = pace
        self._now = BIRTH_NS
        self._actors: list[Actor] = []
        self._wall_birth_s = self._anchor_s = time.monotonic()

    def add(self, actor: Actor) -> None:
        """Let *actor* live here from now on."""
        self._actors.append(actor)

    def now_ns(self) -> HostNs:
        """Return the present virtual instant."""
        return self._now

    def sleep_until(self, when: HostNs) -> None:
        """Let time pass until *when*; return at once if it has passed."""
        while self._now < when:
            self._now = HostNs(min(when, self._now + SLICE_NS))
            for actor in self._actors:
                actor.advance_to(self._now)
        if self._pace > 0:
            self._keep_pace()

    def leap_to(self, when: HostNs) -> None:
        """Let time pass in one step, for hours in which nobody listens; what is under way arrives at its end."""
        if when > self._now:
            self._now = when
            for actor in self._actors:
                actor.advance_to(when)

    @property
    def lag_s(self) -> float:
        """How far the paced world is behind the wall clock, in wall seconds; negative if ahead; 0 without a pace."""
        return 0.0 if self._pace == 0 else time.monotonic() - self._wall_birth_s - self._passed_s()

    def _keep_pace(self) -> None:
        behind_s = time.monotonic() - self._anchor_s - self._passed_s()
        if behind_s < 0:
            time.sleep(-behind_s)
        elif behind_s > CATCH_UP_S:
            self._anchor_s += behind_s - CATCH_UP_S

    def _passed_s(self) -> float:
        """Return how long, in wall seconds, the time since birth should have taken."""
        return (self._now - BIRTH_NS) / NS_PER_S / self._pace


def random_stream(seed: int, component: str) -> np.random.Generator:
    """Return *component*'s own generator; streams of different names or seeds are independent."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, zlib.crc32(component.encode())])))
