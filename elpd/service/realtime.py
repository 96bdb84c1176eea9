"""The scheduling that a focus thread should have, where it may have it; where not, that is said.

SCHED_FIFO lets it run before everything ordinary, and locked pages keep it from waiting for a disk. Neither is needed
to be right: what arrives late is measured late.
"""

from __future__ import annotations

import ctypes
import os

import structlog

MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4

log = structlog.get_logger(__name__)


def be_urgent(priority: int) -> str | None:
    """Give the calling thread a SCHED_FIFO priority; return why not."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        return f"SCHED_FIFO {priority}: {getattr(error, 'strerror', None) or error}"
    return None


def lock_memory() -> str | None:
    """Keep what is touched in memory; return why not."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        refused = libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT)
    except (OSError, AttributeError) as error:
        return f"mlockall: {error}"
    return f"mlockall: {os.strerror(ctypes.get_errno())}" if refused else None
