"""Kernels that no cache has are compiled by processes of their own, two at a time, before the daemon is ready.

Compiling is work for one core, some ten seconds of it, and LLVM keeps a hundred megabytes afterwards. So at the first
kernel that is missing two processes import what this one is about to and compile it, one from the front of the list and
one from the back, each what it is the first to claim (neighbours share helpers, which are then compiled once). What
they leave is the cache, from which this process loads everything. If they fail, or there is no place for a cache,
nothing is lost: what is missing is compiled here.

Half of all kernels are for encodings that the rig's camera does not speak. A driver may say beforehand which it does,
by a function ``encodings(settings)`` in its module; for one that does not, all are compiled.
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
from functools import cache, partial
from hashlib import sha256
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elpd.events.jit import division
from elpd.records import Encoding

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence
    from importlib.metadata import EntryPoint

    from elpd.config import Config
    from elpd.events.jit import PutOff

KERNEL_ROOMS = ("elpd.events", "elpd.vision", "elpd.focus")

FOR_FILES = frozenset({"elpd.events.ecf", "elpd.events.evt2_encode", "elpd.events.evt3_encode", "elpd.vision.paper"})
"""What no rig needs, only files; a rig that does brings it."""

ENDS_OF_THE_LIST = ("front", "back")
"""Where each process begins. It takes up to 300 MB while it lives: three would come near to the unit's MemoryMax=."""

ALL = "all"

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
    drivers = [] if config is None else [point.module for point, _ in _chosen(config)]
    return [name for name in found if files or name not in FOR_FILES] + drivers


def wanted(config: Config) -> frozenset[str]:
    """Return whom kernels must serve (``PutOff.serves``) for *config*'s camera, whose driver has been imported.

    The camera of a simulated rig may be replaced by one of a driver: what either speaks.
    """
    spoken: set[Encoding] = set()
    for point, settings in _chosen(config):
        says = getattr(sys.modules.get(point.module), "encodings", lambda _: frozenset(Encoding))
        spoken |= says(settings)
    return frozenset(encoding.value for encoding in spoken or Encoding)


def _chosen(config: Config) -> list[tuple[EntryPoint, dict[str, Any]]]:
    chosen = (("elpd.rigs", config.rig, config.sim), ("elpd.cameras", config.camera.driver, config.camera))
    return [
        (point, section.model_dump())
        for group, name, section in chosen
        for point in entry_points(group=group, name=name)
    ]


def import_all(names: Sequence[str]) -> None:
    """Import modules; a driver whose library is not here is told of when it is opened."""
    for name in names:
        with suppress(ImportError):
            importlib.import_module(name)


def compile_put_off(put_off: list[PutOff], wanted: Collection[str] | None) -> None:
    """Compile what serves everybody or any of *wanted* (all, for ``None``); the rest stays in the list."""
    now = [kernel for kernel in put_off if wanted is None or not kernel.serves or kernel.serves in wanted]
    put_off[:] = [kernel for kernel in put_off if kernel not in now]
    for kernel in now:
        kernel.compile()


def asked_to_end() -> bool:
    """Say whether a signal that this process holds back asks it to end."""
    return bool(signal.sigpending() & STOPS)


@contextmanager
def by_others(
    names: Sequence[str], wanted: Collection[str] | None = None, ended: Callable[[], bool] = asked_to_end
) -> Iterator[None]:
    """Within this block kernels that no cache has are compiled by processes that import the modules *names*.

    Those that serve *wanted* or everybody; ``None`` is all there are.
    """
    division.others = lambda: compile_elsewhere(names, wanted, ended)
    try:
        yield
    finally:
        division.others = None


def compile_elsewhere(
    names: Sequence[str],
    wanted: Collection[str] | None = None,
    ended: Callable[[], bool] = asked_to_end,
    limit_s: float = LIMIT_S,
) -> None:
    """Let other processes compile what the modules *names* have for *wanted*; return once they have ended, in any way.

    For *wanted* see ``by_others``. They are ended where none of them begins another kernel within *limit_s*.
    Raises ``SystemExit`` if this process was asked to end meanwhile: unless *ended* says it, by a signal that it holds
    back.
    """
    path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)  # noqa: PTH100  ("" is where we are)
    which = ALL if wanted is None else ",".join(wanted)
    with tempfile.TemporaryDirectory(prefix="elpd-kernels-") as claims:
        children = [
            subprocess.Popen(  # noqa: S603  (our own)
                [sys.executable, "-P", "-m", "elpd.service.compiling", claims, end, which, *names],
                env={**os.environ, "PYTHONPATH": path},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
            for end in ENDS_OF_THE_LIST[: len(os.sched_getaffinity(0))]
        ]
        begun, since_s = 0, time.monotonic()
        while (alive := [child for child in children if child.poll() is None]) and time.monotonic() - since_s < limit_s:
            if ended():
                break
            with suppress(subprocess.TimeoutExpired):
                alive[0].wait(LOOK_EVERY_S)
            if (now := len(os.listdir(claims))) != begun:  # noqa: PTH208  (only how many)
                begun, since_s = now, time.monotonic()
        for child in children:
            child.kill()
            child.wait()
    if ended():
        raise SystemExit(0)


def main(claims: Path, end: str, wanted: Collection[str] | None, names: Sequence[str]) -> None:
    """Compile what modules have for *wanted*, from one *end* of the list, but for what another process has claimed."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)  # whoever started this may hold them back
    put_off: list[PutOff] = []
    division.put_off = put_off
    import_all(names)
    mine = cache(lambda kernel: _claim(claims, kernel))
    put_off.sort(key=lambda kernel: kernel.name, reverse=end == "back")
    compile_put_off([kernel._replace(compile=partial(_compile_if, mine, kernel)) for kernel in put_off], wanted)


def _compile_if(mine: Callable[[str], bool], kernel: PutOff) -> None:
    if mine(kernel.name):
        kernel.compile()


def _claim(claims: Path, kernel: str) -> bool:
    try:
        (claims / sha256(kernel.encode()).hexdigest()).touch(exist_ok=False)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], None if sys.argv[3] == ALL else sys.argv[3].split(","), sys.argv[4:])
