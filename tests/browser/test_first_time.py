"""README's own commands, from a fresh copy to a focused rig on the page. The packages are this environment's."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from first_time import lines_of

ROOT = Path(__file__).parents[2]
ALONE = 'ip link set lo up; mount -t tmpfs tmpfs /run; exec "$@"'
"""In namespaces of its own: README's ports and sockets are fixed ones, and may be in use."""


def test_readme_leads_to_the_page() -> None:
    lines = lines_of(ROOT / "README.md")
    assert lines[0] == "make demo"
    assert [line.split()[1] for line in lines if line.startswith("elpd")][:2] == ["serve", "web"]


def test_from_nothing_to_a_focused_rig_on_the_page() -> None:
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install '.[test]'")
    for program in ("chromium", "make", "git"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    alone = ["unshare", "-n", "-m", "sh", "-ec", ALONE, "sh"]
    if subprocess.run([*alone, "true"], capture_output=True, check=False).returncode:
        alone = []
    done = subprocess.run(
        [*alone, sys.executable, str(ROOT / "tools" / "first_time.py"), "--packages-of", sys.prefix],
        capture_output=True,
        text=True,
        check=False,
    )
    sys.stdout.write(done.stdout)  # how long it took
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Focus, on the page: In focus" in done.stdout
