"""The handbook's shell blocks that are marked ``run`` do what they say, one after the other, in one shell."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from elpd.cli import COMMANDS

ROOT = Path(__file__).parents[2]
HANDBOOK = (ROOT / "tools" / "docs" / "handbook.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```sh run\n(.*?)^```", HANDBOOK, re.MULTILINE | re.DOTALL)
PROGRAM = f"#!{sys.executable}\nimport sys\nfrom elpd.cli import main\nsys.exit(main())\n"
SMALL = " ".join(f"--set sim.{key}" for key in ("width=320", "height=240", "scene=camera"))


@pytest.mark.parametrize("program", ["jq", "socat"])
def test_what_the_blocks_need_is_in_the_list_of_packages(program: str) -> None:
    assert (
        program in (ROOT / "tools" / "packages").read_text(encoding="utf-8").split("WANTED=")[1].split('"')[1].split()
    )


def test_every_block_does_what_it_says(tmp_path: Path) -> None:
    missing = [program for program in ("bash", "jq", "socat") if shutil.which(program) is None]
    if missing:
        pytest.skip(f"{missing[0]} is not installed; see tools/packages")
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "elpd").write_text(PROGRAM, encoding="utf-8")
    (programs / "elpd").chmod(0o755)
    script = "set -euo pipefail\n" + "".join(f": block {number}\n{block}" for number, block in enumerate(BLOCKS))
    told = tmp_path / "told.txt"
    with told.open("wb") as out:
        shell = subprocess.Popen(
            ["bash", "-xc", script],
            cwd=tmp_path,
            env=os.environ | {"PATH": f"{programs}:{os.environ['PATH']}", "SMALL": SMALL, "LC_ALL": "C.UTF-8"},
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            start_new_session=True,
        )
        try:
            code = shell.wait(timeout=280)
        finally:
            os.killpg(shell.pid, signal.SIGKILL)  # the boards in the background
            shell.wait()
    assert code == 0, told.read_text(encoding="utf-8", errors="replace")[-4000:]


def test_there_are_blocks() -> None:
    assert len(BLOCKS) >= 8


def test_every_command_that_it_names_exists() -> None:
    code = "\n".join(re.findall(r"```sh.*?```|`[^`\n]+`", HANDBOOK, re.DOTALL))
    named = set(re.findall(r"\belpd (?:--log \S+ )?([a-z][a-z-]+)", code))
    assert {"focus", "home", "serve", "park"} <= named
    assert named <= set(COMMANDS), named - set(COMMANDS)
