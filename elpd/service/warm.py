"""Everything that is slow the first time, done before the daemon says that it is ready.

Kernels have their signatures, so importing their rooms compiles them or loads them from the cache. A cache that cannot
be written, or is stale or damaged, costs time and nothing else.
"""

from __future__ import annotations

import gc
import importlib
import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING

import structlog

from elpd.service import compiling, memory

if TYPE_CHECKING:
    from elpd.config import Config

SWITCH_INTERVAL_S = 5e-5
"""How long another thread may keep the interpreter before the focus thread gets it: 5 ms unless set."""

log = structlog.get_logger(__name__)


def warm_up(config: Config | None = None) -> None:
    """Have every kernel that the daemon and its rig need, and let go of what made them.

    Raises ``SystemExit`` if the process was asked to end meanwhile.
    """
    begun_s = time.perf_counter()
    names = compiling.modules(config)
    with compiling.by_others(names):
        for name in names:
            with suppress(ImportError):  # a driver whose library is not here is told of when it is opened
                importlib.import_module(name)
    memory.drop_compiler()
    log.info("kernels ready", seconds=round(time.perf_counter() - begun_s, 3))


def settle() -> None:
    """Make pauses of the interpreter short; called once everything is built."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    memory.drop_compiler()  # a simulated rig brought kernels of its own
    memory.trim()
