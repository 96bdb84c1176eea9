"""The tables of misfortunes name tests; each of them is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TABLE = (ROOT / "tools" / "docs" / "faults.md").read_text(encoding="utf-8")
LENSES = (ROOT / "tools" / "docs" / "lenses.md").read_text(encoding="utf-8")
NAMED = re.findall(r"`(tests/\S+\.py)::(test_\w+)`", TABLE)


def test_every_row_names_tests_that_there_are() -> None:
    rows = [line for line in TABLE.splitlines() if line.startswith("| ")][1:]
    assert len(rows) >= 19
    assert all("::test_" in row for row in rows)
    there = {path: _tests(ROOT / path) for path, _ in NAMED}
    assert [f"{path}::{name}" for path, name in NAMED if name not in there[path]] == []


def test_every_misfortune_of_a_lens_names_tests_that_there_are() -> None:
    rows = {int(found[1]): found[0] for found in re.finditer(r"^\| (\d+) .*$", LENSES, re.MULTILINE)}
    assert sorted(rows) == list(range(1, 15))
    there = set().union(*(_tests(path) for path in (ROOT / "tests").rglob("test_*.py")))
    for number, row in rows.items():
        named = set(re.findall(r"`(test_\w+)`", row))
        assert named, number
        assert named <= there, named - there


def _tests(path: Path) -> set[str]:
    return {node.name for node in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(node, ast.FunctionDef)}
