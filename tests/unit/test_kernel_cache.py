"""Kernels without a cache, with one, and with one that somebody damaged: they compile all the same."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

MODULE = """
from elpd.events.jit import kernel

@kernel("int64(int64)")
def doubled(number):
    return 2 * number
"""


def run(folder: Path) -> str:
    """Return what was warned of, after the kernel has answered."""
    done = subprocess.run(
        [sys.executable, "-c", "from elpd import log; log.configure(); import small; print(small.doubled(21))"],
        cwd=folder,
        env=os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "42\n"
    return done.stderr


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "small.py").write_text(MODULE, encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_damaged_cache_is_made_anew_and_said(folder: Path, ending: str) -> None:
    assert run(folder) == ""
    (cached,) = folder.glob(f"cache/*/small.doubled-*.{ending}")
    for damage in (b"garbage", b"", cached.read_bytes()[:-5]):
        cached.write_bytes(damage)
        assert "damaged kernel made anew" in run(folder)
        assert cached.read_bytes() != damage
        assert run(folder) == ""


def test_a_cache_that_cannot_be_written_is_done_without(folder: Path) -> None:
    (folder / "cache").write_text("no folder", encoding="utf-8")
    run(folder)
    assert (folder / "cache").read_text(encoding="utf-8") == "no folder"
