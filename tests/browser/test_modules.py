"""The page's modules without a browser: every file is JavaScript, and the pure ones do what they say."""

import os
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import pytest

STATIC = Path(str(files("elpd.web") / "static"))
NODE = shutil.which("node")

pytestmark = pytest.mark.skipif(NODE is None, reason="node is not installed; tools/packages installs it")


@pytest.mark.parametrize("module", sorted(path.name for path in STATIC.glob("*.js")))
def test_every_module_is_javascript(module: str) -> None:
    done = subprocess.run([NODE or "", "--check", str(STATIC / module)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_pure_modules() -> None:
    done = subprocess.run(
        [NODE or "", "--test", str(Path(__file__).with_name("page.test.mjs"))],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "ELPD_STATIC": STATIC.as_uri()},
    )
    assert done.returncode == 0, done.stdout + done.stderr
