"""What breaks during the day, and what must hold when it does. The numbers are those of the list of misfortunes.

Each acts at once, between requests or, half of the time, somewhere in the middle of a cycle. What needs a socket (34),
a supervisor that begins the process again (28) or a browser (39) is not here.
"""

from __future__ import annotations

import shutil
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from elpd_drivers.sim.motion import SceneMotion
from elpd_drivers.sim.world import random_stream

from elpd.service.notify import Notifier
from elpd.service.threads import FOCUS_LIMIT_S, Supervisor
from elpd.units import HostNs
from soaks.stage import KilledError

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.units import HostNs as Instant
    from soaks.stage import Stage

REACH_PX = 20.0
SHAKEN_S = 5.0


class Later:
    """An actor of the world that acts once."""

    def __init__(self, due_ns: int, do: Callable[[], object]) -> None:
        self._due_ns, self._do = due_ns, do
        self._done = False

    def advance_to(self, when: Instant) -> None:
        """Act, if it is time."""
        if not self._done and when >= self._due_ns:
            self._done = True
            self._do()


class Shaken:
    """A scene that moves violently for a while, then stands still again."""

    def __init__(self, seed: int, begin_ns: int) -> None:
        self._motion = SceneMotion("violent", random_stream(seed, "shaken"), REACH_PX)
        self._begin_us, self._last_us = begin_ns / 1e3, SHAKEN_S * 1e6

    def displacement_px(self, since_birth_us: float) -> tuple[float, float]:
        """Return (x, y)."""
        return self._motion.displacement_px(min(max(since_birth_us - self._begin_us, 0.0), self._last_us))


def misfortunes(stage: Stage) -> dict[str, Callable[[], object]]:
    """Return what may happen to *day*'s rig as it is now, by name."""
    truth, world, engine = stage.truth, stage.world, stage.engine
    faults, board = truth.port.faults, truth.port.wire.board

    def camera(**how: float) -> None:
        device: Any = engine.keeper.parts and engine.keeper.parts.camera
        if device is not None:
            device._faults = replace(device._faults, **how)  # noqa: SLF001  (nobody else may)

    def stand_still(seconds: float) -> None:
        world._now = HostNs(world._now + round(seconds * 1e9))  # noqa: SLF001  (as a stopped process sees it)

    def shake() -> None:
        light: Any = truth._light  # noqa: SLF001
        light._motion = Shaken(int(stage.chance.integers(1 << 16)), world.now_ns())  # noqa: SLF001

    def kill() -> None:
        if engine.place.current is None:
            stage.killed()
            return
        faults.drop_to_board = True  # whatever unwinds after this is no part of what is tried
        raise KilledError

    def hang() -> None:
        """Let the supervisor find a focus thread that has been silent for too long."""
        if engine.place.current is None:
            return
        beats: Any = engine.heartbeats
        beats._now_s = lambda: time.monotonic() + 2 * FOCUS_LIMIT_S + 15.0  # noqa: SLF001
        beats._limits_s["focus"] = FOCUS_LIMIT_S  # noqa: SLF001
        Supervisor(engine, Notifier({}), lambda: 0.0).look()
        beats._now_s = time.monotonic  # noqa: SLF001
        beats.forget("focus")

    def damage() -> None:
        path = stage.directory / "state" / "service.json"
        if path.exists():
            path.write_bytes(path.read_bytes()[: int(stage.chance.integers(200))])

    def fill_disk() -> None:
        """Put a file where the runs' folder was, for one cycle."""
        runs = stage.directory / "runs"
        shutil.rmtree(runs, ignore_errors=True)
        runs.touch()
        if engine.place.current is None:
            stage.wait(stage.ask("focus"))
            runs.unlink(missing_ok=True)
        else:
            stage.afterwards = lambda: runs.unlink(missing_ok=True)

    def reload_wrongly() -> None:
        engine.reload(stage.config("sim.board=no-such-board"))
        stage.afterwards = lambda: engine.reload(stage.config())

    return {
        "23 scene shakes": shake,
        "1 lens unplugged": lambda: setattr(faults, "disconnect_at_ns", world.now_ns()),
        "4 lens mute": lambda: setattr(faults, "drop_to_host", True),
        "5 lens deaf": lambda: setattr(faults, "drop_to_board", True),
        "3 board reset": lambda: board.reset_at(world.now_ns()),
        "15 camera unplugged": lambda: camera(vanishes_at_s=0.0),
        "17 camera silent": lambda: camera(silent_from_s=0.0),
        "26 killed": kill,
        "27 hangs": hang,
        "29 disk full": fill_disk,
        "30 state damaged": damage,
        "32 stopped for a moment": lambda: stand_still(0.7),
        "32 stopped for long": lambda: stand_still(3.0),
        "37 reloaded": lambda: engine.reload(stage.config("focus.deadline_ms=4000")),
        "37 reloaded wrongly": reload_wrongly,
    }
