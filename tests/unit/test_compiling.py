"""Kernels that no cache has are made by other processes; whatever becomes of those, the kernels are there."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from small_kernel import MODULE

if TYPE_CHECKING:
    from pathlib import Path

PARENT = """
import signal, sys
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # before there are threads
from elpd.service import compiling
with compiling.by_others(sys.argv[1:]):
    import small
print(small.doubled(21), sum(small.doubled.stats.cache_hits.values()))
"""

DIES = """
import os, sys
os._exit(9)
"""

ASKS_TO_END = """
import os, signal
os.kill(os.getppid(), signal.SIGTERM)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "small.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "dies.py").write_text(DIES, encoding="utf-8")
    (tmp_path / "asks_to_end.py").write_text(ASKS_TO_END, encoding="utf-8")
    return tmp_path


def run(folder: Path, *modules: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PARENT, *modules],
        cwd=folder,
        env=os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("modules", [("small",), ("not_there", "small")])
def test_what_others_have_compiled_is_only_loaded(folder: Path, modules: tuple[str, ...]) -> None:
    done = run(folder, *modules)
    assert (done.stdout, done.stderr) == ("42 1\n", "")


def test_if_the_others_die_it_is_compiled_here(folder: Path) -> None:
    assert run(folder, "dies", "small").stdout == "42 0\n"


def test_without_a_place_for_a_cache_it_is_compiled_here(folder: Path) -> None:
    (folder / "cache").write_text("no folder", encoding="utf-8")
    assert run(folder, "dies", "small").stdout == "42 0\n"


def test_a_process_that_is_asked_to_end_meanwhile_compiles_no_more(folder: Path) -> None:
    done = run(folder, "asks_to_end", "dies", "small")
    assert (done.returncode, done.stdout) == (0, "")
