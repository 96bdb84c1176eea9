"""The kernels' cache is an optimisation: missing, read-only or damaged, it costs time and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

CODE = """
import sys
sys.path.insert(0, sys.argv[1])
import kernels
print(kernels.double(21))
"""
KERNELS = """
from elpd.events.jit import kernel

@kernel("int64(int64)")
def double(x):
    return 2 * x
"""


@pytest.mark.parametrize("damage", [b"", b"\x80\x04garbage", bytes(range(64))])
def test_a_damaged_cache_is_told_of_and_not_used(tmp_path: Path, damage: bytes) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS)
    cache = tmp_path / "cache"
    assert _run(tmp_path, cache) == ("42", "")
    files = [path for path in cache.rglob("*") if path.is_file()]
    assert files
    for path in files:
        path.write_bytes(damage)
    out, err = _run(tmp_path, cache)
    assert out == "42"
    assert "kernel cache not used" in err
    assert _run(tmp_path, cache) == ("42", ""), "it was written anew"


def test_without_a_folder_for_the_cache_there_is_none(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS)
    (tmp_path / "file").write_text("not a folder")
    assert _run(tmp_path, tmp_path / "file" / "cache")[0] == "42"


def _run(folder: Path, cache: Path) -> tuple[str, str]:
    ran = subprocess.run(
        [sys.executable, "-c", CODE, str(folder)],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
        check=True,
    )
    return ran.stdout.strip().splitlines()[-1], ran.stderr + "".join(ran.stdout.splitlines(keepends=True)[:-1])
