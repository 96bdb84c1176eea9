"""Kernels that are compiled for another processor than this one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from elpd.events.simd import instructions

HERE = Path(__file__).parent
AVX2_ONLY = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+popcnt,+bmi,+bmi2,+lzcnt,+fma"}
BLOCKS = [*(HERE / f"test_{one}.py" for one in ("events_decoders", "elp_windows", "latch_words")), "-k", "by_blocks"]


@pytest.mark.skipif(instructions() != "AVX-512", reason="this processor is not one that could be either")
def test_without_avx_512_blocks_are_taken_with_avx2_and_equal_the_twin() -> None:
    """The tests of blocks, which compare them with the word-by-word kernels, on code for an older processor."""
    environment = {**os.environ, **AVX2_ONLY}
    told = [sys.executable, "-c", "from elpd.events.simd import instructions; print(instructions())"]
    assert subprocess.check_output(told, env=environment, text=True).strip() == "AVX2"
    tests = [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", *map(str, BLOCKS)]
    done = subprocess.run(tests, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout or "[100%]" in done.stdout
    assert "skipped" not in done.stdout
