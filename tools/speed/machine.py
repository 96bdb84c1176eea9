"""What the machine allows and takes away: real-time priority, and its own noise."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

PRIORITY = 70


@contextmanager
def realtime() -> Iterator[str | None]:
    """Ask for SCHED_FIFO and locked memory; yield why not, where it is refused."""
    libc = ctypes.CDLL(None, use_errno=True)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        yield "SCHED_FIFO was refused (needs CAP_SYS_NICE or LimitRTPRIO)"
        return
    libc.mlockall(7)  # as the service does: what is touched stays
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield None
    finally:
        gc.enable()
        gc.unfreeze()
        libc.munlockall()
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def noise_floor(seconds: float = 0.5) -> NDArray[np.float64]:
    """Return the gaps between looks at the clock, in microseconds: what the machine alone takes away."""
    gaps = []
    before = begun = time.monotonic_ns()
    while before - begun < seconds * 1e9:
        now = time.monotonic_ns()
        gaps.append((now - before) / 1e3)
        before = now
    return np.array(gaps)
