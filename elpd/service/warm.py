"""Everything that is slow the first time, done before the daemon says that it is ready.

Kernels have their signatures, so they are compiled, or loaded from the cache, before anything is fed to them; those for
encodings that the rig's camera does not speak are not. A cache that cannot be written, or is stale or damaged, costs
time and nothing else.
"""

from __future__ import annotations

import gc
import sys
import time
from typing import TYPE_CHECKING

import structlog

from elpd.events.jit import division
from elpd.service import compiling, memory

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.config import Config
    from elpd.events.jit import PutOff

SWITCH_INTERVAL_S = 5e-5
"""How long another thread may keep the interpreter before the focus thread gets it: 5 ms unless set."""

_left: list[PutOff] = []
"""What was imported and not needed. One per process, as modules are imported once."""

log = structlog.get_logger(__name__)


def warm_up(config: Config, ended: Callable[[], bool] = compiling.asked_to_end) -> None:
    """Have every kernel that the daemon and *config*'s rig need, and let go of what made them.

    What the rig's camera has no use for is left; called again with another configuration, this has what that one needs
    besides. Raises ``SystemExit`` if the process was asked to end meanwhile, which *ended*
    tells.
    """
    begun_s = time.perf_counter()
    names = compiling.modules(config)
    division.put_off = _left
    compiling.import_all(names)
    wanted = compiling.wanted(config)
    division.put_off = None
    with compiling.by_others(names, wanted, ended):
        compiling.compile_put_off(_left, wanted)
    memory.drop_compiler()
    log.info("kernels ready", seconds=round(time.perf_counter() - begun_s, 3), left=len(_left))


def settle() -> None:
    """Make pauses of the interpreter short; called once everything is built."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    memory.drop_compiler()  # a simulated rig brought kernels of its own
    memory.trim()
