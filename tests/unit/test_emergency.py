"""The last resort is quick: what stops a lens that nobody watches loads neither kernels nor pictures."""

from __future__ import annotations

import subprocess
import sys


def test_parking_waits_for_no_compiler() -> None:
    drivers = ", ".join(
        f"elpd_drivers.lenses.{name}" for name in ("avr", "grbl", "scf4", "theia", "tic", "tmcl", "zaber")
    )
    code = (
        f"import sys, elpd.cli.park, elpd.rig, elpd.motion.errand, {drivers}; "
        "print({'numba', 'scipy', 'cv2'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "set()\n"
