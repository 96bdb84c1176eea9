"""The table of misfortunes in tools/docs/cameras.md: each has a test, and each test that it names is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in (ROOT / "tools/docs/cameras.md").read_text(encoding="utf-8").partition("## Misfortunes")[2].splitlines()
    if line.startswith("|")
][2:]


def test_every_misfortune_of_a_camera_has_a_row() -> None:
    numbers = {int(match[0]) for row in ROWS if (match := re.match(r"\d+", row[0]))}
    assert numbers == set(range(15, 23))


def test_every_test_that_is_named_is_there() -> None:
    there = {
        node.name
        for path in (ROOT / "tests").rglob("test_*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef)
    }
    for row in ROWS:
        named = set(re.findall(r"`(test_\w+)`", row[1]))
        assert named, f"{row[0]}: which test says so?"
        assert named <= there, named - there
