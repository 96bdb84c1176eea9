"""Kernels without a cache, with one, and with one that somebody damaged: they compile all the same."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from small_kernel import MODULE

from elpd.events.kernel_cache import KernelFiles

if TYPE_CHECKING:
    from pathlib import Path


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


def test_a_damaged_cache_is_made_anew_and_said(folder: Path) -> None:
    assert run(folder) == ""
    (cached,) = folder.glob("cache/*/small.doubled-*.nbc")
    for damage in (b"garbage", b"", cached.read_bytes()[:-5]):
        cached.write_bytes(damage)
        assert "damaged kernel made anew" in run(folder)
        assert cached.read_bytes() != damage
        assert run(folder) == ""


def test_a_cache_that_cannot_be_written_is_done_without(folder: Path) -> None:
    (folder / "cache").write_text("no folder", encoding="utf-8")
    run(folder)
    assert (folder / "cache").read_text(encoding="utf-8") == "no folder"


def test_a_file_is_found_by_what_it_must_hold(tmp_path: Path) -> None:
    """A process that died, another version or another variant leaves nothing that is taken for this one's."""
    kept = KernelFiles(tmp_path, "small.doubled-5.py311", ("1.0", 1))
    assert kept.load("int64") is None
    kept.save("int64", "code")
    kept.save("float64", "other code")
    assert (kept.load("int64"), kept.load("float64")) == ("code", "other code")
    newer = KernelFiles(tmp_path, "small.doubled-5.py311", ("1.0", 2))
    neighbour = KernelFiles(tmp_path, "small.doubled-50.py311", ("1.0", 1))
    neighbour.save("int64", "a neighbour's")
    assert newer.load("int64") is None
    newer.save("int64", "newer code")
    assert (newer.load("int64"), kept.load("int64"), kept.load("float64")) == ("newer code", None, None)
    newer.flush()
    assert (newer.load("int64"), neighbour.load("int64")) == (None, "a neighbour's")
    assert len(list(tmp_path.iterdir())) == 1
