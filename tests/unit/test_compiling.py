"""Kernels that no cache has are made by other processes; whatever becomes of those, the kernels are there."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from small_kernel import MODULE

from elpd import rig
from elpd.config import load
from elpd.events.jit import PutOff, kernel
from elpd.records import Encoding
from elpd.service import compiling

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


LABELLED = """
from elpd.events.jit import kernel

@kernel("int64(int64)")
def doubled(number):
    return 2 * number

@kernel("int64(int64)", serves="evt3")
def tripled(number):
    return 3 * number

@kernel("int64(int64)", serves="evt2")
def squared(number):
    return number * number
"""

WARMED = """
import sys
from elpd.events.jit import division
from elpd.service import compiling
put_off = division.put_off = []
import small
division.put_off = None
with compiling.by_others(["small"], ["evt3"]):
    compiling.compile_put_off(put_off, ["evt3"])
kernels = (small.doubled, small.tripled, small.squared)
print([len(kernel.signatures) for kernel in kernels], [kernel.name for kernel in put_off])
print([kernel(5) for kernel in kernels])
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "small.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "dies.py").write_text(DIES, encoding="utf-8")
    (tmp_path / "asks_to_end.py").write_text(ASKS_TO_END, encoding="utf-8")
    return tmp_path


def run(folder: Path, *modules: str, program: str = PARENT) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program, *modules],
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


def test_what_serves_others_is_left_and_compiled_when_it_is_called_all_the_same(folder: Path) -> None:
    (folder / "small.py").write_text(LABELLED, encoding="utf-8")
    done = run(folder, program=WARMED)
    assert (done.stdout, done.stderr) == ("[1, 1, 0] ['small.squared']\n[10, 15, 25]\n", "")
    assert len(list(folder.glob("cache/*/small.*.nbc"))) == 3


def test_a_list_that_was_worked_off_for_one_camera_is_worked_off_for_another() -> None:
    compiled: list[str] = []
    put_off = [PutOff(name, serves, lambda name=name: compiled.append(name)) for name, serves in SERVING]  # type: ignore[misc]
    compiling.compile_put_off(put_off, {"evt3"})
    assert compiled == ["for all", "for evt3"]
    compiling.compile_put_off(put_off, {"evt3", "array"})
    assert compiled == ["for all", "for evt3", "for arrays"]
    compiling.compile_put_off(put_off, None)
    assert (compiled[3:], put_off) == (["for none"], [])


SERVING = (("for all", ""), ("for evt3", "evt3"), ("for arrays", "array"), ("for none", "measuring"))


@pytest.mark.parametrize(
    ("overrides", "spoken"),
    [
        (("sim.camera=evk4",), {Encoding.EVT3}),
        (("sim.camera=davis346",), {Encoding.ARRAY}),
        (("rig=hardware", "camera.driver=davis"), {Encoding.ARRAY}),
        (("rig=hardware", "camera.driver=metavision"), {Encoding.ARRAY}),
        (("rig=hardware", "camera.driver=neuromorphic"), {Encoding.ARRAY, Encoding.EVT3}),
        (("rig=hardware", "camera.driver=neuromorphic", "camera.model=evk4"), {Encoding.EVT3}),
        (("rig=hardware", "camera.driver=neuromorphic", "camera.model=davis346"), {Encoding.ARRAY}),
        (("rig=hardware", "camera.driver=file", "camera.path=/not/there"), set(Encoding)),
        (("rig=hardware", "camera.driver=a-stranger"), set(Encoding)),
    ],
)
def test_a_driver_says_what_its_camera_speaks(overrides: tuple[str, ...], spoken: set[Encoding]) -> None:
    config = load(overrides=overrides)
    compiling.import_all(compiling.modules(config))
    assert compiling.wanted(config) == {encoding.value for encoding in spoken}


@pytest.mark.parametrize("camera", ["evk4", "davis346"])
def test_the_simulated_camera_speaks_what_was_said(camera: str) -> None:
    config = load(overrides=[f"sim.camera={camera}", "sim.width=64", "sim.height=48"])
    parts = rig.build(config)
    parts.camera.start()
    packets = [one for _ in range(20) if (one := parts.camera.read(0.01)) is not None]
    assert {one.encoding.value for one in packets} == compiling.wanted(config)


def test_a_helper_is_compiled_once_whatever_number_stands_in_the_call() -> None:
    @kernel()
    def plus(number: int, by: int) -> int:
        return number + by

    @kernel("int64(int64)")
    def outer(number: int) -> int:
        total = 0
        for i in range(number):
            total = plus(total, i)
        return plus(plus(total, 1), 2)

    assert outer(4) == 9
    assert [str(one) for one in plus.signatures] == ["(int64, int64)"]  # type: ignore[attr-defined]
