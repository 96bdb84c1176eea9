"""Give back memory that is not needed: what a cycle leaves free in the allocator, and the compiler once kernels exist.

A cycle fills some tens of megabytes in pieces of every size. What of it is garbage is found late, and what was freed
the C library keeps; because the pieces that live lie between those that do not, that grows for hours although nothing
leaks. So after each cycle, at rest, garbage is looked for and free pages are given back: a few milliseconds, since what
existed at the start is left out of it (``gc.freeze``).

LLVM's code is only run while kernels are compiled or loaded. Its pages are the file's own, so they can be dropped and
would be read again if they were needed. On a focus thread that locks its memory they would stay locked for nothing.
"""

from __future__ import annotations

import ctypes
import gc
import re
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

MADV_DONTNEED = 4
COMPILER = "libllvmlite.so"
_HEAD = re.compile(r"([0-9a-f]+)-([0-9a-f]+) (\S+) \S+ \S+ \S+\s*(.*)")


class Stretch(NamedTuple):
    """A stretch of the address space that holds nothing but unchanged pages of a file."""

    begin: int
    size: int


def give_back() -> None:
    """Let go of what a cycle has left: its parts know each other, so that only the garbage collector finds them."""
    gc.collect()
    trim()


def trim() -> None:
    """Give free pages of the C library's heaps back to the system, where it can do that (glibc)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(ctypes.c_size_t(0))


def drop_compiler(smaps: Path = Path("/proc/self/smaps")) -> int:
    """Let go of the compiler's own code; return how many bytes of the address space that was.

    Locked pages stay, so it is done before memory is locked.
    """
    with suppress(OSError, AttributeError):
        madvise = ctypes.CDLL(None, use_errno=True).madvise
        madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
        found = unchanged(smaps.read_text(), COMPILER)
        return sum(one.size for one in found if madvise(one.begin, one.size, MADV_DONTNEED) == 0)
    return 0


def unchanged(smaps: str, file: str) -> list[Stretch]:
    """Return the stretches that map *file* and were never written to.

    A page that was (relocations, breakpoints) exists nowhere else, and the whole stretch is then left alone.
    """
    found: list[Stretch] = []
    head: re.Match[str] | None = None
    fields: dict[str, int] = {}
    for line in [*smaps.splitlines(), "0-0 ---p 0 0:0 0"]:
        begins = _HEAD.fullmatch(line)
        if begins is None:
            name, _, value = line.partition(":")
            if value.endswith(" kB"):
                fields[name] = int(value[:-3])
            continue
        if head is not None and Path(head[4]).name == file and "w" not in head[3]:
            begin, end = int(head[1], 16), int(head[2], 16)
            if fields.get("Anonymous") == 0 and fields.get("Swap") == 0:
                found.append(Stretch(begin, end - begin))
        head, fields = begins, {}
    return found
