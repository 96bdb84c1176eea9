"""Tables in large pages: events look up places all over them, and a processor remembers few small pages.

After a wait it remembers neither the table nor where its pages are, and the events of a sparse packet lie on as many
small pages as there are events.
"""

from __future__ import annotations

import mmap
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

LARGE_PAGE = 1 << 21


def in_large_pages(size: int, dtype: Any) -> NDArray[Any]:
    """Return room for a table of *size* numbers, in large pages if the system has them and the table is no small one.

    What is in it is anything.
    """
    n_bytes = size * np.dtype(dtype).itemsize
    if n_bytes < LARGE_PAGE // 2:
        return np.empty(size, dtype)
    memory = mmap.mmap(-1, n_bytes + 2 * LARGE_PAGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(OSError, AttributeError):  # without them, small pages do
        memory.madvise(mmap.MADV_HUGEPAGE)
    room = np.frombuffer(memory, np.uint8)
    begin = -room.ctypes.data % LARGE_PAGE
    return room[begin : begin + n_bytes].view(dtype)
