"""What is given back, and what must not be."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba

from elpd.service import memory

if TYPE_CHECKING:
    from pathlib import Path

SMAPS = """\
10000-30000 r--p 00000000 08:01 7    /opt/llvmlite/libllvmlite.so
Rss:                 100 kB
Anonymous:             0 kB
Swap:                  0 kB
VmFlags: rd mr mw me
30000-70000 r-xp 00020000 08:01 7    /opt/llvmlite/libllvmlite.so
Anonymous:             0 kB
Swap:                  0 kB
70000-80000 r--p 00060000 08:01 7    /opt/llvmlite/libllvmlite.so
Anonymous:             4 kB
Swap:                  0 kB
80000-90000 r--p 00070000 08:01 7    /opt/llvmlite/libllvmlite.so
Anonymous:             0 kB
Swap:                  4 kB
90000-a0000 rw-p 00080000 08:01 7    /opt/llvmlite/libllvmlite.so
Anonymous:             0 kB
Swap:                  0 kB
a0000-b0000 r-xp 00000000 08:01 9    /lib/libc.so.6
Anonymous:             0 kB
Swap:                  0 kB
b0000-c0000 rw-p 00000000 00:00 0
Anonymous:            64 kB
"""


def test_only_pages_that_were_never_written_are_let_go() -> None:
    assert memory.unchanged(SMAPS, "libllvmlite.so") == [(0x10000, 0x20000), (0x30000, 0x40000)]


def test_the_last_stretch_counts_too() -> None:
    last = SMAPS[SMAPS.index("a0000-") : SMAPS.index("b0000-")]
    assert memory.unchanged(last, "libc.so.6") == [(0xA0000, 0x10000)]


def test_the_compiler_works_after_its_code_was_let_go() -> None:
    assert memory.drop_compiler() > 10e6
    assert numba.njit(lambda x: 2 * x)(21) == 42


def test_a_system_that_does_not_tell_is_left_alone(tmp_path: Path) -> None:
    assert memory.drop_compiler(tmp_path / "smaps") == 0
    memory.trim()
