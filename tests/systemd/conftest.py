"""One booted systemd for all tests of a worker: it takes a second, and compiled kernels are kept in it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import booted
import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

QUIET = """
import pathlib, time
from elpd.records import Geometry

class QuietCamera:
    geometry = Geometry(64, 48)

    def start(self): pass

    def stop(self): pass

    def read(self, timeout_s):
        while pathlib.Path("/run/elpd/hang").exists():
            hang_where_nobody_expects_it()
        time.sleep(timeout_s)
        return None

def hang_where_nobody_expects_it():
    time.sleep(3600)

def open_camera(settings, clock):
    return QuietCamera()
"""
PACKAGES = f"opt/elpd/lib/{booted.PYTHON}/site-packages"
QUIET_CAMERA = {
    f"{PACKAGES}/quiet_camera.py": QUIET,
    f"{PACKAGES}/quiet_camera-1.dist-info/METADATA": "Metadata-Version: 2.1\nName: quiet-camera\nVersion: 1\n",
    f"{PACKAGES}/quiet_camera-1.dist-info/entry_points.txt": "[elpd.cameras]\nquiet = quiet_camera:open_camera\n",
}
"""A stranger's camera that sees nothing, and hangs while /run/elpd/hang is there."""


@pytest.fixture(scope="session")
def machine() -> Iterator[booted.Booted]:
    if (missing := booted.why_not()) is not None:
        pytest.skip(missing)
    files, binds = booted.installation()
    with booted.Booted(files | QUIET_CAMERA, binds, booted.compiled_kernels()) as running:
        yield running
