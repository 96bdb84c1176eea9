"""One booted systemd for all tests of a worker: it takes a second, and compiled kernels are kept in it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import booted
import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

STRANGER = """
import os, pathlib, time
import numpy as np
from elpd.records import CameraPacket, Encoding, Geometry
from elpd_drivers.lenses import tic

class QuietCamera:
    geometry = Geometry(64, 48)

    def start(self): pass

    def stop(self): pass

    def read(self, timeout_s):
        time.sleep(min(timeout_s, 0.02))
        return CameraPacket(np.empty(0, "<u2"), Encoding.EVT3, time.monotonic_ns())

class StickyLens:
    def __init__(self, lens): self._lens = lens

    def __getattr__(self, name): return getattr(self._lens, name)

    def poll(self):
        told = pathlib.Path("/run/elpd/hang")
        if told.exists() and told.read_text().strip() == str(os.getpid()):
            hang_where_nobody_expects_it()
        return self._lens.poll()

def hang_where_nobody_expects_it():
    time.sleep(3600)

def open_camera(settings, clock):
    return QuietCamera()

def open_lens(settings, clock):
    return StickyLens(tic.open_lens(settings, clock))
"""
ENTRY_POINTS = """
[elpd.cameras]
quiet = stranger:open_camera
[elpd.lenses]
sticky = stranger:open_lens
"""
PACKAGES = f"opt/elpd/lib/{booted.PYTHON}/site-packages"
STRANGERS_DRIVERS = {
    f"{PACKAGES}/stranger.py": STRANGER,
    f"{PACKAGES}/stranger-1.dist-info/METADATA": "Metadata-Version: 2.1\nName: stranger\nVersion: 1\n",
    f"{PACKAGES}/stranger-1.dist-info/entry_points.txt": ENTRY_POINTS,
}
"""A camera that sees nothing, and a Tic whose driver hangs in the process that /run/elpd/hang names."""

BEFORE_OTHERS = "[Service]\nCPUSchedulingPolicy=rr\nCPUSchedulingPriority=1\n"
"""The limits of the unit are of real time, and tests run beside other programs on few cores."""


@pytest.fixture(scope="session")
def machine() -> Iterator[booted.Booted]:
    if (missing := booted.why_not()) is not None:
        pytest.skip(missing)
    files, binds = booted.installation()
    files |= STRANGERS_DRIVERS | {"etc/systemd/system/elpd.service.d/before-others.conf": BEFORE_OTHERS}
    with booted.Booted(files, binds, booted.compiled_kernels()) as running:
        yield running
