"""Everything that is slow the first time, done before the daemon says that it is ready.

Kernels have their signatures, so importing their rooms compiles them or loads them from the cache. A cache that cannot
be written, or is stale or damaged, costs time and nothing else.
"""

from __future__ import annotations

import gc
import importlib
import sys
import time
from pathlib import Path

import structlog

from elpd.service import memory

KERNEL_ROOMS = ("elpd.events", "elpd.vision", "elpd.focus")

SWITCH_INTERVAL_S = 5e-5
"""How long another thread may keep the interpreter before the focus thread gets it: 5 ms unless set."""

log = structlog.get_logger(__name__)


def warm_up() -> None:
    """Compile every kernel, and leave what exists by then out of the garbage collector's rounds."""
    begun_s = time.perf_counter()
    for room in KERNEL_ROOMS:
        folder = Path(str(importlib.import_module(room).__file__)).parent
        for path in sorted(folder.glob("*.py")):
            if path.stem != "__init__":
                importlib.import_module(f"{room}.{path.stem}")
    memory.drop_compiler()
    log.info("kernels ready", seconds=round(time.perf_counter() - begun_s, 3))


def settle() -> None:
    """Make pauses of the interpreter short; called once everything is built."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    memory.drop_compiler()  # a simulated rig brought kernels of its own
    memory.trim()
