"""The source of a module with one kernel, for tests of how kernels are compiled and kept."""

from __future__ import annotations

MODULE = """
from elpd.events.jit import kernel

@kernel("int64(int64)")
def doubled(number):
    return 2 * number
"""
