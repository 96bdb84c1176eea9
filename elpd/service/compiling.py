"""Kernels that no cache has are compiled by processes of their own, two at a time, before the daemon is ready.

Compiling is work for one core, some twenty seconds of it, and LLVM keeps a hundred megabytes afterwards. So at the
first kernel that is missing two processes import what this one is about to and compile it, one from the front of the
list and one from the back, each what it is the first to claim (neighbours share helpers, which are then compiled once).
What they leave is the cache, from which this process loads everything. If they fail, or there is no place for a cache,
nothing is lost: what is missing is compiled here.
"""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from elpd.events.jit import division

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from elpd.config import Config

KERNEL_ROOMS = ("elpd.events", "elpd.vision", "elpd.focus")

FOR_FILES = frozenset({"elpd.events.ecf", "elpd.events.evt2_encode", "elpd.events.evt3_encode", "elpd.vision.paper"})
"""What no rig needs, only files; a rig that does brings it."""

ENDS_OF_THE_LIST = ("front", "back")
"""Where each process begins. It takes up to 300 MB while it lives: three would come near to the unit's MemoryMax=."""

LIMIT_S = 60.0
"""The slowest kernel takes 4 s of a PC's core: time for a board that is four times as slow and has other work to do."""

LOOK_EVERY_S = 0.2

STOPS = frozenset({signal.SIGTERM, signal.SIGINT})


def modules(config: Config | None = None, *, files: bool = False) -> list[str]:
    """Name the modules that hold the kernels a daemon needs, and the drivers of *config*'s camera or rig.

    With *files* also those that only reading and writing files needs.
    """
    found = []
    for room in KERNEL_ROOMS:
        spec = find_spec(room)
        for folder in [] if spec is None else spec.submodule_search_locations or []:
            found += [f"{room}.{path.stem}" for path in sorted(Path(folder).glob("*.py")) if path.stem != "__init__"]
    chosen = () if config is None else (("elpd.rigs", config.rig), ("elpd.cameras", config.camera.driver))
    drivers = [point.module for group, name in chosen for point in entry_points(group=group, name=name)]
    return [name for name in found if files or name not in FOR_FILES] + drivers


@contextmanager
def by_others(names: Sequence[str]) -> Iterator[None]:
    """Within this block kernels that no cache has are compiled by processes that import the modules *names*."""
    division.others = lambda: compile_elsewhere(names)
    try:
        yield
    finally:
        division.others = None


def compile_elsewhere(names: Sequence[str], limit_s: float = LIMIT_S) -> None:
    """Let other processes compile what the modules *names* need; return once they have ended, however they did.

    They are ended where none of them begins another kernel within *limit_s*.
    Raises ``SystemExit`` if this process was asked to end meanwhile by a signal that it holds back.
    """
    path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)  # noqa: PTH100  ("" is where we are)
    with tempfile.TemporaryDirectory(prefix="elpd-kernels-") as claims:
        children = [
            subprocess.Popen(  # noqa: S603  (our own)
                [sys.executable, "-P", "-m", "elpd.service.compiling", claims, end, *names],
                env={**os.environ, "PYTHONPATH": path},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
            for end in ENDS_OF_THE_LIST[: len(os.sched_getaffinity(0))]
        ]
        begun, since_s = 0, time.monotonic()
        while (alive := [child for child in children if child.poll() is None]) and time.monotonic() - since_s < limit_s:
            with suppress(subprocess.TimeoutExpired):
                alive[0].wait(LOOK_EVERY_S)
            if (now := len(os.listdir(claims))) != begun:  # noqa: PTH208  (only how many)
                begun, since_s = now, time.monotonic()
        for child in children:
            child.kill()
            child.wait()
    if signal.sigpending() & STOPS:
        raise SystemExit(0)


def main(claims: Path, end: str, names: Sequence[str]) -> None:
    """Compile what the modules *names* need, from one *end* of the list, but for what another process has claimed."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)  # whoever started this may hold them back
    put_off: list[tuple[str, Callable[[], None]]] = []
    division.put_off = put_off
    for name in names:
        with suppress(ImportError):  # a driver whose library is not here is told of when it is opened
            importlib.import_module(name)
    mine = cache(lambda kernel: _claim(claims, kernel))
    for kernel, compile_all in sorted(put_off, key=lambda one: one[0], reverse=end == "back"):
        if mine(kernel):
            compile_all()


def _claim(claims: Path, kernel: str) -> bool:
    try:
        (claims / sha256(kernel.encode()).hexdigest()).touch(exist_ok=False)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
